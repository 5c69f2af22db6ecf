"""Views with long tile lists are rasterized in bands of tiles, with the same results."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.raster.cpu import tiles
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.compositing import CompositingParams, Selection, Weighting
from liftcore.scene.splats import Kernel
from tests.scenes import random_camera, random_grid, random_regions, random_splats

pytestmark = pytest.mark.slow

MAX_BAND_ITEMS = 120  # items of a band
CAMERA = random_camera(3, 100, 70)
PIXELS = torch.tensor([[x, y] for x in range(0, 100, 7) for y in range(0, 70, 5)], dtype=torch.int32)


@pytest.fixture
def cut(monkeypatch):
    """Divide each view into bands."""
    monkeypatch.setattr(tiles, "MOST_LISTED", 4)
    monkeypatch.setattr(tiles, "BAND_ITEMS", MAX_BAND_ITEMS)


def products(raster: CpuRaster) -> dict[str, tuple[torch.Tensor, ...]]:
    """Return the products that are computed tile by tile."""
    rng = np.random.default_rng(0)
    count, params = raster.splats.count, CompositingParams(opacity_logit_scale=1.2)
    values = torch.tensor(rng.normal(0, 1, (count, 35)), dtype=torch.float32)
    labels = torch.tensor(rng.integers(-1, 4, count), dtype=torch.int32)
    rows = raster.ray_rows(CAMERA, PIXELS, params)
    return {
        "render": (raster.render(CAMERA, values, params),),
        "labels": (raster.strongest_labels(CAMERA, labels, params),),
        "rows": (rows.indptr, rows.splats, rows.weights),
    }


def weights_of(raster: CpuRaster, weighting: Weighting) -> list[tuple[torch.Tensor, ...]]:
    """Return region weights of labels on two levels, and of a grid with a stride."""
    cases = (
        (random_regions(3), CompositingParams(opacity_logit_scale=1.2)),
        (random_grid(3), CompositingParams(stride=2, offset=(1, 0))),
    )
    weights = [raster.region_weights(CAMERA, observation, params, weighting) for observation, params in cases]
    return [
        (w.splats, w.indptr, w.region, w.total_weight_splats, w.weight, w.total_weight) for w in weights
    ]  # the first four are identical, the others are summed in another order


@pytest.mark.parametrize("kernel", Kernel)
def test_banded_images_labels_and_rays_are_the_same_to_the_bit(kernel, cut, monkeypatch):
    splats = random_splats(3, 300, kernel=kernel)
    banded = CpuRaster(splats, threads=2)
    assert len(list(banded._bands(CAMERA, CompositingParams()))) > 2
    actual = products(banded)
    monkeypatch.undo()
    expected = products(CpuRaster(splats, threads=2))
    assert expected["rows"][2].numel() > 400
    for name, parts in expected.items():
        assert all(torch.equal(a, b) for a, b in zip(actual[name], parts, strict=True)), name


@pytest.mark.parametrize("selection", [Selection.ALL, Selection.TOP_K])
def test_weights_and_the_adjoint_are_summed_over_bands(selection, cut, monkeypatch):
    splats, weighting = random_splats(4, 300), Weighting(1, selection)
    image = torch.tensor(np.random.default_rng(1).normal(0, 1, (70, 100, 35)), dtype=torch.float32)
    banded, adjoint = (
        weights_of(CpuRaster(splats, 2), weighting),
        CpuRaster(splats, 2).adjoint(CAMERA, image, CompositingParams()),
    )
    single_threaded = weights_of(CpuRaster(splats, 1), weighting)
    monkeypatch.undo()
    unbanded = weights_of(CpuRaster(splats, 2), weighting)
    for actual, rerun, expected in zip(banded, single_threaded, unbanded, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(actual, rerun, strict=True))  # whatever the threads
        assert all(torch.equal(a, b) for a, b in zip(actual[:4], expected[:4], strict=True))
        for a, b in zip(actual[4:], expected[4:], strict=True):
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(
        adjoint, CpuRaster(splats, 2).adjoint(CAMERA, image, CompositingParams()), rtol=1e-4, atol=1e-4
    )


def test_a_band_holds_no_more_than_it_may(cut):
    frames = list(CpuRaster(random_splats(5, 300), threads=1)._bands(CAMERA, CompositingParams()))
    lengths = np.array([np.diff(frame.starts) for frame in frames])
    assert ((lengths > 0).sum(axis=0) <= 1).all()  # each tile in one band
    assert all(band.sum() <= MAX_BAND_ITEMS or np.count_nonzero(band) == 1 for band in lengths)
    assert len(frames) < lengths.shape[1]  # and not each by itself


@pytest.mark.parametrize("threads", [1, 3])
def test_a_view_is_cut_where_all_its_lists_together_are_too_long(threads, monkeypatch):
    raster = CpuRaster(random_splats(5, 300), threads)
    (frame,), (cached_frame,) = raster._bands(CAMERA, CompositingParams()), raster._bands(CAMERA, CompositingParams())
    assert frame is cached_frame
    for limit, cut in ((len(frame.items), False), (len(frame.items) - 1, True), (0, True)):
        monkeypatch.setattr(tiles, "MOST_LISTED", limit)
        afresh = CpuRaster(raster.splats, threads)
        assert (afresh._bands(CAMERA, CompositingParams())._single_frame is None) is cut
