"""The comparison of every weight with the float64 oracle, as an assertion."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.benchmarks.extreme_measures import compare

if TYPE_CHECKING:
    import numpy as np

    from liftcore.raster.base import CompositingParams
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

TOLERANCE = 1e-5  # absolute, on weights, away from the cut-offs


def assert_equals_the_oracle(splats: Splats, camera: Camera, walk: CompositingParams | None = None) -> np.ndarray:
    """Every weight of every ray, by both ways to A, squared too, the evidence and the row sums; the oracle's A."""
    got = compare(splats, camera, walk)
    assert got.finite
    assert got.error < TOLERANCE
    return got.A
