"""Blending of eight pixels in isolation: the cut-offs at their limits, and with NaN and infinity."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest

from liftcore.raster.cpu.simd import (
    LANES,
    STARTS,
    TRANSMITTANCE,
    BetaSegment,
    GaussianSegment,
    blend_lanes,
    new_state,
    store_lanes,
)
from liftcore.runtime.jit import kernel
from liftcore.scene.compositing import ALPHA_FLOOR

CAP, STOP = 0.99, 1e-4
WEIGHTS = STARTS  # room that blending does not write to
F = np.float32


@kernel
def blended(state, shape, fade):
    store_lanes(state, WEIGHTS, blend_lanes(state, 0, shape, fade))


def active(floor: float = ALPHA_FLOOR, cap: float = CAP, transmittance: float = 1.0) -> np.ndarray:
    """Return a tile's state with this transmittance on the first segment."""
    state = new_state(floor, cap, STOP)
    state[TRANSMITTANCE : TRANSMITTANCE + LANES] = transmittance
    return state


def weights_of(state: np.ndarray, shape: GaussianSegment, opacity: float) -> np.ndarray:
    """Return the weights of a splat on the first segment, and update its transmittance."""
    blended(state, shape, F(-math.log2(opacity)))
    return state[WEIGHTS : WEIGHTS + LANES].copy()


# An exponent is a sum of squares, and no opacity is above one: only a start can be endlessly far to the left.
BROKEN = [("start", -math.inf), *product(("start", "base", "fade"), (math.inf, math.nan))]


@pytest.mark.parametrize(("part", "broken"), BROKEN)
def test_what_is_no_number_has_no_weight_and_takes_no_light(part, broken):
    values = {"start": 0.0, "base": 0.0, "fade": 1.0, part: broken}
    for shape in (
        GaussianSegment(F(values["start"]), F(0.1), F(values["base"])),
        BetaSegment(F(values["start"]), F(0), F(0.1), F(0), F(values["base"]), F(3.0)),
    ):
        for floor in (ALPHA_FLOOR, 0.0):
            state = active(floor, transmittance=0.5)
            blended(state, shape, F(values["fade"]))
            assert np.array_equal(state[WEIGHTS : WEIGHTS + LANES], np.zeros(LANES))
            assert np.array_equal(state[TRANSMITTANCE : TRANSMITTANCE + LANES], np.full(LANES, 0.5))


def test_an_alpha_of_just_the_floor_counts_whatever_the_cap():
    middle = GaussianSegment(F(0.0), F(1e-3), F(0.0))
    for cap in (CAP, 0.5 * ALPHA_FLOOR):
        weights = weights_of(active(cap=cap), middle, ALPHA_FLOOR)
        assert weights[0] == pytest.approx(min(cap, ALPHA_FLOOR), rel=1e-6)
        assert not weights[7:].any()  # 2^-0.00005 of it
        assert not weights_of(active(cap=cap), middle, 0.999999 * ALPHA_FLOOR).any()
