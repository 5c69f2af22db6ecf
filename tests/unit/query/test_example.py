"""Query by example: the notation, the features behind it, and what is said when there is none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from liftcore.errors import InvalidLift, InvalidQuery, NotFound, SplatliftError
from liftcore.io.lift_file import load_lift, save_lift
from liftcore.io.lift_files import lift_files
from liftcore.query.ask import ask
from liftcore.query.directions import directions
from liftcore.query.example import Example, OneSplat, Pixel, Region, Vector, parse_example
from liftcore.query.query import Query
from liftcore.query.scene import QueryScene
from liftcore.query.threshold import find_threshold
from liftcore.query.vector_file import read_vector
from liftcore.query.view_mask import view_mask
from liftcore.settings import LiftSettings
from tests.api.tiny_scene import CHANNELS, HEIGHT, SPLATS_A_CLUSTER, WIDTH, make_scene

NAMES = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=12)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> QueryScene:
    """The tiny scene lifted: three clusters side by side, "apple" on the left."""
    folder = tmp_path_factory.mktemp("tiny")
    tiny = make_scene()
    for name, content in (("s.ply", tiny.splats), ("c.json", tiny.cameras), ("f.safetensors", tiny.features)):
        (folder / name).write_bytes(content)
    made = lift_files(
        folder / "s.ply", folder / "c.json", [folder / "f.safetensors"], LiftSettings.of(preset="row-sum")
    )
    save_lift(made, folder / "scene.lift")
    return QueryScene.open(folder / "scene.lift")


@given(view=NAMES, x=st.integers(0, 9999), y=st.integers(0, 9999))
def test_any_name_of_a_view_can_be_pointed_at(view: str, x: int, y: int) -> None:
    for example in (Pixel(view, x, y), Region(view, x, y), Pixel(f"region:{view}", x, y), Pixel("splat", x, y)):
        assert parse_example(str(example)) == example


@given(st.text(max_size=40))
def test_any_other_notation_is_refused(notation: str) -> None:
    try:
        example = parse_example(notation)
    except InvalidQuery as error:
        assert "VIEW:x,y" in error.expected
    else:
        assert isinstance(example, Pixel | Region | OneSplat)


@pytest.mark.parametrize(
    "notation", ["", ":1,2", "v:1.5,2", "v:1", "splat:-1", "splat:x", "region:v:1", "splat:" + "9" * 5000]
)
def test_what_points_nowhere_is_refused(notation: str) -> None:
    with pytest.raises(InvalidQuery, match="like"):
        parse_example(notation)


def test_a_pixel_is_the_feature_rendered_there(scene: QueryScene) -> None:
    features = scene.lift.features.float()
    image = scene.raster.render(scene.cameras["middle"], features, scene.walk)
    for x, y in ((5, 12), (16, 12), (26, 10)):
        (found,) = directions(scene, Query((Pixel("middle", x, y),)), None)
        torch.testing.assert_close(found, torch.nn.functional.normalize(image[y, x], dim=0), atol=1e-5, rtol=0)


@pytest.mark.parametrize("cluster", range(3))
def test_every_kind_of_example_finds_its_cluster_without_an_encoder(scene: QueryScene, cluster: int) -> None:
    splats = slice(cluster * SPLATS_A_CLUSTER, (cluster + 1) * SPLATS_A_CLUSTER)
    kinds: list[Example] = [
        Pixel("middle", (6, 16, 26)[cluster], HEIGHT // 2),
        Region("left", 0, cluster),
        OneSplat(cluster * SPLATS_A_CLUSTER + 3),
        Vector(tuple(1e30 * np.eye(CHANNELS)[cluster])),
    ]
    for example in kinds:
        answer = ask(scene, Query((example,)))
        assert answer.selected[splats].float().mean() > 0.7, example
        assert answer.count <= 1.3 * SPLATS_A_CLUSTER, example


class Between:
    """Encodes any text as the direction between the first two axes."""

    name, channels = "between", CHANNELS

    def encode(self, texts: Sequence[str]) -> torch.Tensor:
        return torch.nn.functional.normalize(torch.eye(CHANNELS)[:2].sum(dim=0), dim=0).expand(len(texts), -1)


def test_the_automatic_threshold_of_examples_is_above_a_least_likeness(scene: QueryScene) -> None:
    """Ten splats as the example, fifteen a little like it: together they stand apart most from all others."""
    count = 3 * SPLATS_A_CLUSTER
    rows = np.zeros((count, CHANNELS))
    rows[:10, 0], rows[10:25, :3], rows[25:, 1] = 1.0, [0.3, 0.3, 0.9], -1.0
    noisy = torch.from_numpy(rows + np.random.default_rng(0).normal(0, 0.01, rows.shape)).float()
    made = replace(scene.lift, features=noisy, evidence=torch.ones(count), seen=torch.ones(count, dtype=torch.bool))
    lifted = QueryScene(made, scene.path)
    by_example = ask(lifted, Query((OneSplat(0),)))
    assert by_example.selected.nonzero()[:, 0].tolist() == list(range(10))
    assert by_example.threshold > 0.4
    assert find_threshold(by_example.scores).value < 0.0
    in_words = ask(lifted, Query(("x",)), Between())
    assert in_words.threshold < 0.0 and in_words.count == 25
    both = ask(lifted, Query((OneSplat(0), "x")), Between())
    assert both.threshold == pytest.approx(find_threshold(both.scores).value)
    assert ask(lifted, Query((OneSplat(0),), threshold=0.1)).count == 25


def test_positives_and_negatives_together_make_one_query(scene: QueryScene) -> None:
    apple, book, lamp = (Region("left", 0, k) for k in range(3))
    both = ask(scene, Query((apple, lamp), threshold=0.8))
    either = ask(scene, Query((apple,), threshold=0.8)).selected | ask(scene, Query((lamp,), threshold=0.8)).selected
    assert torch.equal(both.selected, either) and both.count > 1.5 * SPLATS_A_CLUSTER
    against = ask(scene, Query((apple, lamp), (book,), threshold=0.5))
    assert not against.selected[SPLATS_A_CLUSTER : 2 * SPLATS_A_CLUSTER].all()


def test_a_query_by_example_is_seen_like_any_other(scene: QueryScene) -> None:
    columns = view_mask(scene, ask(scene, Query((Pixel("left", 6, 12),))), "middle").mask.nonzero()[:, 1]
    assert len(columns) > 0 and int(columns.max()) < WIDTH // 2


@pytest.mark.parametrize(
    ("example", "error", "said"),
    [
        (Pixel("behind", 1, 1), NotFound, "behind"),
        (Pixel("middle", WIDTH, 0), InvalidQuery, rf"0\.\.{WIDTH - 1}"),
        (Pixel("middle", 0, -1), InvalidQuery, rf"0\.\.{HEIGHT - 1}"),
        (Pixel("middle", 0, 0), InvalidQuery, "a ray that splats fill by"),
        (Region("behind", 0, 0), NotFound, "feature packs"),
        (Region("left", 1, 0), NotFound, r"0\.\.0"),
        (Region("left", 0, 3), NotFound, "label"),
        (OneSplat(60), InvalidQuery, r"0\.\.59"),
        (Vector((1.0,) * 7), InvalidQuery, "8 channels"),
        (Vector((0.0,) * CHANNELS), InvalidQuery, "zeros"),
        (Vector((math.nan,) * CHANNELS), InvalidQuery, "NaN"),
        ("apple", InvalidQuery, "ask by example"),
    ],
)
def test_an_example_without_a_feature_says_why(
    scene: QueryScene, example: Example, error: type[SplatliftError], said: str
) -> None:
    with pytest.raises(error, match=said):
        ask(scene, Query((example,)))


def test_a_pack_that_changed_is_not_taken_for_the_old_one(scene: QueryScene, tmp_path: Path) -> None:
    pack = tmp_path / "f.safetensors"
    pack.write_bytes(Path(scene.lift.metadata.features[0].path).read_bytes())
    moved = scene.lift.metadata.features[0].model_copy(update={"path": str(pack)})
    metadata = scene.lift.metadata.model_copy(update={"features": (moved,)})
    save_lift(replace(load_lift(scene.path), metadata=metadata), tmp_path / "other.lift")
    query = Query((Region("left", 0, 0),))
    assert ask(QueryScene.open(tmp_path / "other.lift"), query).count > 0
    pack.write_bytes(pack.read_bytes() + b" ")
    with pytest.raises(InvalidLift, match="features changed since the lift"):
        ask(QueryScene.open(tmp_path / "other.lift"), query)


def test_queries_that_ask_nothing_or_too_much_are_refused() -> None:
    for positives in ((), ("a",) * 65):
        with pytest.raises(InvalidQuery):
            Query(positives)
    with pytest.raises(InvalidQuery, match="keep"):
        Query(("a",), keep="some")
    with pytest.raises(InvalidQuery, match="threshold"):
        Query(("a",), threshold="best")


def test_vectors_come_from_numpy_files(tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", np.arange(3, dtype=np.float16)[None])
    assert read_vector(tmp_path / "v.npy") == Vector((0.0, 1.0, 2.0))
    np.save(tmp_path / "v.npy", np.ones((2, 2)))
    with pytest.raises(InvalidQuery, match="one vector"):
        read_vector(tmp_path / "v.npy")


def test_a_view_is_read_once_for_all_regions_of_it(scene: QueryScene, monkeypatch: pytest.MonkeyPatch) -> None:
    read, packs = [], scene.packs
    views = sorted(packs.views)[:2]
    asked = [Region(view, 0, region) for region in (0, 1, 0) for view in views]
    alone = [directions(scene, Query((region,)), None)[0] for region in asked]
    observation = packs.observation
    monkeypatch.setattr(type(packs), "observation", lambda _, view: read.append(view) or observation(view))
    together = directions(scene, Query((asked[0], OneSplat(0), *asked[1:])), None)
    assert read == views
    assert torch.equal(together[[0, 2, 3, 4, 5, 6]], torch.stack(alone))
