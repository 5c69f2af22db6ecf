"""Rows in float16 on processors that convert them and on those that do not: the same to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from liftcore.raster.cpu import simd
from liftcore.raster.cpu.simd import (
    AHEAD,
    LANES,
    WIDE,
    add_row_products,
    add_weighted_row,
    copy_values,
    keep_halves,
    lanes_at,
)


@pytest.fixture(params=["as it is", "does not convert"])
def processor(request, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param != "as it is":
        monkeypatch.setattr(simd, "converts", lambda _context: False)


def every_half() -> np.ndarray:
    """All finite float16, both zeros among them, and zeros to whole rows."""
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    halves = halves[np.isfinite(halves)]
    return np.concatenate([halves, np.zeros(-halves.size % WIDE, np.float16)])


@pytest.mark.usefixtures("processor")
def test_every_float16_is_summed_as_the_float32_that_it_is() -> None:
    @njit  # compiled in this test, for the processor of this test
    def weighted(source, columns, weights):
        found = np.zeros(columns.shape[0] * WIDE, np.float32)
        for k in range(columns.shape[0]):
            add_weighted_row(found, k * WIDE, source, (k, k + 1), (columns, weights), (WIDE, 0))
        return found

    halves = every_half()
    count = halves.size // WIDE
    columns = np.zeros(count + AHEAD, np.int32)
    columns[:count] = np.arange(count)
    weights = np.full(count + AHEAD, 0.375, np.float32)
    found = weighted(halves.view(np.uint16), columns, weights)[: halves.size]
    assert np.array_equal(found, halves.astype(np.float32) * np.float32(0.375))


@pytest.mark.usefixtures("processor")
def test_float32_is_rounded_to_the_nearest_float16() -> None:
    @njit
    def rounded(values):
        found = np.empty(values.shape[0], np.uint16)
        for first in range(0, values.shape[0], LANES):
            keep_halves(found, first, lanes_at(values, first))
        return found

    halves = every_half().astype(np.float32)
    between = [halves * np.float32(1 + step) for step in (-(2.0**-12), 0, 2.0**-12, 2.0**-11)]  # ties among them
    values = np.concatenate([*between, np.array([65_504, 65_519.9, 65_520, -1e9, 1e-9, -1e-9, 0, -0.0], np.float32)])
    with np.errstate(over="ignore"):
        wanted = values.astype(np.float16)
    assert rounded(values).tobytes() == wanted.tobytes()


@pytest.mark.parametrize("kind", [np.uint16, np.float32, np.float64])
def test_values_are_copied_to_their_place_alone(kind: type) -> None:
    copy = njit(lambda target, source: copy_values(target, 3, source, 5, 7))
    source, target = np.arange(20).astype(kind), np.zeros(15, kind)
    copy(target, source)
    assert target.tolist() == [0] * 3 + list(range(5, 12)) + [0] * 5


def test_products_of_rows_are_added_to_what_there_is_and_the_square_is_given() -> None:
    @njit
    def multiplied(other, source, entries, columns, products):
        return add_row_products(other, 3, source, entries, (columns, products), (2 * WIDE, 5))

    rng = np.random.default_rng(0)
    source, other = (rng.normal(0, 1, count).astype(np.float32) for count in (20 * WIDE, WIDE + 3))
    columns, before = rng.integers(0, 9, 6).astype(np.int32), rng.normal(0, 1, 6)
    products, row = before.copy(), other[3:].astype(np.float64)
    square = multiplied(other, source, (1, 5), columns, products)
    wanted = [float(source[2 * WIDE * k + 5 :][:WIDE].astype(np.float64) @ row) for k in columns[1:5]]
    np.testing.assert_allclose(products - before, np.array([0.0, *wanted, 0.0]), atol=1e-4 * WIDE**0.5)
    assert square == pytest.approx(row @ row, rel=1e-6)
