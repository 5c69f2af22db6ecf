"""Splats and views at their extremes, one promise each, against the float64 reference."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import alphas
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.scene.splats import Kernel, Splats
from liftcore.values.views import Regions
from tests.scenes import camera_at_origin, splats_at
from tests.stability.extreme_measures import WEIGHTS, compare, trace_weights, weights_of

pytestmark = pytest.mark.usefixtures("every_kernel")
DISC, BETA = Kernel.GAUSSIAN_2D, Kernel.BETA


def assert_equals_the_oracle(splats: Splats, camera: Camera, params: CompositingParams | None = None) -> np.ndarray:
    """Every weight of every ray, by both ways to A, squared too, total weight and the row sums; the oracle's A."""
    got = compare(splats, camera, params)
    assert got.finite
    assert got.error < WEIGHTS
    return got.A


def test_sums_over_a_million_rays_are_those_of_float64():
    side = 1_000
    splats = splats_at([(0.0, 0.0, 2.0)], log_scales=[0.3, 0.1, 0.0], logits=-2.0)  # faint, on all of the image
    camera = Camera.pinhole("v0", side, side, 0.7 * side, 0.7 * side, side / 2, side / 2, np.eye(4))
    x, total, squares = np.arange(side) + 0.5, 0.0, 0.0
    for y in x:
        alpha = alphas(splats, 0, camera, CompositingParams(), np.stack([x, np.full_like(x, y)], axis=1))[0]
        total += float(alpha.sum())
        squares += float((alpha * alpha).sum())
    raster, region = CpuRaster(splats), Regions(torch.zeros(1, 1, 1, dtype=torch.int32), torch.ones(1, 1))
    weights, squared = (raster.region_weights(camera, region, CompositingParams(), Weighting(n)) for n in (1, 2))
    assert [float(weights.weight[0]), float(weights.total_weight[0])] == pytest.approx(2 * [total])
    assert float(squared.weight[0]) == pytest.approx(squares)


def about_x(angle: float) -> tuple[float, float, float, float]:
    """The quaternion that turns by ``angle`` about the x axis."""
    return (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)


def test_a_ray_that_has_stopped_takes_nothing_of_the_discs_behind():
    # The released 2DGS kernel does not check in its inner loop if a ray is done: in later batches it adds
    # alpha times the transmittance that the ray had when it stopped.
    means = [(0.0, 0.0, 1.0 + 0.01 * k) for k in range(700)]
    splats = splats_at(means, log_scales=1.0, logits=[2.0] * 8 + [-2.0] * 692, kernel=DISC)
    A = assert_equals_the_oracle(splats, camera_at_origin())
    got = weights_of(splats, camera_at_origin(), CompositingParams())[0]
    last = (A > 0).sum(axis=1).max()
    assert last < 12
    assert got[:, last:].max() == 0
    assert got.sum(axis=1).max() <= 1.0


def test_hairs_askew_keep_their_digits_far_from_their_middle():
    # Along pixel centres, two columns a row, and 0.8 of the thin scale off them: from pixel to pixel s changes
    # by up to a million, and here it is small.
    thinness = 1e-6
    angle, offset = math.atan2(1.0, 2.0), 0.8 * thinness
    splats = splats_at(
        [(-offset * math.sin(angle), offset * math.cos(angle), 2.0)],
        log_scales=[2.0, math.log(thinness), 0.0],
        quats=(math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)),
        kernel=DISC,
    )
    A = assert_equals_the_oracle(splats, camera_at_origin(64, 32))
    assert A.reshape(32, 64)[7, 14] > 0.4  # eighteen columns from the middle, the seventh pixel of its half row


@pytest.mark.parametrize(("height", "tilt"), [(-0.5, 1.4), (0.01, math.pi / 2), (0.3, 1.2)])
def test_discs_that_pass_the_camera_end_at_their_horizon(height, tilt):
    # A floor around the camera: half of its crossings lie behind, and its horizon goes through the image.
    splats = splats_at([(0.0, height, 0.5), (0.3, height, 3.0)], log_scales=2.0, quats=about_x(tilt), kernel=DISC)
    A = assert_equals_the_oracle(splats, camera_at_origin(40, 40))
    assert (A > 0).any()
    assert (A == 0).any(axis=0).all()  # no disc is met by all rays


def test_crossings_behind_the_camera_do_not_count():
    # The plane rises towards the camera and passes behind it: rays upwards meet it only backwards.
    splats = splats_at([(0.0, 0.2, 0.1)], log_scales=3.0, quats=about_x(math.pi / 2 + 1e-3), kernel=DISC)
    camera = Camera.pinhole("v0", 21, 21, 10.0, 10.0, 10.5, 10.5, np.eye(4))
    A = assert_equals_the_oracle(splats, camera).reshape(21, 21)
    assert A[:5, 10].max() == 0
    assert A[14:, 10].min() > 0.5


def test_a_beta_of_zero_is_a_cylinder_and_of_four_a_bell():
    camera = camera_at_origin(41, 41, focal=60.0)
    centre, flat = [(0.0, 0.0, 2.0)], math.log(0.4)
    cylinder = trace_weights(splats_at(centre, flat, betas=-200.0, kernel=BETA), camera, CompositingParams())
    alpha = 1 / (1 + math.exp(-1.0))
    assert set(np.unique(cylinder.round(5))) == {0.0, round(alpha, 5)}
    bell = trace_weights(splats_at(centre, flat, betas=0.0, kernel=BETA), camera, CompositingParams()).reshape(41, 41)
    radius = 0.4 * 60 / 2
    row = alpha * np.maximum(1 - (np.arange(41) - 20) ** 2 / (radius**2 + 0.3), 0) ** 4
    assert np.abs(bell[20] - row).max() < 1e-6
