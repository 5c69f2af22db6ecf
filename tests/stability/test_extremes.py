"""The walk at its extremes, one promise each, against the float64 oracle."""

from __future__ import annotations

import math

import numpy as np
import pytest

from liftcore.raster.base import ALPHA_FLOOR, CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import projected_gaussian
from liftcore.scene.cameras import Camera
from tests.benchmarks.stability.weights import exact_view, traced, weights_of
from tests.scenes import camera_at_origin, random_splats, splats_at
from tests.stability.extremes import TOLERANCE, assert_equals_the_oracle

ROW = [(0.3 * k - 0.6, 0.1 * k, 2.0 + 0.2 * k) for k in range(5)]
TURNED = (0.9, 0.1, 0.3, 0.2)


@pytest.mark.parametrize("scale", [1e-12, 1e6, 1e20])
def test_scales_from_dust_to_worlds_equal_the_oracle(scale):
    A = assert_equals_the_oracle(splats_at(ROW, log_scales=math.log(scale)), camera_at_origin())
    assert A.max() > 0.1


@pytest.mark.parametrize("log_scale", [-80.0, -60.0, 60.0, 80.0])
def test_scales_beyond_all_bounds_stay_finite(log_scale):
    A, evidence = weights_of(splats_at(ROW, log_scales=log_scale), camera_at_origin(), CompositingParams())
    assert np.isfinite(A).all()
    assert evidence.min() > 0


def test_dust_and_long_axes_in_one_splat_equal_the_oracle():
    # The oracle inverts its covariance and runs out of digits itself on needles a million pixels long.
    small, large = math.log(1e-12), math.log(1e4)
    for axes in ([large, small, small], [small, large, small], [small, small, large], [large, large, small]):
        assert_equals_the_oracle(splats_at(ROW, log_scales=axes), camera_at_origin())


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (17, 33)])
def test_images_of_any_shape_equal_the_oracle(size):
    assert_equals_the_oracle(random_splats(1), camera_at_origin(*size), CompositingParams())
    assert_equals_the_oracle(splats_at(ROW), camera_at_origin(*size), CompositingParams())


@pytest.mark.parametrize("turn", [(1.0, 0.0, 0.0, 0.0), (0.707, 0.0, 0.707, 0.0), (0.707, 0.707, 0.0, 0.0), TURNED])
def test_needles_side_on_and_end_on_equal_the_oracle(turn):
    length = math.log(1.0)
    splats = splats_at(ROW, log_scales=[length, length - math.log(1e3), length - math.log(1e3)], quats=turn)
    assert assert_equals_the_oracle(splats, camera_at_origin()).max() > 0.1
    assert_equals_the_oracle(splats, camera_at_origin(64, 48, focal=2_000.0))


def test_a_hundred_thousand_splats_on_one_ray_follow_the_geometric_series_without_a_stop():
    count, logit = 100_000, -5.0
    means = np.zeros((count, 3))
    means[:, 2] = np.linspace(1.0, 1_000.0, count)
    splats = splats_at(means.tolist(), log_scales=-1.0, logits=logit)
    A, evidence = weights_of(splats, camera_at_origin(1, 1), CompositingParams(transmittance_stop=0.0))
    alpha = 1 / (1 + math.exp(-logit))
    light = (1 - alpha) ** np.arange(count + 1)
    expected = alpha * light[:-1]
    assert np.isfinite(A).all()
    assert np.abs(A[0] - expected).max() < TOLERANCE
    assert evidence.sum() == pytest.approx(expected.sum(), abs=1e-4)


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
