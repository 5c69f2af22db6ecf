"""Questions to a lift: what is selected, what is seen, and what is said when the scene moved or changed."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from liftcore.errors import InvalidLift, InvalidQuery
from liftcore.io.input_files import input_file
from liftcore.io.inria import write_inria_cameras
from liftcore.io.lift_file import load_lift, save_lift
from liftcore.io.ply import write_splats
from liftcore.query.ask import ask, top
from liftcore.query.colours import NO_CLUSTER_COLOUR, SH_C0, cluster_colours, seen_colours
from liftcore.query.pictures import attention_png, mask_png, overlay, render, render_png
from liftcore.query.query import Query
from liftcore.query.scene import QueryScene
from liftcore.query.view_mask import view_mask
from liftcore.result import LiftMetadata, LiftResult
from liftcore.scene.cameras import Cameras
from liftcore.scene.splats import Kernel, Splats
from liftcore.settings import LiftSettings
from tests.scenes import look_at, random_splats

COUNT = 60


class Axes:
    """Encodes "x", "y", "z" as unit axes."""

    name = "axes"

    def __init__(self, channels: int = 3) -> None:
        self.channels = channels

    def encode(self, texts: Sequence[str]) -> torch.Tensor:
        return torch.eye(self.channels)[["xyz".index(text) for text in texts]]


@pytest.fixture
def lift_file(tmp_path: Path) -> Path:
    splats = random_splats(3, COUNT)
    camera = look_at("front", np.array([0.0, -4.0, 0.5]), 40, 30, 40.0)
    camera = type(camera).pinhole("front", 40, 30, 40.0, 40.0, 20.0, 15.0, camera.viewmat)
    write_splats(splats, tmp_path / "splats.ply")
    write_inria_cameras(Cameras((camera,)), tmp_path / "cameras.json")
    features = torch.eye(3)[torch.arange(COUNT) % 3] + 0.01
    features[-1] = 0
    metadata = LiftMetadata(
        version="0", settings=LiftSettings.of(), splats=input_file(tmp_path / "splats.ply"),
        cameras=input_file(tmp_path / "cameras.json"), features=(), encoder="axes", text_space="axes",
        views=("front",), certificate={}, timings={},
    )  # fmt: skip
    seen = torch.arange(COUNT) < COUNT - 1
    lift = LiftResult(features.half(), torch.ones(COUNT), torch.ones(COUNT), seen, metadata)
    save_lift(lift, tmp_path / "scene.lift")
    return tmp_path / "scene.lift"


def test_the_splats_that_mean_the_text_are_selected(lift_file: Path) -> None:
    answer = ask(QueryScene.open(lift_file), "y", Axes())
    assert answer.selected.nonzero()[:, 0].tolist() == list(range(1, COUNT - 1, 3))
    assert answer.count == len(range(1, COUNT - 1, 3))
    assert answer.statistics["min"] <= answer.statistics["q50"] <= answer.statistics["max"]
    assert answer.explanation


def test_a_splat_that_was_never_seen_is_never_selected(lift_file: Path) -> None:
    scene = QueryScene.open(lift_file)
    for negatives in ((), ("x",)):
        answer = ask(scene, Query(("z",), negatives, threshold=-5.0), Axes())
        assert not answer.selected[-1]
        assert answer.scores[-1] == answer.scores.min()
        assert answer.count == COUNT - 1


def test_splats_that_hardly_a_ray_met_do_not_decide_the_threshold(lift_file: Path) -> None:
    scene = QueryScene.open(lift_file)
    plain = ask(scene, "x", Axes())
    stray = torch.zeros(COUNT, 3)
    stray[:, 0], stray[:, 1] = 1.0, torch.linspace(0.0, 3.0, COUNT)  # scores all over the range
    crowd = LiftResult(
        torch.cat([scene.lift.features, stray.half()]),
        torch.cat([scene.lift.evidence, torch.full((COUNT,), 1e-4)]),
        torch.ones(2 * COUNT),
        torch.cat([scene.lift.seen, torch.ones(COUNT, dtype=torch.bool)]),
        scene.lift.metadata,
    )
    answer = ask(QueryScene(crowd, lift_file), "x", Axes())
    assert torch.equal(answer.selected[:COUNT], plain.selected)
    assert answer.selected[COUNT] and answer.count > plain.count  # they are selected all the same


def test_negatives_take_away_from_the_cosines(lift_file: Path) -> None:
    scene = QueryScene.open(lift_file)
    answer = ask(scene, Query(("x",), ("y", "z"), threshold=0.5), Axes())
    assert (answer.scores <= ask(scene, "x", Axes()).scores).all() and answer.threshold_method == "fixed"
    assert answer.selected.nonzero()[:, 0].tolist() == list(range(0, COUNT - 1, 3))


def test_an_encoder_of_another_space_is_refused_with_both_named(lift_file: Path) -> None:
    with pytest.raises(InvalidQuery, match=r"3 channels.*axes.*axes with 5"):
        ask(QueryScene.open(lift_file), "x", Axes(5))


@pytest.mark.parametrize(("space", "told"), [("", "not named"), ("none", "none"), ("axes", "axes")])
def test_words_without_an_encoder_are_refused_with_the_lifts_text_space(
    space: str, told: str, lift_file: Path
) -> None:
    lift = load_lift(lift_file)
    lift = replace(lift, metadata=lift.metadata.model_copy(update={"text_space": space}))
    with pytest.raises(InvalidQuery, match=rf"text space: {told}\), got no encoder"):
        ask(QueryScene(lift, lift_file), "x")


def test_the_best_splats_come_with_their_places_and_a_box(lift_file: Path) -> None:
    scene = QueryScene.open(lift_file)
    answer = ask(scene, "x", Axes())
    found = top(answer, scene, 4)
    assert [best.splat % 3 for best in found.best] == [0] * 4
    assert found.best[0].position == pytest.approx(scene.splats.means[found.best[0].splat].tolist())
    assert found.box is not None
    assert torch.all(scene.splats.means[answer.selected] >= torch.tensor(found.box[0]))
    assert top(ask(scene, Query(("x",), threshold=2.0), Axes()), scene, 1).box is None


def test_a_scene_that_moved_is_said_with_where_it_was(lift_file: Path) -> None:
    (lift_file.parent / "splats.ply").rename(lift_file.parent / "elsewhere.ply")
    scene = QueryScene.open(lift_file)
    assert ask(scene, "x", Axes()).count > 0  # scores need no splats
    with pytest.raises(InvalidLift, match=r"splats at .*splats\.ply"):
        _ = scene.splats


def test_a_scene_that_changed_is_not_taken_for_the_old_one(lift_file: Path) -> None:
    file = lift_file.parent / "cameras.json"
    file.write_text(file.read_text() + " ")
    with pytest.raises(InvalidLift, match="cameras changed since the lift"):
        _ = QueryScene.open(lift_file).cameras


def test_pictures_have_the_size_of_the_view(lift_file: Path) -> None:
    scene = QueryScene.open(lift_file)
    seen = view_mask(scene, ask(scene, "x", Axes()), "front")
    assert overlay(render(scene, "front"), seen.mask.numpy()).shape == (30, 40, 3)
    contents = {
        "L": [mask_png(seen)],
        "RGB": [attention_png(seen), render_png(scene, "front")],
    }
    for mode, pictures in contents.items():
        for content in pictures:
            with Image.open(io.BytesIO(content)) as picture:
                assert (picture.size, picture.mode) == ((40, 30), mode)
    with Image.open(io.BytesIO(mask_png(seen))) as picture:
        assert np.array_equal(np.asarray(picture) > 0, seen.mask.numpy())


def test_colours_follow_the_spherical_harmonics() -> None:
    camera = look_at("v", np.array([0.0, 0.0, -3.0]), 8, 8, 8.0)
    plain = random_splats(0, 5)
    grey = Splats(plain.means, plain.quats, plain.log_scales, plain.opacity_logits, sh=torch.zeros(5, 16, 3))
    assert torch.allclose(seen_colours(grey, camera), torch.tensor(0.5))
    assert plain.sh is not None
    expected = (0.5 + SH_C0 * plain.sh[:, 0]).clamp_min(0)
    torch.testing.assert_close(seen_colours(plain, camera), expected)


def test_spherical_beta_lobes_add_to_the_base_colour() -> None:
    camera = look_at("v", np.array([0.0, 0.0, -3.0]), 8, 8, 8.0)
    bare = random_splats(0, 5, kernel=Kernel.BETA)
    rng = np.random.default_rng(0)
    lobes = rng.normal(0, 1, (5, 2, 6)).astype(np.float32)
    splats = replace(bare, sb_params=torch.from_numpy(lobes))
    expected = np.zeros((5, 3))
    for p in range(5):
        direction = bare.means[p].double().numpy() - np.array([0.0, 0.0, -3.0])
        direction /= np.linalg.norm(direction)
        assert bare.sh is not None
        expected[p] = 0.5 + SH_C0 * bare.sh[p, 0].double().numpy()
        for r, g, b, theta, phi, beta in lobes[p].astype(np.float64):
            axis = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
            sharpness = 10 * np.log(2)
            colour = np.log1p(np.exp(sharpness * np.array([r, g, b]))) / sharpness
            expected[p] += colour * max(0.0, axis @ direction) ** (4 * np.exp(beta))
    torch.testing.assert_close(
        seen_colours(splats, camera), torch.from_numpy(expected.clip(0)).float(), atol=1e-5, rtol=1e-5
    )
    wild = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1e4]).expand(5, 1, 6).contiguous()
    for sign in (1, -1):
        assert seen_colours(replace(bare, sb_params=wild * sign), camera).isfinite().all()


def test_the_harmonics_are_orthonormal_on_the_sphere() -> None:
    from liftcore.query.colours import _sh_basis

    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(200_000, 3, generator=generator), dim=1)
    basis = _sh_basis(directions, 3).double()
    gram = 4 * torch.pi * (basis.T @ basis) / len(basis)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=0.03, rtol=0)


def test_clusters_are_shown_in_their_colours_and_the_rest_in_grey(lift_file: Path, tmp_path: Path) -> None:
    plain = load_lift(lift_file)
    clusters = (torch.arange(COUNT) % 3 - 1).to(torch.int32)
    save_lift(replace(plain, cluster=clusters, cluster_features=torch.ones(2, 3).half()), tmp_path / "clustered")
    scene = QueryScene.open(tmp_path / "clustered")
    shown = render(scene, "front", "cluster")
    labels = scene.raster.strongest_labels(scene.cameras["front"], clusters, scene.walk).numpy()
    met = scene.raster.row_sums(scene.cameras["front"], scene.walk).numpy() > 0
    assert {-1, 0, 1} == set(labels[met].tolist())
    for label, colour in zip((0, 1, -1), cluster_colours(2), strict=True):
        assert (shown[met & (labels == label)] == colour).all()
    assert not shown[~met].any()


def test_many_clusters_have_colours_that_can_be_told_apart() -> None:
    colours = cluster_colours(24).astype(int)
    assert colours.shape == (25, 3) and tuple(colours[-1]) == NO_CLUSTER_COLOUR
    apart = np.abs(colours[:, None] - colours[None]).max(axis=2)[~np.eye(25, dtype=bool)]
    assert apart.min() >= 16


def test_a_lift_without_clusters_cannot_show_them(lift_file: Path) -> None:
    with pytest.raises(InvalidQuery, match="aggregation"):
        render_png(QueryScene.open(lift_file), "front", "cluster")
