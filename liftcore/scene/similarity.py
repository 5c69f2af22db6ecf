"""Similarities: scale, rotation and translation of a scene to another frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidInput, reading

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
    @reading("matrix", InvalidInput, "finite numbers [4, 4] or [3, 4]")
    def of(cls, matrix: Numbers) -> Similarity:
        """Return a similarity of its matrix [4, 4] or [3, 4], (s R | t).

        Raises:
            InvalidInput: it is none, such as a reflection, a shear or a scale for each axis.
        """
        return similarity_of(matrix)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Transform points [n, 3] f64 to the new frame."""
        return self.scale * (points @ self.rotation.T) + self.translation


def similarity_named(name: str, matrix: Numbers) -> Similarity:
    """Return a similarity of its matrix; a ValueError names another one, and says what it is."""
    try:
        return similarity_of(matrix)
    except ValueError as error:
        raise ValueError(f"{name} of {error}") from None


def similarity_of(matrix: Numbers) -> Similarity:
    """Return a similarity of its matrix, as `Similarity.of` does; a ValueError says what another matrix is."""
    numbers: Any = matrix
    values = np.array(numbers.detach().cpu().numpy() if hasattr(numbers, "detach") else numbers, np.float64)
    if values.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"shape {list(values.shape)}")
    if not (reach := np.abs(values).max()) <= LARGEST:
        raise ValueError(f"finite numbers within {LARGEST:g}, got {reach:.2g}")
    linear = values[:3, :3]
    if len(values) == 4 and np.abs(values[3] - (0.0, 0.0, 0.0, 1.0)).max() > NEAR**2:
        last_row = " ".join(f"{value:g}" for value in values[3])
        raise ValueError(f"0 0 0 1 as the last row, got {last_row}; is it transposed?")
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not 1 / LARGEST <= scale <= LARGEST:
        kind = "a matrix that mirrors" if scale < 0 else "a matrix of no size"
        hint = "negate one axis of the transform that was applied, such as a normalisation, for cameras and splats"
        raise ValueError(f"a rotation times a scale, no reflection, got {kind} (determinant {scale**3:.3g}); {hint}")
    off = float(np.abs(linear @ linear.T / scale**2 - np.eye(3)).max())
    if off > NEAR:
        hint = "a scale for each axis, or a shear, would make no Gaussians of Gaussians"
        raise ValueError(f"a proper rotation, got a matrix off by {off:.2g}; {hint}")
    left, _, right = np.linalg.svd(linear)  # the nearest rotation
    return Similarity(scale, left @ right, values[:3, 3].copy())
