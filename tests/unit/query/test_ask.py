"""Queries of a lift by words, examples and vectors: the selection, and the errors of invalid queries."""

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from liftcore.errors import InvalidLift, InvalidQuery, NotFound, SplatliftError
from liftcore.io.splats import some_rows
from liftcore.query.ask import ask
from liftcore.query.directions import directions, read_example
from liftcore.query.question import Query
from liftcore.query.result import load_lift
from liftcore.query.scene import Scene
from liftcore.query.terms import Area, Example, SplatTerm, Vector, parse_example
from liftcore.query.threshold import find_threshold
from liftcore.values.lift_file import save_lift
from tests.promises.tiny_files import write_lift
from tests.tiny_scene import CHANNELS, HEIGHT, SPLATS_A_CLUSTER, WIDTH

from .made_up import lifted

COUNT = 3 * SPLATS_A_CLUSTER
NAMES = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=12)


class Axes:
    """Text encoder of "x", "y", "z" as the unit axes of the three clusters."""

    name, channels = "axes", CHANNELS

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        if not all(text in ("x", "y", "z") for text in texts):
            raise InvalidQuery("text", expected="x, y or z", got=str(texts)[:80])
        return np.eye(self.channels, dtype=np.float32)[["xyz".index(text) for text in texts]]


@pytest.fixture
def exact(scene: Scene) -> Scene:
    """Splats j, j + 3, .. have the feature of one axis; the last splat has none."""
    rows = np.eye(CHANNELS)[np.arange(COUNT) % 3] + 0.01
    rows[-1] = 0
    return lifted(scene, rows, has_feature=torch.arange(COUNT) < COUNT - 1)


def test_splats_without_weight_do_not_decide_the_threshold(exact: Scene) -> None:
    reference = ask(exact, "x", Axes())
    outliers = np.zeros((COUNT, CHANNELS))
    outliers[:, 0], outliers[:, 1] = 1.0, np.linspace(0.0, 3.0, COUNT)  # scores all over the range
    weights = torch.cat([torch.ones(COUNT), torch.full((COUNT,), 1e-4)])
    crowd = lifted(exact, np.concatenate([exact.features.rows, outliers]), total_weight=weights)
    answer = ask(crowd, "x", Axes())
    assert crowd.effective_count == pytest.approx(COUNT - 1, rel=0.01)
    assert np.array_equal(answer.selected[:COUNT], reference.selected)
    assert answer.selected[COUNT] and answer.count > reference.count  # the outliers are selected even so


def test_words_of_a_table_are_asked_without_torch(tiny_lift: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from liftcore.query.ask import ask; "
        "from liftcore.query.scene import Scene; from liftcore.query.question import Query; "
        "import liftcore.text.table; "
        "scene = Scene(Path(sys.argv[1])); answer = ask(scene, Query(like=['splat:0'])); "
        "assert scene.locate(answer, 3).top and 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code, str(tiny_lift)], check=True)


def test_cameras_may_be_added_but_not_moved(tmp_path: Path) -> None:
    lift, file = write_lift(tmp_path), tmp_path / "c.json"
    document = json.loads(file.read_text())
    document["frames"].append({**document["frames"][0], "file_path": "images/new.png"})
    file.write_text(json.dumps(document))
    assert "new" in Scene(lift).cameras
    document["frames"][0]["transform_matrix"][0][3] += 0.5
    file.write_text(json.dumps(document))
    with pytest.raises(InvalidLift, match="cameras changed since the lift"):
        _ = Scene(lift).cameras


@pytest.mark.parametrize("cluster", range(3))
def test_every_kind_of_example_finds_its_cluster(scene: Scene, cluster: int) -> None:
    splats = slice(cluster * SPLATS_A_CLUSTER, (cluster + 1) * SPLATS_A_CLUSTER)
    x = (6, 16, 26)[cluster]
    kinds: list[Example] = [
        Area("middle", "pixel", ((x, HEIGHT // 2),)),
        Area("middle", "box", ((x - 4, 2), (x + 5, HEIGHT - 2))),
        Area("middle", "stroke", ((x, 6), (x + 1, 12), (x, 18))),
        SplatTerm(cluster * SPLATS_A_CLUSTER + 3),
        Vector(tuple(1e30 * np.eye(CHANNELS)[cluster])),
    ]
    for example in kinds:
        answer = ask(scene, Query.of((example,)))
        assert answer.selected[splats].mean() > 0.7, example
        assert answer.count <= 1.3 * SPLATS_A_CLUSTER, example
        assert len(scene.locate(answer, 1000).top) == COUNT  # no more than there are


def test_pixel_is_the_feature_rendered_there(scene: Scene) -> None:
    features = torch.from_numpy(scene.features[:]).float()
    image = scene.raster.render(scene.cameras["middle"], features, scene.compositing)
    for x, y in ((5, 12), (16, 12), (26, 10)):
        (direction,) = directions(scene, Query(like=[f"middle:{x},{y}"]), None)
        expected = torch.nn.functional.normalize(image[y, x], dim=0)
        np.testing.assert_allclose(direction, expected.numpy(), atol=1e-5)


def test_box_is_what_is_in_it_and_not_around_it(scene: Scene) -> None:
    """Half of each neighbour lies in the box, together more than the object, as around a thin object."""
    near, target = np.eye(2, CHANNELS)
    rows = np.repeat([near, target, near], SPLATS_A_CLUSTER, axis=0)
    (boxed,) = directions(lifted(scene, rows), Query(like=["middle:box:5,2,28,22"]), None)
    assert boxed @ target > 0.9
    # Nothing is around all of the image.
    (full_image,) = directions(lifted(scene, rows), Query(like=["middle:box:0,0,32,24"]), None)
    assert full_image @ near > 0.9
    (within,) = directions(scene, Query(like=["middle:box:15,8,18,15"]), None)  # the same is around it
    assert within @ target > 0.9


def test_stroke_may_slip_over_an_edge(scene: Scene) -> None:
    (stroke,) = directions(scene, Query(like=["middle:stroke:16,4,16,20,26,20"]), None)
    assert stroke @ np.eye(2, CHANNELS)[1] > 0.95


def test_threshold_of_examples_is_above_a_least_likeness(scene: Scene) -> None:
    """Ten splats like the example and fifteen a little like it: the widest gap is between these 25 and the rest."""
    rows = np.zeros((COUNT, CHANNELS))
    rows[:10, 0], rows[10:25, :3], rows[25:, 1] = 1.0, [0.3, 0.3, 0.9], -1.0
    subject = lifted(scene, rows + np.random.default_rng(0).normal(0, 0.01, rows.shape))
    by_example = ask(subject, Query.of((SplatTerm(0),)))
    assert np.flatnonzero(by_example.selected).tolist() == list(range(10))
    assert by_example.threshold.value > 0.4 and find_threshold(by_example.scores).value < 0.0
    in_words = ask(subject, Query.of(("x",)), Axes())
    assert in_words.threshold.value == find_threshold(in_words.scores).value
    combined = ask(subject, Query.of((SplatTerm(0), "x")), Axes())
    assert combined.threshold.value == find_threshold(combined.scores).value
    assert ask(subject, Query.of((SplatTerm(0),), threshold=0.1)).count == 25


@pytest.mark.parametrize(
    ("example", "error", "message"),
    [
        (parse_example("behind:1,1"), NotFound, "behind"),
        (parse_example(f"middle:{WIDTH},0"), InvalidQuery, rf"0\.\.{WIDTH - 1}"),
        (parse_example("middle:0,0"), InvalidQuery, r"got a ray with an opacity of [\d.]+%"),
        (parse_example(f"middle:box:0,0,{WIDTH + 1},2"), InvalidQuery, f"x1 <= {WIDTH}"),
        (parse_example("middle:stroke:0,0,1,1"), InvalidQuery, "an area that shows the scene"),
        (Vector((1.0,) * 7), InvalidQuery, "8 channels"),
    ],
)
def test_term_without_a_feature_says_why_under_its_name(
    scene: Scene, example: Example, error: type[SplatliftError], message: str
) -> None:
    with pytest.raises(error, match=message):
        ask(scene, Query.of((example,)))
    query = Query.of((SplatTerm(0),), (example,))
    with pytest.raises(error, match=r"unlike\.0"):
        ask(scene, query)


@given(view=NAMES, x=st.integers(0, 9999), y=st.integers(0, 9999))
def test_any_name_of_a_view_can_be_pointed_at(view: str, x: int, y: int) -> None:
    corners = ((x, y), (y, x), (x, x))
    points = [Area(name, "pixel", corners[:1]) for name in (view, f"region:{view}", "splat", "object")]
    for example in (*points, Area(view, "box", corners[:2]), Area(view, "stroke", corners)):
        assert parse_example(str(example)) == example


def test_vectors_come_from_numpy_files(tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", np.arange(3, dtype=np.float16)[None])
    assert read_example(str(tmp_path / "v.npy")) == Vector((0.0, 1.0, 2.0))
    np.save(tmp_path / "v.npy", np.ones((2, 2)))
    with pytest.raises(InvalidQuery, match="one vector"):
        read_example(str(tmp_path / "v.npy"))


@pytest.mark.parametrize("suffix", [".ply", ".splat"])
def test_a_lift_with_other_rows_than_its_splats_answers_nothing(suffix: str, tmp_path: Path) -> None:
    path = write_lift(tmp_path)
    lift, splats = load_lift(path), tmp_path / f"other{suffix}"
    rows = ("rows", "total_weight", "has_feature", "confidence", "cluster", "object", "node")
    cropped = {name: getattr(lift, name)[:-1] for name in rows if getattr(lift, name) is not None}
    save_lift(replace(lift, **cropped), tmp_path / "cropped.lift")
    ask(Scene(path), Query.of((SplatTerm(0),)))
    with pytest.raises(InvalidLift, match="a row for each of its"):
        ask(Scene(tmp_path / "cropped.lift"), Query.of((SplatTerm(0),)))  # scores alone, without places
    splats.write_bytes(b"".join(some_rows(tmp_path / "s.ply", np.arange(len(lift.features)) > 0, suffix)))
    with pytest.raises(InvalidLift, match="a row for each of its"):
        Scene(path, splats=splats, cameras=tmp_path / "c.json")
    (tmp_path / "s.ply").write_bytes(splats.read_bytes())  # another file stands there now: only positions are lost
    ask(Scene(path), Query.of((SplatTerm(0),)))
