"""A real room: its files agree, and disagree where one is broken; rays are full, features like the encoder's."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from liftcore.io.cameras import read_cameras
from liftcore.io.splats import read_splats
from liftcore.lifting.files import lift_files
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.cameras import Cameras
from liftcore.scene.compositing import CompositingParams
from liftcore.values.pack import read_features
from liftcore.values.settings import LiftSettings
from liftcore.values.views import FeatureGrid

if TYPE_CHECKING:
    from pathlib import Path

    from torch import Tensor

    from liftcore.scene.cameras import Camera

SAMPLE = 8  # views
CHANNELS = 5  # every fifth of 320
HELD_OUT = ("20240212_003919", "20240212_003927", "20240212_003936")


@pytest.fixture(scope="module")
def plush(shared_data: Path) -> Path:
    return shared_data / "plush"


@pytest.fixture(scope="module")
def cameras(plush: Path) -> Cameras:
    return read_cameras(plush / "cameras.json")


@pytest.fixture(scope="module")
def raster(plush: Path) -> CpuRaster:
    return CpuRaster(read_splats(plush / "point_cloud.ply"))


def test_rays_are_as_full_as_the_training_measured(plush, cameras, raster):
    stats = json.loads((plush / "stats.json").read_text())
    names = sorted(cameras)[:: len(cameras) // SAMPLE]
    sums = torch.stack([raster.row_sums(cameras[name], CompositingParams()) for name in names])
    assert float(sums.mean()) == pytest.approx(stats["row_sum_mean"], abs=1e-3)  # of all views
    assert float(sums.std()) == pytest.approx(stats["row_sum_std"], abs=2e-2)
    assert float(sums.max()) <= 1 + 1e-5


def test_lifted_cnn_features_render_like_those_of_unseen_photos(plush, cameras, raster):
    # Cells side by side have a cosine of 0.89, those of other things about 0.4: the right cells must be met, not
    # their mirror images.
    settings = LiftSettings.of(preset="row-sum", diagnostic_rays=0, view_stride=12, stride=3)
    paths = [plush / name for name in ("point_cloud.ply", "cameras.json", "grids.safetensors")]
    features = lift_files(paths[0], paths[1], paths[2:], settings).features
    held_out, means = read_features(plush / "grids_test.safetensors"), []
    for name in HELD_OUT:
        observed = held_out[name]
        assert isinstance(observed, FeatureGrid)
        grid = observed.grid[..., ::CHANNELS]
        image = raster.render(quarter(cameras[name]), features[:, ::CHANNELS].float(), settings.compositing)
        cosines = [cosine_with(image, cells) for cells in (grid, grid.flip(1), grid.flip(0))]
        assert cosines[0] > max(cosines[1:]) + 0.2
        means.append(cosines[0])
    assert np.mean(means) > 0.77  # .795


def quarter(camera: Camera) -> Camera:
    """The camera with a quarter of its rows and columns: a cell of the encoder is 8 x 8 of these pixels."""
    sizes = {"width": camera.width // 4, "height": camera.height // 4}
    return camera.replace(**sizes, **{name: getattr(camera, name) / 4 for name in ("fx", "fy", "cx", "cy")})


def cosine_with(image: Tensor, grid: Tensor) -> float:
    """Mean cosine of an image [H, W, F], read at the centres of the grid's cells, with the grid [h, w, F]."""
    rows, columns = grid.shape[:2]
    y = ((torch.arange(rows) + 0.5) * image.shape[0] / rows).long()
    x = ((torch.arange(columns) + 0.5) * image.shape[1] / columns).long()
    return float(torch.cosine_similarity(image[y][:, x], grid.float(), dim=2).mean())
