"""A real room: rays are as full as its training measured."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
import torch

from liftcore.io.cameras import read_cameras
from liftcore.io.splats import read_splats
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.compositing import CompositingParams

if TYPE_CHECKING:
    from pathlib import Path


SAMPLE = 8  # views


def test_rays_are_as_full_as_the_training_measured(shared_data: Path) -> None:
    plush = shared_data / "plush"
    stats, cameras = json.loads((plush / "stats.json").read_text()), read_cameras(plush / "cameras.json")
    raster, names = CpuRaster(read_splats(plush / "point_cloud.ply")), sorted(cameras)[:: len(cameras) // SAMPLE]
    sums = torch.stack([raster.row_sums(cameras[name], CompositingParams()) for name in names])
    assert float(sums.mean()) == pytest.approx(stats["row_sum_mean"], abs=1e-3)  # of all views
    assert float(sums.std()) == pytest.approx(stats["row_sum_std"], abs=2e-2)
    assert float(sums.max()) <= 1 + 1e-5
