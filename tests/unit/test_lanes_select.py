"""Choosing among eight lanes: as NumPy would, infinities, zeros and equal values among them."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from liftcore.raster.cpu.lanes import LANES, keep_lanes, lanes_at
from liftcore.raster.cpu.lanes_select import (
    any_above,
    larger,
    only_lane,
    smaller,
    where_above,
    where_equal,
    where_reached,
)

EIGHT = st.lists(
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 0.25, np.inf, -np.inf, 1e-45]), min_size=LANES, max_size=LANES
).map(lambda values: np.array(values, np.float32))


@njit
def _chosen(left, right, values, lane):
    found = np.empty(6 * LANES, np.float32)
    a, b, c = lanes_at(left, 0), lanes_at(right, 0), lanes_at(values, 0)
    keep_lanes(found, 0, larger(a, b))
    keep_lanes(found, LANES, smaller(a, b))
    keep_lanes(found, 2 * LANES, where_above(a, b, c))
    keep_lanes(found, 3 * LANES, where_reached(a, b, c))
    keep_lanes(found, 4 * LANES, where_equal(a, b, c))
    keep_lanes(found, 5 * LANES, only_lane(c, lane))
    return found.reshape(6, LANES), any_above(a, b)


@given(EIGHT, EIGHT, EIGHT, st.integers(-3, LANES + 3))
def test_lanes_are_chosen_as_numpy_chooses(
    left: np.ndarray, right: np.ndarray, values: np.ndarray, lane: int
) -> None:
    found, any_is_above = _chosen(left, right, values, lane)
    own = np.arange(LANES) == lane
    wanted = [
        np.maximum(left, right),
        np.minimum(left, right),
        np.where(left > right, values, 0),
        np.where(left >= right, values, 0),
        np.where(left == right, values, 0),
        np.where(own, values, 0),
    ]
    assert np.array_equal(found, np.array(wanted, np.float32))
    assert any_is_above == bool((left > right).any())
