"""Sets of half rows against the plain loop over all lanes."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from liftcore.jit import kernel
from liftcore.raster.constants import TILE
from liftcore.raster.cpu.lanes import BASES, HALVES, LANES, ROWS, STARTS
from liftcore.raster.cpu.lanes_blend import STATE
from liftcore.raster.cpu.lanes_halves import (
    both,
    either,
    ellipse_halves,
    lit_halves,
    lowest_half,
    lowest_rank,
    ranked_halves,
    without_lowest,
    without_lowest_rank,
)

places = st.floats(-40, 56)
curvatures = st.sampled_from([0.0, 1e-6, 1e-3, 1.0, 1e6]) | st.floats(1e-4, 10)
roots = st.sampled_from([0.0, 1e-3, 0.03, 1.0, 1e3]) | st.floats(1e-2, 3)


@kernel
def reached(state, centre, slope, form, reach):
    return ellipse_halves(state, centre, slope, form, reach)


@kernel
def members(halves):
    """[n] the half rows of a set, as the walk takes them."""
    found = []
    while halves:
        found.append(lowest_half(halves))
        halves = without_lowest(halves)
    return found


@kernel
def lit(state, first):
    return lit_halves(state, first)


@kernel
def in_ranks(halves, late):
    """[n] the half rows of a set, those of ``late`` 32 higher, as the walk takes them."""
    found = []
    ranked = ranked_halves(halves, late)
    while ranked:
        found.append(lowest_rank(ranked))
        ranked = without_lowest_rank(ranked)
    return found


@kernel
def joined(left, right):
    return both(left, right), either(left, right)


@given(mx=places, my=places, slope=st.floats(-8, 8), root=roots, ky=curvatures, reach=st.floats(-1, 8))
def test_a_set_lacks_no_half_row_with_a_lane_inside_and_holds_none_that_is_far_away(
    mx: float, my: float, slope: float, root: float, ky: float, reach: float
) -> None:
    state = np.zeros(STATE, np.float32)
    halves = reached(state, (mx, my), slope, (root, ky), reach)
    starts, bases = state[STARTS:][:HALVES].astype(np.float64), state[BASES:][:ROWS].astype(np.float64)
    dy = np.arange(ROWS) - my
    middle = mx + slope * dy
    begin = np.repeat([0, LANES], ROWS)
    np.testing.assert_allclose(
        starts, root * (begin - np.tile(middle, 2)), rtol=3 * 2.0**-24, atol=root * LANES * 2.0**-23
    )
    np.testing.assert_allclose(bases, ky * dy**2, rtol=1e-6, atol=ky * 40 * 2.0**-22)
    for half in range(HALVES):
        # What the lanes are blended with, so the set has to go by the same numbers.
        base, start, step = bases[half % ROWS], starts[half], float(np.float32(root))
        form = base + (start + step * np.arange(LANES)) ** 2
        held = bool(halves >> half & 1)
        assert held or not (form <= reach).any()
        away = max(start, 0.0) + min(start + step * (LANES - 1), 0.0)
        assert not held or base + away**2 <= reach + 1e-5 * abs(reach) + 1e-30


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_sets_are_taken_apart_from_the_first_to_the_last(left: int, right: int) -> None:
    assert members(np.uint32(left)) == [half for half in range(HALVES) if left >> half & 1]
    assert joined(np.uint32(left), np.uint32(right)) == (left & right, left | right)


@given(st.integers(0, 2**32 - 1), st.integers(0, LANES - 1))
def test_a_half_row_is_lit_when_any_lane_is(word: int, lane: int) -> None:
    state = np.zeros(STATE, np.float32)
    for half in range(HALVES):
        state[256 + half * LANES + lane] = np.float32(1e-30 if word >> half & 1 else 0.0)
    assert lit(state, 256) == word


def test_half_rows_cover_a_tile() -> None:
    assert ROWS == TILE == HALVES // ROWS * LANES


@given(halves=st.integers(0, 2**32 - 1), late=st.integers(0, 2**32 - 1))
def test_ranks_hold_each_half_row_once_and_the_late_ones_last(halves: int, late: int) -> None:
    held = [half for half in range(HALVES) if halves >> half & 1]
    early = [half for half in held if not late >> half & 1]
    assert in_ranks(np.uint32(halves), np.uint32(late)) == early + [
        HALVES + half for half in held if late >> half & 1
    ]
