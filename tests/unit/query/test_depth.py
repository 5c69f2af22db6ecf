"""How far a scene is: the mean depth of what a ray meets, and a picture that can be read back."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from liftcore.io.input_files import InputFile
from liftcore.query.depth import expected_depth, shown_depth
from liftcore.query.pictures import render_png
from liftcore.query.scene import QueryScene
from liftcore.raster.base import CompositingParams
from liftcore.raster.reference import ReferenceRaster
from liftcore.result import LiftMetadata, LiftResult
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Kernel, Splats
from liftcore.settings import LiftSettings
from tests.scenes import random_camera, random_splats

NEAR, FAR = 2.0, 5.0


def scene_of(splats: Splats, camera: Camera) -> QueryScene:
    """A lift of nothing, over those splats and that camera."""
    none = InputFile(path="nowhere", sha256="")
    metadata = LiftMetadata(
        version="0", settings=LiftSettings.of(), splats=none, cameras=none, features=(), encoder="none",
        text_space="none", views=(), certificate={}, timings={},
    )  # fmt: skip
    ones = torch.ones(splats.count)
    scene = QueryScene(LiftResult(torch.ones(splats.count, 1), ones, ones, ones > 0, metadata), Path("nowhere"))
    scene.__dict__.update(splats=splats, cameras=Cameras((camera,)))
    return scene


@pytest.fixture
def two() -> QueryScene:
    """Two opaque balls side by side before a camera, one near and one far, and nothing between them."""
    pose = np.eye(4)
    pose[2, 3] = 1.0  # the camera stands at z = -1
    splats = Splats(
        means=torch.tensor([[-0.9, 0.0, NEAR - 1], [2.2, 0.0, FAR - 1]]),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        log_scales=torch.tensor([[0.12] * 3, [0.3] * 3]).log(),
        opacity_logits=torch.full((2,), 4.0),
    )
    return scene_of(splats, Camera.pinhole("front", 48, 24, 24.0, 24.0, 24.0, 12.0, pose))


def test_what_is_near_is_bright_and_what_is_nowhere_is_black(two: QueryScene) -> None:
    depths, covered = expected_depth(two, "front")
    shown = shown_depth(two, "front")
    assert shown.span == pytest.approx((NEAR, FAR), abs=1e-5)
    assert torch.allclose(depths[12, 13], torch.tensor(NEAR)) and torch.allclose(depths[12, 34], torch.tensor(FAR))
    assert (shown.levels[12, 13], shown.levels[12, 34], shown.levels[0, 0]) == (255, 1, 0)
    assert not covered[0, 0] and not depths[0, 0]
    assert np.array_equal(shown.levels > 0, covered.numpy())


@pytest.mark.parametrize("kernel", Kernel)
@pytest.mark.usefixtures("every_kernel")
def test_depth_is_the_weighted_mean_of_what_the_ray_meets(kernel: Kernel) -> None:
    splats, camera = random_splats(5, 40, kernel=kernel), random_camera(5)
    depths, covered = expected_depth(scene_of(splats, camera), "v0")
    pixels = torch.tensor([(x, y) for y in range(camera.height) for x in range(camera.width)], dtype=torch.int32)
    rows = ReferenceRaster(splats).ray_rows(camera, pixels, CompositingParams())
    z = splats.means.double() @ torch.from_numpy(camera.viewmat[2, :3].copy()) + camera.viewmat[2, 3]
    expected = torch.zeros(len(pixels), dtype=torch.float64)
    weighed = torch.zeros(len(pixels), dtype=torch.float64)
    for i in range(len(pixels)):
        met = slice(int(rows.indptr[i]), int(rows.indptr[i + 1]))
        weights = rows.weights[met].double()
        weighed[i] = weights.sum()
        expected[i] = (weights * z[rows.splats[met].long()]).sum() / weighed[i] if len(weights) else 0.0
    solid = (weighed.reshape(depths.shape) > 0.05) & covered  # at a cut-off a faint ray may meet one splat or none
    assert int(solid.sum()) > (90 if kernel is Kernel.BETA else 300)
    close = (depths.double() - expected.reshape(depths.shape)).abs()[solid] < 1e-3
    assert float(close.double().mean()) > 0.995


def test_a_picture_tells_its_depths_and_can_be_read_back(two: QueryScene) -> None:
    depths, covered = expected_depth(two, "front")
    with Image.open(io.BytesIO(render_png(two, "front", "depth"))) as picture:
        near, far = (float(picture.info[name]) for name in ("depth-near", "depth-far"))
        levels = np.asarray(picture)
    assert (near, far) == shown_depth(two, "front").span
    read = torch.from_numpy(far + (levels - 1.0) / 254 * (near - far))
    torch.testing.assert_close(
        read[covered], depths[covered].double().clamp(near, far), atol=0.51 * (far - near) / 254, rtol=0
    )


def test_a_flat_scene_is_bright_and_an_empty_view_says_nothing(two: QueryScene) -> None:
    splats, camera = two.splats, two.cameras["front"]
    one = Splats(splats.means[:1], splats.quats[:1], splats.log_scales[:1], splats.opacity_logits[:1])
    flat = shown_depth(scene_of(one, camera), "front")
    assert set(np.unique(flat.levels)) == {0, 255}
    behind = np.eye(4)
    behind[2, 3] = -100.0
    away = scene_of(one, Camera.pinhole("front", 48, 24, 24.0, 24.0, 24.0, 12.0, behind))
    assert shown_depth(away, "front").span is None
    with Image.open(io.BytesIO(render_png(away, "front", "depth"))) as picture:
        assert not np.asarray(picture).any() and "depth-near" not in picture.info
