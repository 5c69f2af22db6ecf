"""The objects of a lift, one by one, and what a vocabulary makes of them."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from liftcore.cli import main
from liftcore.errors import InvalidLift, InvalidQuery
from liftcore.query.catalogue import NOT_LOOKED_FOR, catalogue, table_csv
from liftcore.query.result import load_lift
from liftcore.query.scene import Scene
from liftcore.values.lift_file import save_lift
from tests.api.tiny_scene import CHANNELS, SPLATS_A_CLUSTER, VIEWS, WORDS, text_table

EYE = np.eye(3, CHANNELS, dtype=np.float32)


def test_each_object_has_its_place_its_views_and_the_nearest_word(scene: Scene) -> None:
    found = catalogue(scene, WORDS, 3.0 * EYE)
    assert [one.id for one in found.objects] == [0, 1, 2] and found.features.shape == (3, CHANNELS)
    assert sorted(one.share for one in found.objects)[::-1] == [one.share for one in found.objects]
    for one in found.objects:
        cluster = round(one.centre[0] / 1.2) + 1
        assert (one.name, one.splats) == (WORDS[cluster], SPLATS_A_CLUSTER)
        assert set(one.views) == set(VIEWS) and one.score == pytest.approx(1, abs=0.1)
        means = scene.splats.means.numpy()[SPLATS_A_CLUSTER * cluster : SPLATS_A_CLUSTER * (cluster + 1)]
        np.testing.assert_allclose(one.box, [means.min(axis=0), means.max(axis=0)], atol=1e-6)
    lines = list(csv.DictReader(io.StringIO(table_csv(found).decode())))
    assert [line["name"] for line in lines] == [one.name for one in found.objects]
    assert [int(line["splats"]) for line in lines] == [SPLATS_A_CLUSTER] * 3


def test_a_lift_from_before_opens_and_says_that_it_holds_none(scene: Scene, tmp_path: Path) -> None:
    save_lift(replace(scene.lift, object=None, object_views=None), tmp_path / "old.lift")
    old = catalogue(Scene(tmp_path / "old.lift"))
    assert (old.objects, old.explanation) == ((), NOT_LOOKED_FOR)
    save_lift(replace(scene.lift, object_views=None), tmp_path / "half.lift")
    with pytest.raises(InvalidLift, match="object and object_views, or neither"):
        load_lift(tmp_path / "half.lift")


@pytest.mark.parametrize("vectors", [None, EYE[:2], np.zeros((3, CHANNELS)), np.ones((3, CHANNELS + 1))])
def test_words_without_directions_are_refused(scene: Scene, vectors: np.ndarray | None) -> None:
    with pytest.raises(InvalidQuery, match="words: expected"):
        catalogue(scene, WORDS, vectors)


def test_the_command_lists_names_and_writes_them(
    tiny_lift: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "words.safetensors").write_bytes(text_table())
    files = ["--csv", str(tmp_path / "things.csv"), "--splats", str(tmp_path / "things")]
    named = ["--vocabulary", str(tmp_path / "words.safetensors"), "--features", "--json"]
    assert main(["objects", str(tiny_lift), *named, *files]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {one["name"] for one in told["objects"]} == set(WORDS) and len(told["objects"][0]["feature"]) == CHANNELS
    assert told["answer"]["count"] == 3 and told["answer"]["objects"][2]["feature"] == told["objects"][2]["feature"]
    assert (tmp_path / "things.csv").read_text().count("\n") == 4
    assert sorted(path.name for path in (tmp_path / "things").iterdir()) == [f"object-{k}.ply" for k in range(3)]
    assert main(["objects", str(tiny_lift)]) == 0 and "3 objects" in capsys.readouterr().out
    assert main(["objects", str(tiny_lift), "--json"]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert [one.keys() for one in plain["objects"]] == [one.keys() - {"feature"} for one in told["objects"]]
