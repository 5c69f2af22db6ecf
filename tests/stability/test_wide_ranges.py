"""Any logits, scales, distances, turns and lenses: finite always, and the oracle's weights where it has digits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from liftcore.raster.base import CompositingParams
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Kernel
from tests.benchmarks.extreme_measures import View, judgeable, traced, weights_of
from tests.scenes import splats_at
from tests.stability.extremes import assert_equals_the_oracle

pytestmark = pytest.mark.usefixtures("every_kernel")
hypothesis_settings = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])

logits = st.one_of(st.sampled_from([-1e4, 1e4, 0.0]), st.floats(-20, 20))
log_scales = st.floats(-28, 14)
turns = st.one_of(st.just((0.0,) * 4), st.tuples(*[st.floats(-1, 1, width=32)] * 4))
betas = st.one_of(st.sampled_from([-30.0, 30.0]), st.floats(-6, 4))


@st.composite
def wide_views(draw: st.DrawFn, kernel: Kernel) -> View:
    """Up to eight splats somewhere in the cone of a camera, near or far, with any shape."""
    width, height = draw(st.integers(1, 24)), draw(st.integers(1, 20))
    focal = width * 10.0 ** draw(st.floats(-1, 3))
    camera = Camera.pinhole(
        "v0", width, height, focal, focal * draw(st.floats(0.5, 2)), width * 0.4, height * 0.6, np.eye(4)
    )
    count = draw(st.integers(1, 8))
    depths = [10.0 ** draw(st.floats(-2.5, 6)) for _ in range(count)]
    sides = [(draw(st.floats(-1.5, 1.5)), draw(st.floats(-1.5, 1.5))) for _ in range(count)]
    means = [(x * z * width / focal, y * z * height / focal, z) for (x, y), z in zip(sides, depths, strict=True)]
    # Sizes are drawn in pixels, so that far splats are not all dust.
    shapes = [[draw(log_scales) * 0.5 + np.log(z / focal) for _ in range(3)] for z in depths]
    every = [[draw(strategy) for _ in means] for strategy in (logits, turns, betas)]
    splats = splats_at(means, shapes, every[0], every[1], kernel, every[2])
    walk = CompositingParams(
        draw(st.sampled_from([0.01, 1.0, 1.2, 16.0])), draw(st.sampled_from([0.5, 0.99, 0.9999]))
    )
    return View(splats, camera, walk)


@pytest.mark.parametrize("kernel", list(Kernel))
@hypothesis_settings
@given(st.data())
def test_wide_ranges_equal_the_oracle(kernel, data):
    view = data.draw(wide_views(kernel))
    if judgeable(view):
        assert_equals_the_oracle(view.splats, view.camera, view.walk)
    for A in (weights_of(view.splats, view.camera, view.walk)[0], traced(view.splats, view.camera, view.walk)):
        assert np.isfinite(A).all()
        assert A.min() >= 0
        assert A.sum(axis=1).max() <= 1 + 1e-5
