"""Promises of the GPU backend beyond the conformance suite (tests/properties/test_raster_conformance.py)."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.values.region_weights import RegionWeights
from tests.backends import gpu_raster, needs_triton
from tests.scenes import random_camera, random_grid, random_regions, random_splats

if TYPE_CHECKING:
    from liftcore.raster.gpu.raster import GpuRaster
    from liftcore.scene.cameras import Camera

pytestmark = [needs_triton, pytest.mark.usefixtures("every_kernel")]
PARAMS = CompositingParams(opacity_logit_scale=1.2)


def as_parts(weights: RegionWeights) -> list[torch.Tensor]:
    return list(weights.tensors().values())


def every_product(raster: GpuRaster, camera: Camera) -> list[torch.Tensor]:
    """Return one of each product, of a scene of 16 splats."""
    pixels = torch.tensor([[16, 35], [0, 0], [10, 20], [1, 0]], dtype=torch.int32)
    rows = raster.ray_rows(camera, pixels, PARAMS)
    return [
        *as_parts(raster.region_weights(camera, random_grid(8), PARAMS, Weighting(1))),
        *as_parts(raster.region_weights(camera, random_regions(8), PARAMS, Weighting(2))),
        rows.indptr, rows.splats, rows.weights,
    ]  # fmt: skip


def test_a_view_in_many_launches_is_a_view_in_one(monkeypatch):
    splats, camera = random_splats(8, 16), random_camera(8, 17, 36)
    expected = every_product(gpu_raster(splats), camera)
    monkeypatch.setattr("liftcore.raster.gpu.weights.FLOATS_AT_ONCE", 1)
    monkeypatch.setattr("liftcore.raster.gpu.weights.RUN", 3)
    for first, second in zip(expected, every_product(gpu_raster(splats), camera), strict=True):
        assert first.numel() and torch.allclose(first, second, rtol=1e-6)


def test_depth_ties_keep_the_order_of_the_file():
    splats, camera = random_splats(2, 20), random_camera(2, 20, 20)
    coincident = replace(splats, means=torch.zeros(20, 3), opacity_logits=torch.linspace(-2, 1, 20))
    pixel = torch.tensor([[10, 10]], dtype=torch.int32)
    actual, expected = (
        raster.ray_rows(camera, pixel, CompositingParams())
        for raster in (gpu_raster(coincident), CpuRaster(coincident))
    )
    assert actual.splats.numel() > 2
    assert torch.equal(actual.splats, expected.splats)
    assert torch.equal(actual.splats, torch.sort(actual.splats).values)


def test_a_view_that_sees_nothing_gives_empty_products():
    splats, camera = random_splats(1, 5), random_camera(1, 20, 18)
    away = replace(camera, viewmat=np.diag([-1.0, 1.0, -1.0, 1.0]) @ camera.viewmat)
    raster = gpu_raster(splats)
    weights = raster.region_weights(away, random_regions(1), PARAMS, Weighting(1, top_k=1))
    assert [part.numel() for part in as_parts(weights)] == [0, 1, 0, 0, 0, 0, 2]
    rows = raster.ray_rows(away, torch.zeros(2, 2, dtype=torch.int32), CompositingParams())
    assert rows.indptr.tolist() == [0, 0, 0]


def test_more_levels_than_one_key_holds_are_distinguished():
    """Nine levels of 200 rows make 2e20 tuples."""
    splats, camera = random_splats(3, 20), random_camera(3, 20, 17)
    regions = random_regions(3, levels=9, rows=200)
    actual, expected = (
        raster.region_weights(camera, regions, CompositingParams(), Weighting())
        for raster in (gpu_raster(splats), CpuRaster(splats, threads=1))
    )
    assert torch.equal(actual.region, expected.region)
    assert torch.allclose(actual.weight, expected.weight, rtol=1e-4)


def test_without_a_card_or_the_interpreter_the_backend_says_so():
    code = """if True:
        import torch
        from liftcore.raster.gpu.raster import GpuRaster
        from tests.scenes import random_splats
        for name in ("cpu", "cuda") if not torch.cuda.is_available() else ("cpu",):
            try:
                GpuRaster(random_splats(0, 4), torch.device(name))
            except Exception as error:
                print(type(error).__name__, error)
    """
    process = subprocess.run(
        [sys.executable, "-c", code], env={"PATH": "", "HOME": "/nonexistent", "PYTHONPATH": ":".join(sys.path)},
        capture_output=True, text=True, timeout=300, check=True,
    )  # fmt: skip
    lines = process.stdout.splitlines()
    assert lines and all(line.startswith("Unavailable device: expected a CUDA device") for line in lines)
