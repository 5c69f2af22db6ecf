"""A scene and its answers seen from a camera: masks, colours, depths, in the pixels of the photo."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from liftcore.errors import InvalidQuery
from liftcore.query import scene as scenes
from liftcore.query.ask import ask
from liftcore.query.colours import cluster_colours
from liftcore.query.objects import objects
from liftcore.query.question import Query
from liftcore.query.render import expected_depth, render, render_png, shown_depth, view_mask
from liftcore.query.scene import Scene
from liftcore.query.splat_colours import principal_colours, view_colours
from liftcore.query.terms import Vector
from liftcore.raster.reference import ReferenceRaster, dense_view
from liftcore.scene.cameras import Camera, Cameras, behind_lens, drawn_by
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.distortion import Fisheye
from liftcore.scene.drawing import in_photo
from liftcore.scene.harmonics import SH_C0
from liftcore.scene.splats import Kernel, Splats
from tests.promises.tiny_files import write_lift
from tests.scenes import look_at, random_camera, random_splats
from tests.tiny_scene import AXES, HEIGHT, SPLATS_A_CLUSTER, WIDTH

from .made_up import answer_with
from .test_objects import of


@pytest.fixture(scope="module")
def lifted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny scene lifted with a scale of the opacity logits."""
    return write_lift(tmp_path_factory.mktemp("tikhonov"), preset="tikhonov")


@pytest.fixture
def scene(lifted: Path) -> Scene:
    return Scene(lifted)


def mostly(scene: Scene, members: np.ndarray) -> np.ndarray:
    """Return [H, W] bool by the oracle: these splats have at least half of a ray that hits the scene."""
    camera, oracle = scene.cameras["middle"], ReferenceRaster(scene.splats)
    weights = oracle.render(camera, torch.from_numpy(members).float()[:, None], scene.compositing)[..., 0]
    row_sums = oracle.row_sums(camera, scene.compositing)
    assert not ((weights / row_sums.clamp_min(1e-9) - 0.5).abs() < 1e-5).any()  # no pixel is in doubt
    return ((row_sums >= 0.5) & (weights >= 0.5 * row_sums)).numpy()


def test_a_mask_is_where_objects_have_most_of_a_ray(scene: Scene) -> None:
    answer = of(scene, 0, 2)
    in_view = view_mask(scene, answer, "middle")
    assert in_view.mask.shape == (HEIGHT, WIDTH)
    assert np.array_equal(in_view.mask, mostly(scene, answer.selected))
    assert "2 objects that were f" in in_view.explanation
    largest = view_mask(scene, answer_with(answer, keep="largest"), "middle")
    assert np.array_equal(largest.mask, mostly(scene, objects(scene, answer).numbers == 0))
    assert 0 < int(largest.mask.sum()) < int(in_view.mask.sum())
    empty = view_mask(scene, of(scene), "middle")
    assert not empty.mask.any() and "the 0 objects that were found" in empty.explanation


def test_of_very_many_splats_all_are_shown(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = of(scene, 0, 1)
    monkeypatch.setattr("liftcore.query.render.MOST_GROUPED", answer.count - 1)
    assert "too many to group" in view_mask(scene, answer, "middle").explanation
    assert "the 1 object that" in view_mask(scene, answer_with(answer, keep="largest"), "middle").explanation


def test_clusters_have_their_colours_and_the_rest_is_grey(scene: Scene) -> None:
    with pytest.raises(InvalidQuery, match="aggregation"):
        render_png(scene, "middle", "cluster")
    clusters = (torch.arange(3 * SPLATS_A_CLUSTER) // SPLATS_A_CLUSTER - 1).to(torch.int32)
    features = torch.ones(2, scene.channels, dtype=scene.lift.features.dtype)
    clustered = Scene(replace(scene.lift, cluster=clusters, cluster_features=features))
    image = render(clustered, "middle", "cluster")
    labels = scene.raster.strongest_labels(scene.cameras["middle"], clusters, scene.compositing).numpy()
    hit = scene.raster.row_sums(scene.cameras["middle"], scene.compositing).numpy() > 0
    assert {-1, 0, 1} == set(labels[hit].tolist())
    for label, colour in zip((0, 1, -1), cluster_colours(2), strict=True):
        assert (image[hit & (labels == label)] == colour).all()
    assert not image[~hit].any()


def test_pictures_have_a_limit(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = ask(scene, Query.of((Vector(tuple(AXES[0])),)))

    def draw(channel: str) -> object:
        return view_mask(scene, answer, "middle") if channel == "mask" else render_png(scene, "middle", channel)

    for channel in ("mask", "rgb", "pca", "depth"):
        monkeypatch.setattr(scenes, "MOST_PIXELS", WIDTH * HEIGHT)
        assert draw(channel)
        monkeypatch.setattr(scenes, "MOST_PIXELS", WIDTH * HEIGHT - 1)
        with pytest.raises(InvalidQuery, match=f"{WIDTH}x{HEIGHT}"):
            draw(channel)


def test_colours_of_many_clusters_differ() -> None:
    colours = cluster_colours(24).astype(int)
    distances = np.abs(colours[:, None] - colours).max(axis=2)[~np.eye(25, dtype=bool)]
    assert distances.min() >= 16 and len(set(colours[-1].tolist())) == 1  # the last is grey


def test_colours_follow_the_spherical_harmonics() -> None:
    camera = look_at("v", np.array([0.0, 0.0, -3.0]), 8, 8, 8.0)
    splats = random_splats(0, 5)
    assert torch.equal(view_colours(replace(splats, sh=None), camera), torch.full((5, 3), 0.6))
    grey = Splats(splats.means, splats.quats, splats.log_scales, splats.opacity_logits, sh=torch.zeros(5, 16, 3))
    assert torch.allclose(view_colours(grey, camera), torch.tensor(0.5))
    assert splats.sh is not None
    expected = (0.5 + SH_C0 * splats.sh[:, 0]).clamp_min(0)
    torch.testing.assert_close(view_colours(splats, camera), expected)


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
        view_colours(splats, camera), torch.from_numpy(expected.clip(0)).float(), atol=1e-5, rtol=1e-5
    )
    wild = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1e4]).expand(5, 1, 6).contiguous()
    for sign in (1, -1):
        assert view_colours(replace(bare, sb_params=wild * sign), camera).isfinite().all()


def test_groups_get_distinct_colours_at_every_run() -> None:
    generator = torch.Generator().manual_seed(1)
    group = torch.arange(3000) % 3
    features = (torch.eye(16)[group] + 0.02 * torch.randn(3000, 16, generator=generator)).half()
    features[-1] = 0
    first, second = (principal_colours(features.numpy(), np.ones(3000, np.float32)) for _ in range(2))
    assert torch.equal(first, second)
    assert first.min() >= 0 and first.max() <= 1 and not first[-1].any()
    means = torch.stack([first[:-1][group[:-1] == k].mean(dim=0) for k in range(3)])
    assert torch.pdist(means).min() > 0.4
    assert principal_colours(np.random.rand(10, 2), np.ones(10)).shape == (10, 3)  # of fewer than three channels
    assert not principal_colours(np.random.rand(10, 4), np.zeros(10)).any()  # and without weight


NEAR, FAR = 2.0, 5.0


def scene_of(base: Scene, splats: Splats, camera: Camera) -> Scene:
    """Return a lift of constant features [P, 1], of those splats and that camera."""
    ones = torch.ones(splats.count)
    metadata = base.metadata.model_copy(update={"landmarks": ()})
    lift = replace(
        base.lift, rows=torch.ones(splats.count, 1), total_weight=ones, has_feature=ones > 0, metadata=metadata
    )
    return Scene(lift, splats, Cameras((camera,)))


@pytest.fixture
def two(scene: Scene) -> Scene:
    """Two opaque balls side by side in front of a camera, one near and one far, with empty space between them."""
    pose = np.eye(4)
    pose[2, 3] = 1.0  # the camera stands at z = -1
    splats = Splats(
        means=torch.tensor([[-0.9, 0.0, NEAR - 1], [2.2, 0.0, FAR - 1]]),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        log_scales=torch.tensor([[0.12] * 3, [0.3] * 3]).log(),
        opacity_logits=torch.full((2,), 4.0),
    )
    return scene_of(scene, splats, Camera.pinhole("front", 48, 24, 24.0, 24.0, 24.0, 12.0, pose))


def test_near_depths_are_bright_and_missing_ones_black(two: Scene) -> None:
    depths, hit = expected_depth(two, "front")
    levels, span = shown_depth(two, "front")
    assert span == pytest.approx((NEAR, FAR), abs=1e-5)
    assert depths[12, [13, 34]].tolist() == pytest.approx([NEAR, FAR], rel=1e-5)
    assert (levels[12, 13], levels[12, 34], levels[0, 0]) == (255, 1, 0)
    assert not hit[0, 0] and not depths[0, 0]
    assert np.array_equal(levels > 0, hit)


@pytest.mark.parametrize("kernel", Kernel)
@pytest.mark.usefixtures("every_kernel")
def test_depth_is_the_weighted_mean_along_the_ray(kernel: Kernel, scene: Scene) -> None:
    splats, camera = random_splats(5, 40, kernel=kernel), random_camera(5)
    depths, hit = expected_depth(scene_of(scene, splats, camera), "v0")
    z = splats.means.double().numpy() @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    A = dense_view(splats, camera, CompositingParams()).A
    total_weight = A.sum(axis=1)
    # At a cut-off a faint ray may hit one splat or none.
    solid = (total_weight > 0.05) & hit.ravel()
    assert solid.sum() > (90 if kernel is Kernel.BETA else 300)
    expected = (A @ z)[solid] / total_weight[solid]
    assert (np.abs(depths.ravel()[solid] - expected) < 1e-3).mean() > 0.995


def test_a_depth_picture_has_its_range_and_can_be_decoded(two: Scene) -> None:
    depths, hit = expected_depth(two, "front")
    with Image.open(io.BytesIO(render_png(two, "front", "depth"))) as picture:
        near, far = (float(picture.info[name]) for name in ("depth-near", "depth-far"))
        levels = np.asarray(picture)
    assert (near, far) == shown_depth(two, "front")[1]
    decoded = far + (levels[hit] - 1.0) / 254 * (near - far)
    np.testing.assert_allclose(decoded, depths[hit].clip(near, far), atol=0.51 * (far - near) / 254)


def test_the_rim_that_no_pinhole_sees_is_empty() -> None:
    camera = behind_lens(Camera.pinhole("v", 160, 160, 50.0, 50.0, 80.0, 80.0, np.eye(4)), Fisheye())
    for dtype in (torch.float32, torch.int32):
        picture = in_photo(camera, lambda of, dtype=dtype: torch.ones(of.height, of.width, dtype=dtype))
        assert float(picture[80, 80]) == 1
        assert float(picture[0, 0]) == float(picture[80, 0]) == 0
    assert drawn_by(camera).width < 180
