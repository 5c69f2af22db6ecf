"""A lift by tuples of labels is the lift by their rows: the same closed form with fewer entries."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from liftcore.features.levels import label_tuples
from liftcore.features.views import NO_LABEL, FeatureGrid, Regions
from liftcore.progress import silent
from liftcore.raster.base import CompositingParams, Weighting
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.settings import LiftSettings
from liftcore.solve.closed_form import Solution, solve_closed_form
from liftcore.solve.columns import Columns, by_rows, by_tuples
from liftcore.solve.host import Host
from liftcore.solve.on_device import Place, solve_on_device
from liftcore.solve.totals import row_totals
from tests.scenes import random_camera, random_splats

SIZE = 48
RASTER = CpuRaster(random_splats(7, 60), threads=1)
CAMERA = random_camera(3, SIZE, SIZE)


def region_map(seed: int, levels: int, size: float = 1.0, kind: torch.dtype = torch.float32) -> Regions:
    """Blobs, each level coarser than the one before; some lack labels. Rows of many lengths."""
    rng = np.random.default_rng(seed)
    blobs = np.repeat(np.repeat(rng.integers(0, 9, (6, 6)), 4, axis=0), 4, axis=1)
    named = [np.where(rng.random(9) < 0.8, np.arange(9) // (level + 1), NO_LABEL) for level in range(levels)]
    rows = rng.normal(size=(9, 40)) * rng.uniform(0.1, 1.0, (9, 1)) * size
    return Regions(torch.from_numpy(np.stack(named)[:, blobs].astype(np.int32)), torch.from_numpy(rows).to(kind))


def solved(views, weighting: Weighting, dtype: torch.dtype, on_device: bool = False) -> tuple[Solution, np.ndarray]:
    """X of (observation, columns) of every view, and the denominators."""
    totals, store = np.zeros(RASTER.splats.count), []
    for walked, columns in views:
        store.append(columns.weighted(RASTER.region_weights(CAMERA, walked, CompositingParams(), weighting)))
        totals[store[-1].splats.numpy()] += row_totals(store[-1])
    own = [columns for _, columns in views]
    arguments = (store, own, totals, dtype, silent)
    if on_device:
        return solve_on_device(*arguments, Place(torch.device("cpu"))), totals
    return solve_closed_form(*arguments, Host(1)), totals


@given(st.integers(0, 2**31), st.integers(2, 4), st.sampled_from([1, 2]), st.sampled_from([1e-30, 1.0, 1e14]))
def test_tuples_give_what_rows_give(seed, levels, power, size):
    maps = [region_map(seed + view, levels, size) for view in range(2)]
    rows, sums = solved([(own, Columns(own.codebook)) for own in maps], Weighting(power), torch.float32)
    read = [by_tuples(own) for own in maps]
    assert any(columns.tuples is not None for _, columns in read)
    tuples, fewer = solved(read, Weighting(power), torch.float32)
    np.testing.assert_allclose(fewer, sums, rtol=1e-6)
    np.testing.assert_allclose(tuples.features / size, rows.features / size, atol=1e-5)
    np.testing.assert_allclose(tuples.agreement, rows.agreement, atol=1e-5)


@pytest.mark.parametrize("on_device", [False, True])
def test_means_of_float16_rows_are_rounded_as_the_features_are(on_device):
    own = region_map(3, 4, kind=torch.float16)
    rows, _ = solved([(own, Columns(own.codebook))], Weighting(), torch.float32)
    for dtype, error in ((torch.float32, 1e-6), (torch.float16, 2e-3)):
        tuples, _ = solved([by_tuples(own)], Weighting(), dtype, on_device)
        assert tuples.features.dtype == dtype
        np.testing.assert_allclose(tuples.features, rows.features, atol=error)
        np.testing.assert_allclose(tuples.agreement, rows.agreement, atol=error)


def test_splats_that_no_view_labels_have_zeros_wherever_x_lies():
    own = Regions(torch.full((2, 4, 4), NO_LABEL, dtype=torch.int32), torch.ones(1, 9))
    weights = RASTER.region_weights(CAMERA, own, CompositingParams(), Weighting())

    def used(splats: int, channels: int, dtype: torch.dtype) -> torch.Tensor:
        return torch.full((splats, channels), 7.0, dtype=dtype)

    arguments = ([weights], [Columns(own.codebook)], np.zeros(RASTER.splats.count), torch.float16, silent)
    assert not solve_closed_form(*arguments, Host(1, used)).features.any()
    assert not solve_on_device(*arguments, Place(torch.device("cpu")), used).features.any()


@given(st.integers(0, 2**31), st.integers(1, 4), st.integers(-1, 3))
def test_tuples_are_the_distinct_ones_in_the_order_of_the_pixels(seed, levels, highest):
    labels = np.random.default_rng(seed).integers(-1, highest + 1, (levels, 7, 9)).astype(np.int32)
    numbers, tuples = label_tuples(labels)
    assert len(np.unique(tuples, axis=0)) == len(tuples)
    first = [number for k, number in enumerate(numbers.reshape(-1)) if number not in numbers.reshape(-1)[:k]]
    assert [number for number in first if number != NO_LABEL] == list(range(len(tuples)))
    read = np.append(tuples, np.full((1, levels), NO_LABEL, np.int32), axis=0)[numbers]
    assert np.array_equal(read.transpose(2, 0, 1), labels)


def test_a_map_is_left_as_it_is_where_tuples_save_nothing():
    rng = torch.Generator().manual_seed(0)
    noise = Regions(torch.randint(0, 7, (2, 30, 30), generator=rng, dtype=torch.int32), torch.ones(7, 3))
    none = Regions(torch.full((2, 4, 4), NO_LABEL, dtype=torch.int32), torch.ones(1, 3))
    for own in (noise, none, region_map(0, 1), FeatureGrid(torch.ones(2, 2, 3))):
        walked, columns = by_tuples(own)
        assert walked is own and columns.tuples is None and columns.count == own.codebook.shape[0]


def test_single_regions_count_for_themselves_in_robust_steps_and_when_some_are_dropped():
    assert not by_rows(LiftSettings.of())
    assert by_rows(LiftSettings.of(robust_steps=1))
    assert by_rows(LiftSettings.of(aggregation=True, aggregation_resolve=True))


def test_columns_are_fewer_and_entries_too():
    own = region_map(5, 4)
    walked, columns = by_tuples(own)
    by_row = RASTER.region_weights(CAMERA, own, CompositingParams(), Weighting())
    by_tuple = RASTER.region_weights(CAMERA, walked, CompositingParams(), Weighting())
    assert columns.count == walked.codebook.shape[0] == columns.means(own.codebook).shape[0]
    assert len(by_tuple.columns) < len(by_row.columns)
    assert torch.equal(by_tuple.evidence, by_row.evidence)


def test_the_mean_of_the_largest_numbers_is_one_of_them():
    largest = torch.finfo(torch.float32).max
    for levels in range(2, 20):
        same = Columns(torch.full((3, 2), largest), torch.ones(1, levels, dtype=torch.int32))
        torch.testing.assert_close(same.means(same.codebook), torch.full((1, 2), largest))
