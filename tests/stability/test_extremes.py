"""The walk at its extremes, one promise each, against the float64 oracle."""

from __future__ import annotations

import math

import numpy as np
import pytest

from liftcore.raster.base import ALPHA_FLOOR, CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import projected_gaussian
from liftcore.scene.cameras import Camera
from tests.benchmarks.extreme_measures import exact_view, traced, weights_of
from tests.scenes import camera_at_origin, random_splats, splats_at
from tests.stability.extremes import TOLERANCE, assert_equals_the_oracle

ROW = [(0.3 * k - 0.6, 0.1 * k, 2.0 + 0.2 * k) for k in range(5)]
TURNED = (0.9, 0.1, 0.3, 0.2)


@pytest.mark.parametrize("log_scale", [-80.0, -60.0, 60.0, 80.0])
def test_scales_beyond_all_bounds_stay_finite(log_scale):
    A, evidence = weights_of(splats_at(ROW, log_scales=log_scale), camera_at_origin(), CompositingParams())
    assert np.isfinite(A).all()
    assert evidence.min() > 0


@pytest.mark.parametrize("cap", [0.01, 0.5, 0.99, 0.999, 0.9999999])
@pytest.mark.parametrize("stop", [0.0, 1e-30, 1e-4, 0.5])
def test_any_cap_and_any_stop_equal_the_oracle(cap, stop):
    splats = splats_at([(0.0, 0.0, 1.0 + k) for k in range(30)], log_scales=1.0, logits=[1e4, 3.0, -2.0] * 10)
    assert_equals_the_oracle(splats, camera_at_origin(), CompositingParams(1.0, cap, stop))


@pytest.mark.parametrize("gain", [0.1, 0.5, 1.2, 4.0, 16.0])
def test_any_gain_equals_the_oracle_and_leaves_the_evidence_plain(gain):
    splats, camera = random_splats(3, 60), camera_at_origin(24, 18)
    assert_equals_the_oracle(splats, camera, CompositingParams(gain))
    plain = exact_view(splats, camera, CompositingParams())
    if not plain.cut.any():
        assert np.abs(weights_of(splats, camera, CompositingParams(gain))[1] - plain.A.sum(axis=0)).max() < 1e-4


def test_a_huge_image_equals_the_oracle_ray_by_ray():
    splats = splats_at([(0.1 * k, -0.07 * k, 2.0 + k) for k in range(6)], log_scales=-1.5)
    camera = Camera.pinhole("v0", 4_000, 3_000, 3_000.0, 3_000.0, 2_000.5, 1_500.5, np.eye(4))
    sums = CpuRaster(splats).row_sums(camera, CompositingParams()).numpy()
    assert sums.shape == (3_000, 4_000)
    assert np.isfinite(sums).all()
    gaussians = [projected_gaussian(splats, j, camera)[:2] for j in range(splats.count)]
    for x, y in ((2_000, 1_500), (2_150, 1_480), (1_700, 1_700), (2_300, 1_300), (0, 0), (3_999, 2_999)):
        light = 1.0
        for mean, conic in gaussians:
            d = np.array([x + 0.5, y + 0.5]) - mean
            alpha = math.exp(-0.5 * d @ conic @ d) / (1 + math.exp(-1.0))
            light *= 1 - (alpha if alpha >= ALPHA_FLOOR else 0.0)
        assert sums[y, x] == pytest.approx(1 - light, abs=TOLERANCE)


def test_two_saturated_splats_weigh_the_same_in_the_lift_and_in_its_certificate():
    # (1 - cap)^2 is the stop itself with the field's constants: every way to A must fall on the same side.
    splats, camera = splats_at([(0.0, 0.0, 2.0), (0.0, 0.0, 3.0)], log_scales=2.0, logits=1e4), camera_at_origin()
    lifted = weights_of(splats, camera, CompositingParams())[0]
    assert np.abs(lifted - traced(splats, camera, CompositingParams())).max() < TOLERANCE
