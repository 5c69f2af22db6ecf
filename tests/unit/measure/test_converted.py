"""Conversions of 3DGS scenes keep what they promise."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from liftcore.errors import InvalidSplats
from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference_footprints import rotation
from liftcore.scene.splats import Kernel
from tests.benchmarks.converted import to_betas, to_discs
from tests.benchmarks.stability.scenes import splats_at
from tests.scenes import look_at, random_splats

pytestmark = pytest.mark.usefixtures("every_kernel")


def test_a_disc_keeps_the_two_longest_axes_where_they_were():
    splats = random_splats(0, 60)
    discs = to_discs(splats)
    assert discs.kernel is Kernel.GAUSSIAN_2D
    for j in range(splats.count):
        scales = splats.log_scales[j].double().exp().numpy()
        before = rotation(splats.quats[j].double().numpy()) * scales
        after = rotation(discs.quats[j].double().numpy())[:, :2] * discs.log_scales[j].double().exp().numpy()
        kept = np.sort(np.argsort(scales)[1:])
        expected = before[:, kept] @ before[:, kept].T
        assert np.allclose(after @ after.T, expected, atol=1e-6 * scales.max() ** 2)


def test_flat_splats_look_the_same_as_discs():
    for order in ([-2.5, -3.2, -9.0], [-2.5, -9.0, -3.2], [-9.0, -2.5, -3.2]):
        splats = splats_at([(0.0, 0.0, 0.0), (0.2, 0.1, 0.4)], order, quats=(0.9, 0.2, -0.4, 0.1))
        camera = look_at("v", np.array([1.5, 1.0, -3.0]), 480, 360, 1_200.0)
        images = [CpuRaster(made).row_sums(camera, CompositingParams()) for made in (splats, to_discs(splats))]
        # What stays between them is the perspective inside a splat, which 3DGS takes to be linear, and the low-pass.
        assert float((images[0] - images[1]).abs().sum()) < 0.1 * float(images[0].sum())


def test_a_beta_kernel_covers_as_much_of_the_image_as_its_gaussian():
    splats = splats_at([(0.0, 0.0, 0.0)], [-1.0, -1.3, -1.2], logits=-1.0)
    camera = look_at("v", np.array([0.0, 0.0, -3.0]), 200, 200, 150.0)
    sums = [float(CpuRaster(made).row_sums(camera, CompositingParams()).sum()) for made in (splats, to_betas(splats))]
    beyond_the_floor = 1 / (255 * (1 / (1 + math.exp(1.0))))  # of a Gaussian, what alphas under 1/255 would add
    assert sums[1] == pytest.approx(sums[0] / (1 - beyond_the_floor), rel=0.01)


def test_only_gaussians_are_converted():
    discs = to_discs(random_splats(1, 3))
    for convert in (to_discs, to_betas):
        with pytest.raises(InvalidSplats, match="3D Gaussians"):
            convert(discs)


def test_zero_quaternions_convert_as_the_identity_they_stand_for():
    discs = to_discs(splats_at([(0.0, 0.0, 0.0)], [-1.0, -2.0, -3.0], quats=(0.0, 0.0, 0.0, 0.0)))
    assert torch.equal(discs.quats, torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
