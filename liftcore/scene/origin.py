"""The local origin of scenes in map coordinates, about which float32 keeps what their files hold.

A position of UTM, (500000, 5400000, 300), lies where float32 has steps of half a metre. Such splats are kept about an
origin near them, in float64, and everything that meets them is made relative to it in float64 first: a camera by
``Camera.about``, before any of its numbers is rounded. Positions that leave the program have it added again
(``Splats.positions``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

Origin = tuple[float, float, float]  # f64, frame of the file, scene units

FILE_ORIGIN: Origin = (0.0, 0.0, 0.0)  # of scenes whose means are as their file has them
SAMPLE = 4096  # splats that decide, evenly spaced
MIDDLE = (0.1, 0.5, 0.9)  # quantiles of their positions: floaters decide nothing
MIN_DISTANCE = 16.0  # extents of the scene between it and the file's origin: nearer, float32 loses too few bits
COARSE = 1 / 64  # of a splat's size, which float32's step there may be
LARGEST_SCALE = 80.0  # log: its exponential is a float32
MAP_REACH = 1e4  # scene units from the origin: so far, positions need more digits than elsewhere
FARTHEST = 1e12  # scene units, as far as cameras may be


def local_origin(means: np.ndarray | Tensor, log_scales: np.ndarray | Tensor) -> Origin:
    """Return an origin near splats where float32 would round their positions coarsely; zeros for all others.

    It needs both that the scene lies many of its own extents away and that float32's step there is coarse for the
    splats, so it does not depend on the unit, and a scene about its own origin keeps every bit. It is a multiple of
    a power of two about as large as the scene: subtracting it loses no bit of what is near.

    Args:
        means: [P, 3] floats, frame and unit of the file. log_scales: [P, 2 or 3], log of scene units.
    """
    middle, extent = middle_and_extent(means)
    reach, size = float(np.abs(middle).max()), usual_size(log_scales)
    if not MIN_DISTANCE * extent < reach <= FARTHEST or float32_step(reach) <= COARSE * size:
        return FILE_ORIGIN
    unit = 2.0 ** np.ceil(np.log2(max(extent, min(size, reach), float32_step(reach))))
    x, y, z = (np.round(middle / unit) * unit + 0.0).tolist()  # no minus zero
    return x, y, z


def float32_step(reach: float) -> float:
    """Return the resolution of float32 at a distance from its origin."""
    return float(np.spacing(np.float32(reach)))


def lies_apart(means: np.ndarray) -> bool:
    """Return True if splats are far enough from their file's origin to need one of their own, by means alone."""
    middle, extent = middle_and_extent(means)
    return float(np.abs(middle).max()) > MIN_DISTANCE * extent


def usual_size(log_scales: np.ndarray | Tensor) -> float:
    """Return the median of the splats' larger scales, scene units; 0 where none is finite."""
    sizes = _sample(log_scales).max(axis=1)
    sizes = sizes[np.isfinite(sizes)]
    return float(np.exp(np.median(sizes).clip(max=LARGEST_SCALE))) if len(sizes) else 0.0


def middle_and_extent(means: np.ndarray | Tensor) -> tuple[np.ndarray, float]:
    """Return the middle [3] of the finite means, and the largest side of the box about 80% of them; zeros of none."""
    places = _sample(means)
    places = places[np.isfinite(places).all(axis=1)]
    low, middle, high = np.quantile(places, MIDDLE, axis=0) if len(places) else np.zeros((3, 3))
    return middle, float((high - low).max())


def _sample(values: np.ndarray | Tensor) -> np.ndarray:
    """Return at most SAMPLE rows, evenly spaced, as f64."""
    sample = values[:: -(-len(values) // SAMPLE)]
    return (sample if isinstance(sample, np.ndarray) else sample.detach().cpu().numpy()).astype(np.float64)
