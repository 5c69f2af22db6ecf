"""A lift by tuples of labels is the lift by their rows: the same closed form with fewer entries."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.solve.codebook import Codebook, ViewCodebook, as_regions
from liftcore.values.region_weights import RegionWeights, stacked
from liftcore.values.views import NO_LABEL, FeatureGrid, Regions
from tests.scenes import random_camera, random_splats
from tests.unit.solve.one_piece import solve

SIZE = 48
RASTER = CpuRaster(random_splats(7, 60), threads=1)
CAMERA = random_camera(3, SIZE, SIZE)


def region_map(seed: int, levels: int, size: float = 1.0, kind: torch.dtype = torch.float32) -> Regions:
    """Blobs, each level coarser than the one before; some lack labels. Rows of many lengths."""
    rng = np.random.default_rng(seed)
    blobs = np.repeat(np.repeat(rng.integers(0, 9, (6, 6)), 4, axis=0), 4, axis=1)
    levels_labels = [np.where(rng.random(9) < 0.8, np.arange(9) // (level + 1), NO_LABEL) for level in range(levels)]
    rows = rng.normal(size=(9, 40)) * rng.uniform(0.1, 1.0, (9, 1)) * size
    return Regions(
        torch.from_numpy(np.stack(levels_labels)[:, blobs].astype(np.int32)), torch.from_numpy(rows).to(kind)
    )


def stacked_weights(maps: list[Regions], by_rows: bool, power: int = 1) -> tuple[RegionWeights, Codebook]:
    """Return W of the maps seen by one camera, and the codebook of its regions."""
    pairs = [as_regions(observation, by_rows) for observation in maps]
    weighting = Weighting(power)
    parts = [
        codebook.weights_by_row(RASTER.region_weights(CAMERA, regions, CompositingParams(), weighting))
        for regions, codebook in pairs
    ]
    return stacked(parts, RASTER.splats.count), Codebook([codebook for _, codebook in pairs])


def solved(
    maps: list[Regions], by_rows: bool, power: int = 1, dtype=torch.float32
) -> tuple[torch.Tensor, torch.Tensor]:
    W, codebook = stacked_weights(maps, by_rows, power)
    return solve(W, codebook, dtype), W.row_sums()


@given(st.integers(0, 2**31), st.integers(2, 4), st.sampled_from([1, 2]), st.sampled_from([1e-30, 1.0, 1e14]))
def test_tuples_give_what_rows_give(seed, levels, power, size):
    maps = [region_map(seed + view, levels, size) for view in range(2)]
    (rows, sums), (tuples, fewer_sums) = (solved(maps, by_rows, power) for by_rows in (True, False))
    np.testing.assert_allclose(fewer_sums, sums, rtol=1e-6)
    np.testing.assert_allclose(tuples / size, rows / size, atol=1e-5)


def test_a_map_is_left_as_it_is_where_tuples_save_nothing():
    noise = Regions(
        torch.randint(0, 7, (2, 30, 30), generator=torch.manual_seed(0), dtype=torch.int32), torch.ones(7, 3)
    )
    none = Regions(torch.full((2, 4, 4), NO_LABEL, dtype=torch.int32), torch.ones(1, 3))
    for observation in (noise, none, region_map(0, 1), FeatureGrid(torch.ones(2, 2, 3))):
        regions, codebook = as_regions(observation, by_rows=False)
        assert (
            regions is observation and codebook.tuples is None and codebook.regions == observation.codebook.shape[0]
        )
    assert as_regions(region_map(0, 3), by_rows=True)[1].tuples is None


@pytest.mark.parametrize("levels", [2, 3, 7])
def test_the_mean_of_the_largest_numbers_is_one_of_them(levels):
    largest = torch.finfo(torch.float32).max
    codebook = ViewCodebook(torch.full((3, 2), largest), torch.ones(1, levels, dtype=torch.int32))
    torch.testing.assert_close(codebook.means(codebook.rows), torch.full((1, 2), largest))
