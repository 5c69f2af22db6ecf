"""Blending eight pixels, by itself: what the cut-offs do on their edges, and with numbers that are none."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from liftcore.jit import kernel
from liftcore.raster.base import ALPHA_FLOOR, CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.cpu.simd import (
    LANES,
    PLAIN_TRANSMITTANCE,
    STARTS,
    TRANSMITTANCE,
    BetaSegment,
    GaussianSegment,
    blend_lanes,
    blend_twice,
    keep_lanes,
    new_state,
)
from tests.scenes import random_camera, random_splats

CAP, STOP = 0.99, 1e-4
WEIGHTS = STARTS  # room that blending does not write to
F = np.float32


@kernel
def blended(state, shape, fade):
    keep_lanes(state, WEIGHTS, blend_lanes(state, 0, shape, fade))


@kernel
def blended_twice(state, shape, opacities):
    scaled, plain = blend_twice(state, 0, shape, opacities)
    keep_lanes(state, WEIGHTS, scaled)
    keep_lanes(state, WEIGHTS + LANES, plain)


def active(floor: float = ALPHA_FLOOR, cap: float = CAP, light: float = 1.0) -> np.ndarray:
    """A tile's state with so much transmittance on the first segment."""
    state = new_state(floor, cap, STOP)
    for part in (TRANSMITTANCE, PLAIN_TRANSMITTANCE):
        state[part : part + LANES] = light
    return state


def weights_of(state: np.ndarray, shape: GaussianSegment | BetaSegment, opacity: float) -> np.ndarray:
    """The weights of a splat on the first segment; its transmittance moves on."""
    blended(state, shape, F(-math.log2(opacity) if opacity > 0 else math.inf))
    return state[WEIGHTS : WEIGHTS + LANES].copy()


# An exponent is a sum of squares, and no opacity is above one: only a start can be endlessly far to the left.
BROKEN = [("start", -math.inf), *product(("start", "base", "fade"), (math.inf, math.nan))]


@pytest.mark.parametrize(("part", "broken"), BROKEN)
def test_what_is_no_number_has_no_weight_and_takes_no_light(part, broken):
    given = {"start": 0.0, "base": 0.0, "fade": 1.0, part: broken}
    for shape in (
        GaussianSegment(F(given["start"]), F(0.1), F(given["base"])),
        BetaSegment(F(given["start"]), F(0), F(0.1), F(0), F(given["base"]), F(3.0)),
    ):
        for floor in (ALPHA_FLOOR, 0.0):
            state = active(floor, light=0.5)
            blended(state, shape, F(given["fade"]))
            assert np.array_equal(state[WEIGHTS : WEIGHTS + LANES], np.zeros(LANES))
            assert np.array_equal(state[TRANSMITTANCE : TRANSMITTANCE + LANES], np.full(LANES, 0.5))


def test_an_alpha_of_just_the_floor_counts_whatever_the_cap():
    middle = GaussianSegment(F(0.0), F(1e-3), F(0.0))
    for cap in (CAP, 0.5 * ALPHA_FLOOR):
        weights = weights_of(active(cap=cap), middle, ALPHA_FLOOR)
        assert weights[0] == pytest.approx(min(cap, ALPHA_FLOOR), rel=1e-6)
        assert not weights[7:].any()  # 2^-0.00005 of it
        assert not weights_of(active(cap=cap), middle, 0.999999 * ALPHA_FLOOR).any()


SHARES = st.floats(1e-3, 1)


@given(st.floats(-12, 12), st.floats(1e-3, 2), st.floats(0, 9), SHARES, SHARES, st.floats(0.01, 1))
def test_blending_once_and_twice_agree_but_for_the_last_digits(start, root, base, opacity, plain, light):
    for shape in (
        GaussianSegment(F(start), F(root), F(base)),
        BetaSegment(F(start), F(0), F(root), F(0), F(base), F(2.5)),
    ):
        floor = ALPHA_FLOOR if isinstance(shape, GaussianSegment) else 0.0
        twice = active(floor, light=light)
        blended_twice(twice, shape, (F(opacity), F(plain)))
        for part, own in ((0, opacity), (LANES, plain)):
            once, both = weights_of(active(floor, light=light), shape, own), twice[WEIGHTS + part :][:LANES]
            close = np.abs(once - both) <= 2e-6 * np.abs(both) + 1e-30
            at_floor = np.abs(np.maximum(once, both) - ALPHA_FLOOR * light) <= 1e-5 * ALPHA_FLOOR * light
            at_stop = np.abs(light - np.maximum(once, both) - STOP) <= 1e-5
            assert (close | at_floor | at_stop).all()


def test_a_faint_beta_splat_counts_as_far_as_float32_goes():
    shape = BetaSegment(F(0), F(0), F(0.01), F(0), F(0), F(1))
    assert weights_of(active(0.0), shape, 2.0**-121)[0] == pytest.approx(2.0**-121, rel=1e-5)
    assert not weights_of(active(0.0), shape, 2.0**-130).any()


@pytest.mark.parametrize(("cap", "stop"), [(0.9, 0.1), (0.95, 0.0025), (0.999, 1e-6), (0.99, 1e-6), (0.99, 1e-4)])
def test_rays_end_at_the_same_splat_in_every_product(cap, stop):
    splats, camera = random_splats(0, 6), random_camera(0, 5, 5)
    camera = camera.replace(cx=2.5, cy=2.5, fx=5.0, fy=5.0, viewmat=np.eye(4))
    means = torch.tensor([[0.0, 0.0, 2.0 + 0.1 * k] for k in range(6)])
    splats = replace(splats, means=means, opacity_logits=torch.full((6,), 30.0), log_scales=torch.full((6, 3), 2.0))
    walk = CompositingParams(alpha_cap=cap, transmittance_stop=stop)
    raster = CpuRaster(splats)
    image = raster.render(camera, torch.ones(6, 1), walk)[..., 0]
    places = torch.tensor([[x, y] for y in range(5) for x in range(5)], dtype=torch.int32)
    rows = raster.ray_rows(camera, places, walk)
    sums = [float(part.sum()) for part in rows.weights.split(rows.indptr.diff().tolist())]
    assert image.ravel().tolist() == pytest.approx(sums, rel=1e-6, abs=1e-7)
