"""Promises of the GPU backend beyond the conformance suite (tests/properties/test_raster_conformance.py)."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch

from liftcore.errors import Unavailable
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.gpu.tiles import Frame
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.values.region_weights import RegionWeights
from tests.backends import gpu_raster, needs_triton
from tests.scenes import random_camera, random_grid, random_regions, random_splats

if TYPE_CHECKING:
    from liftcore.raster.gpu.raster import GpuRaster
    from liftcore.scene.cameras import Camera

pytestmark = [needs_triton, pytest.mark.usefixtures("every_kernel")]
PARAMS = CompositingParams(opacity_logit_scale=1.2)


FULL = RuntimeError("Triton Error [CUDA]: out of memory")  # the driver's word for it


def as_parts(weights: RegionWeights) -> list[torch.Tensor]:
    return list(weights.tensors().values())


def every_product(raster: GpuRaster, camera: Camera) -> list[torch.Tensor]:
    """Return one of each product, of a scene of 16 splats; weights of the top two take two passes."""
    pixels = torch.tensor([[16, 35], [0, 0], [10, 20], [1, 0]], dtype=torch.int32)
    rows = raster.ray_rows(camera, pixels, PARAMS)
    return [
        *as_parts(raster.region_weights(camera, random_grid(8), PARAMS, Weighting(1, top_k=2))),
        *as_parts(raster.region_weights(camera, random_regions(8), PARAMS, Weighting(2))),
        rows.indptr, rows.splats, rows.weights,
    ]  # fmt: skip


def test_no_bit_depends_on_the_size_of_blocks(monkeypatch):
    """Blocks of splats, bands of tile rows, runs of tiles and parts of sums, all as small as they go."""
    splats, camera = random_splats(8, 16), random_camera(8, 17, 36)
    monkeypatch.setattr("liftcore.raster.gpu.tiles.UNIT", 1)
    monkeypatch.setattr("liftcore.raster.gpu.weights.RUN", 3)
    expected = every_product(gpu_raster(splats), camera)
    tight = gpu_raster(splats, block=1)
    for first, second in zip(expected, every_product(tight, camera), strict=True):
        assert first.numel() and torch.equal(first, second)
    frame = tight._frame(camera, PARAMS)
    assert frame.bands == [(0, 1), (1, 2), (2, 3)]
    assert [len(frame.tile_runs(frame.lists_of(band))) for band in frame.bands] == [2, 2, 2]


def test_memory_that_runs_out_halves_the_block(monkeypatch):
    """On a GPU with less free memory than a block needs, smaller blocks give the same result."""
    splats, camera = random_splats(8, 24), random_camera(8, 20, 36)
    expected = every_product(gpu_raster(splats), camera)
    tries = []

    def crowded(*arguments: Any) -> Frame:
        tries.append(arguments[-1])
        if len(tries) < 3:
            raise (torch.OutOfMemoryError("CUDA out of memory.") if len(tries) == 1 else FULL)
        return Frame(*arguments)

    monkeypatch.setattr("liftcore.raster.gpu.raster.Frame", crowded)
    for first, second in zip(expected, every_product(gpu_raster(splats, block=1 << 20), camera), strict=True):
        assert torch.equal(first, second)
    assert tries == [1 << 20, 1 << 19, 1 << 18]


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


def test_memory_that_runs_out_for_good_is_an_error_in_words(monkeypatch):
    def full(*_arguments: object) -> None:
        raise FULL

    raster = gpu_raster(random_splats(0, 4))
    monkeypatch.setattr("liftcore.raster.gpu.raster.Frame", full)
    with pytest.raises(Unavailable, match="projected splats and tile lists of a view") as raised:
        every_product(raster, random_camera(0))
    assert raised.value.got == str(FULL) and raised.value.hint
    monkeypatch.setattr("liftcore.raster.gpu.raster.Frame", lambda *_: broken())
    with pytest.raises(RuntimeError, match="illegal"):  # an error that is no lack of memory is not reported as one
        every_product(raster, random_camera(0))


def broken() -> None:
    raise RuntimeError("Triton Error [CUDA]: an illegal memory access was encountered")


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


def test_nothing_else_loads_triton():
    modules = "liftcore.lifting.pipeline, liftcore.raster.cpu.raster, liftcore.cli"
    code = f"import sys, {modules}; print('triton' in sys.modules)"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    assert process.stdout.strip() == "False"
