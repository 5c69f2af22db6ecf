"""Similarities: scale, rotation and translation of a scene to another frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidInput

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    Numbers = np.ndarray | Tensor | Sequence[float] | Sequence[Sequence[float]]

NEAR = 1e-3  # entries of R R^T from those of the unit matrix, as for poses of cameras
LARGEST = 1e12  # scene units, and times


@dataclass(frozen=True, eq=False)
class Similarity:
    """``p' = scale R p + translation`` for a point p of a scene."""

    scale: float
    rotation: np.ndarray  # [3, 3] f64, proper
    translation: np.ndarray  # [3] f64, scene units of the new frame

    @classmethod
    def of(cls, matrix: Numbers) -> Similarity:
        """Return a similarity of its matrix [4, 4] or [3, 4], (s R | t).

        Raises:
            InvalidInput: it is none, such as a reflection, a shear or a scale for each axis.
        """
        values = _numbers(matrix)
        linear = values[:3, :3]
        if len(values) == 4 and np.abs(values[3] - (0.0, 0.0, 0.0, 1.0)).max() > NEAR**2:
            got = " ".join(f"{value:g}" for value in values[3])
            raise InvalidInput("matrix", expected="0 0 0 1 as the last row", got=got, hint="is it transposed?")
        scale = float(np.cbrt(np.linalg.det(linear)))
        if not 1 / LARGEST <= scale <= LARGEST:
            got = f"a determinant of {scale**3:.3g}"
            raise InvalidInput("matrix", expected="a rotation times a scale, no reflection", got=got)
        off = float(np.abs(linear @ linear.T / scale**2 - np.eye(3)).max())
        if off > NEAR:
            hint = "a scale for each axis, or a shear, would make no Gaussians of Gaussians"
            raise InvalidInput("matrix", expected="a proper rotation", got=f"a matrix off by {off:.2g}", hint=hint)
        left, _, right = np.linalg.svd(linear)  # the nearest rotation
        return cls(scale, left @ right, values[:3, 3].copy())

    def points(self, points: np.ndarray) -> np.ndarray:
        """Transform points [n, 3] f64 to the new frame."""
        return self.scale * (points @ self.rotation.T) + self.translation


def _numbers(matrix: Any) -> np.ndarray:
    """Return a matrix [4, 4] or [3, 4] as f64, on the CPU."""
    if hasattr(matrix, "detach"):
        matrix = matrix.detach().cpu().numpy()
    expected = "finite numbers [4, 4] or [3, 4]"
    try:
        array = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidInput("matrix", expected=expected, got=repr(matrix)[:80]) from None
    if array.shape not in ((4, 4), (3, 4)):
        raise InvalidInput("matrix", expected=expected, got=f"shape {list(array.shape)}")
    if not np.abs(array).max() <= LARGEST:
        raise InvalidInput("matrix", expected=expected, got=f"numbers that are none or beyond {LARGEST:g}")
    return array
