"""Sums over groups of rows of W against plain float64 ones, and properties of the groups."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.solve.directions import RegionDirections, StoredDirections
from liftcore.solve.shared_rows import LONG, compare_rows, flat_table, new_table, sum_rows
from tests.unit.solve.sparse_views import codebook_of

VIEWS, REGIONS = 5, 3 * LONG
VIEW = np.sort(np.arange(REGIONS) % VIEWS)
LEVEL = (np.arange(REGIONS) % 3 // 2).astype(np.int32)
widths = pytest.mark.parametrize("width", [1, 6, 32, 33, 70])


def weights(seed: int) -> np.ndarray:
    """Return rows of W [n, M] f32: similar ones, of few regions, of none, of one view, of more than LONG regions."""
    rng = np.random.default_rng(seed)
    mask = rng.random((23, REGIONS)) < 0.02
    mask[4:8] = mask[4]
    mask[11] = False
    mask[12] &= VIEW == 2
    mask[[0, 9, 10]] = rng.random((3, REGIONS)) < 0.8
    result = (rng.random(mask.shape) * mask).astype(np.float32)
    result[14, VIEW == 1] *= 100.0  # most of the splat
    return result


def sparse(dense: np.ndarray) -> list[np.ndarray]:
    """Indptr, region and weight of rows."""
    rows, region = np.nonzero(dense)
    starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(dense)))])
    return [starts, region.astype(np.int32), dense[rows, region]]


def table_of(width: int) -> torch.Tensor:
    table = new_table(REGIONS, width, torch.device("cpu"))
    return table.copy_(torch.randn(REGIONS, width, generator=torch.manual_seed(width)))


def inverse_of(dense: np.ndarray) -> np.ndarray:
    sums = dense.sum(axis=1, dtype=np.float64)
    return np.divide(1.0, sums, out=np.zeros_like(sums), where=sums > 0)


def summed(rows: np.ndarray, dense: np.ndarray, table: torch.Tensor) -> np.ndarray:
    sums = np.full((rows.size, table.shape[1]), np.nan, np.float32)
    sum_rows(*[rows, *sparse(dense), inverse_of(dense), flat_table(table), table.shape[1], sums])
    return sums


@widths
def test_sums_equal_float64_ones_and_those_of_each_row_alone_to_the_bit(width):
    dense, table, rows = weights(0), table_of(width), np.random.default_rng(1).permutation(23)
    sums = summed(rows, dense, table)
    exact = dense * inverse_of(dense)[:, None] @ table.numpy()
    np.testing.assert_allclose(sums, exact[rows], atol=1e-6)
    for row, result in zip(rows, sums, strict=True):
        assert np.array_equal(summed(np.array([row]), dense, table)[0], result)


def compare(rows: np.ndarray, dense: np.ndarray, table: torch.Tensor) -> np.ndarray:
    """Products and squares of all entries, [2, nnz]."""
    indptr, region, weight = sparse(dense)
    W, result = [indptr, region, weight, VIEW, LEVEL], np.zeros((2, weight.size), np.float32)
    compare_rows(rows, W, flat_table(table), table.shape[1], result[0], result[1])
    return result


@widths
def test_sums_of_other_views_on_a_level_equal_float64_and_each_row_alone_to_the_bit(width):
    dense, table, rows = weights(3), table_of(width), np.random.default_rng(1).permutation(23)
    result, e = compare(rows, dense, table), table.double().numpy()
    at, region = np.nonzero(dense)
    other_sums = np.zeros((at.size, width))
    for level in range(2):
        level_rows = dense * (level == LEVEL)
        level_rows = level_rows * inverse_of(level_rows)[:, None]
        views = np.stack([np.where(view == VIEW, 0.0, level_rows) @ e for view in range(VIEWS)])
        other_sums[LEVEL[region] == level] = views[VIEW[region], at][LEVEL[region] == level]
    np.testing.assert_allclose(result[0], (other_sums * e[region]).sum(axis=1), atol=2e-6)
    np.testing.assert_allclose(result[1], (other_sums**2).sum(axis=1), atol=2e-6)
    single_rows = sum(compare(np.array([row]), dense, table) for row in rows)
    assert np.array_equal(single_rows, result)


def test_every_table_is_followed_by_zeros():
    for table in (table_of(6), torch.full((3, 5), torch.nan), torch.full((40, 6), torch.nan)[:, 1:4]):
        flat = flat_table(table)
        assert np.array_equal(flat[: table.numel()], table.reshape(-1), equal_nan=True)
        assert flat.size > table.numel()
        assert not flat[table.numel() :].any()


def test_stored_directions_equal_the_computed_ones_and_are_compared_in_place(tmp_path):
    books = [torch.randn(3, 5, generator=torch.manual_seed(view)) for view in range(3)]
    directions = RegionDirections(codebook_of(books), torch.ones(9, dtype=torch.float64), 9)
    directions.save(tmp_path)
    columns, table = slice(0, 5), StoredDirections(tmp_path).table(slice(0, 5))
    assert torch.equal(table, directions.table(columns))
    assert np.shares_memory(flat_table(table), table.numpy())
