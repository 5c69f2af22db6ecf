"""The tables of extremes, sums over many rays, footprints by their formula, and lifts at any length of features."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import alphas
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.scene.splats import Kernel
from liftcore.values.views import Regions
from tests.scenes import camera_at_origin, splats_at
from tests.stability.extreme_measures import Extreme, cloud, run, trace_weights
from tests.stability.extremes import EXTREMES, checkerboard

pytestmark = pytest.mark.usefixtures("every_kernel")
ROWS = [(extreme, kernel) for extreme in EXTREMES for kernel in extreme.kernels]


@pytest.mark.parametrize(("extreme", "kernel"), ROWS, ids=[f"{row.name}-{kernel}" for row, kernel in ROWS])
def test_extreme_is_survived_with_the_stated_error(extreme: Extreme, kernel: Kernel) -> None:
    measured = extreme.measure(kernel)
    assert measured.holds
    assert measured.error <= extreme.bound
    assert extreme.text in " ".join(measured.text)


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


def test_a_beta_of_zero_is_a_cylinder_and_of_four_a_bell():
    camera = camera_at_origin(41, 41, focal=60.0)
    centre, flat = [(0.0, 0.0, 2.0)], math.log(0.4)
    cylinder = trace_weights(splats_at(centre, flat, betas=-200.0, kernel=Kernel.BETA), camera, CompositingParams())
    alpha = 1 / (1 + math.exp(-1.0))
    assert set(np.unique(cylinder.round(5))) == {0.0, round(alpha, 5)}
    bell = trace_weights(splats_at(centre, flat, betas=0.0, kernel=Kernel.BETA), camera, CompositingParams()).reshape(
        41, 41
    )
    radius = 0.4 * 60 / 2
    row = alpha * np.maximum(1 - (np.arange(41) - 20) ** 2 / (radius**2 + 0.3), 0) ** 4
    assert np.abs(bell[20] - row).max() < 1e-6


@pytest.mark.parametrize("scale", [1e-30, 1e15])
def test_diagnostics_and_scores_are_the_same_at_any_length(scale):
    views = [{f"v{k}": checkerboard(5 + k, 40, size) for k in range(2)} for size in (1.0, scale)]
    first, second = (run(observations, cloud(), reference_channels=4)[0] for observations in views)
    for key in ("beta", "bound", "reference"):
        assert numbers(second.diagnostics[key]) == pytest.approx(numbers(first.diagnostics[key]), rel=2e-3, abs=1e-3)
    question = first.features[first.has_feature][:1].numpy()
    np.testing.assert_allclose(second.query(question).scores, first.query(question).scores, atol=1e-5)


def numbers(facts: object) -> list[float]:
    """The numbers of a part of diagnostics that have no unit."""
    if not isinstance(facts, dict):
        return [facts] if isinstance(facts, float) else []
    return [n for name, part in facts.items() if name not in ("residual", "optimum") for n in numbers(part)]
