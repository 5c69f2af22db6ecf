"""Where points lie along a curve that fills space: near to one another on it is near in space (Morton, 1966)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.jit import kernel

if TYPE_CHECKING:
    from torch import Tensor

_BITS = 21  # of an axis: three fit into 64
# From 21 bits in a row to the same with two zeros before each: how far they move, and which are kept then.
_STEPS = np.array([32, 16, 8, 4, 2], np.uint64)
_KEPT = np.array(
    [0x1F00000000FFFF, 0x1F0000FF0000FF, 0x100F00F00F00F00F, 0x10C30C30C30C30C3, 0x1249249249249249], np.uint64
)


def places_along_curve(points: Tensor) -> np.ndarray:
    """[n] u64, the Morton code of each point among 2^21 cells an axis between the least and the greatest coordinate.

    Args:
        points: [n, 3] f32, finite, any frame and unit.
    """
    codes = np.zeros(points.shape[0], np.uint64)
    if codes.size:
        low, high = (end.double().numpy() for end in (points.amin(dim=0), points.amax(dim=0)))
        cells = np.divide(2**_BITS - 1, high - low, out=np.zeros(3), where=high > low)
        _encode(points.contiguous().numpy(), low, cells, codes)
    return codes


@kernel
def _encode(points, low, cells, codes):
    """The bits of ``(points - low) * cells`` [n, 3], an axis after the other."""
    for k in range(points.shape[0]):
        for axis in range(3):
            number = np.uint64((points[k, axis] - low[axis]) * cells[axis])
            for step in range(_STEPS.shape[0]):
                number = (number | number << _STEPS[step]) & _KEPT[step]
            codes[k] |= number << np.uint64(axis)
