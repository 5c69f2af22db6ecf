"""A scene opened for queries: from a file, from values, and cached by a result."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

import liftcore as lc
from liftcore.text.table import TableEncoder
from tests.tiny_scene import CHANNELS

if TYPE_CHECKING:
    from pathlib import Path

    from liftcore.query.scene import Scene

AXES = TableEncoder("axes", ("x", "y", "z"), np.eye(3, CHANNELS, dtype=np.float32))


def test_result_keeps_its_scene_while_its_splats_are_the_same(tiny_lift: Path, scene: Scene) -> None:
    result = lc.load_lift(tiny_lift)
    first_scene = result.scene(scene.splats)
    assert result.scene(scene.splats) is first_scene and result.scene() is not first_scene
    assert lc.LiftResult.of(result).settings == result.settings  # a copy has the values and no scene


def test_files_are_those_of_the_answer_and_no_others(scene: Scene, tmp_path: Path) -> None:
    answer = scene.ask("x", encoder=AXES)
    scene.export(tmp_path / "scores.npy", answer, "scores")
    assert np.array_equal(np.load(tmp_path / "scores.npy"), answer.scores)
    scene.export(tmp_path / "x.ply", "x", encoder=AXES)
    assert lc.read_splats(tmp_path / "x.ply").count == answer.count - scene.objects(answer).unassigned_splats
    scene.export(tmp_path / "mask.png", lc.Query(text=["x"], view="middle"), "mask", encoder=AXES)
    assert (tmp_path / "mask.png").read_bytes() == b"".join(scene.blocks_of(answer, "mask", view="middle"))
    for content, message in (("mesh", "what: expected one of object, coloured"), ("mask", "view: expected")):
        with pytest.raises(lc.InvalidQuery, match=message):
            scene.export(tmp_path / "none.png", answer, content)
    assert not (tmp_path / "none.png").exists()
