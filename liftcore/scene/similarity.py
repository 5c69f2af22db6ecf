"""Similarities: scale, rotation and translation of a scene to another frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidInput
from liftcore.scene.quaternions import rotation_matrices

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
    def of(
        cls,
        matrix: Numbers | None = None,
        scale: float = 1.0,
        rotation: Numbers | None = None,
        translation: Numbers | None = None,
    ) -> Similarity:
        """Return a similarity of its matrix, or of its parts.

        Args:
            matrix: [4, 4] or [3, 4], (s R | t). None: of the parts.
            scale: above zero. rotation: [3, 3], or a quaternion [4] w x y z. translation: [3].
        """
        if matrix is not None:
            is_default = isinstance(scale, float | int) and scale == 1.0
            if not is_default or rotation is not None or translation is not None:
                got = "matrix beside scale, rotation or translation"
                raise InvalidInput("matrix", expected="a matrix, or the parts of one", got=got)
            return cls._of_matrix(_numbers("matrix", matrix, ((4, 4), (3, 4))))
        if isinstance(scale, bool) or not _is_positive(scale):
            raise InvalidInput("scale", expected=f"a number above zero, at most {LARGEST:g}", got=repr(scale)[:80])
        turn = np.eye(3) if rotation is None else _numbers("rotation", rotation, ((3, 3), (4,)))
        if turn.shape == (4,):
            if not turn.any():
                raise InvalidInput("rotation", expected="a quaternion w x y z of any length above zero", got="zeros")
            turn = rotation_matrices(turn)
        shift = np.zeros(3) if translation is None else _numbers("translation", translation, ((3,),))
        return cls(float(scale), _proper("rotation", turn), shift)

    @classmethod
    def _of_matrix(cls, matrix: np.ndarray) -> Similarity:
        if len(matrix) == 4 and np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > NEAR**2:
            got = " ".join(f"{value:g}" for value in matrix[3])
            raise InvalidInput("matrix", expected="0 0 0 1 as the last row", got=got, hint="is it transposed?")
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        if not _is_positive(scale):
            got = f"a determinant of {scale**3:.3g}"
            raise InvalidInput("matrix", expected="a rotation times a scale, no reflection", got=got)
        return cls(scale, _proper("matrix", matrix[:3, :3], scale), matrix[:3, 3].copy())

    def points(self, points: np.ndarray) -> np.ndarray:
        """Transform points [n, 3] f64 to the new frame."""
        return self.scale * (points @ self.rotation.T) + self.translation


def _is_positive(scale: Any) -> bool:
    try:
        return math.isfinite(scale) and 1 / LARGEST <= scale <= LARGEST
    except (TypeError, ValueError):
        return False


def _numbers(name: str, values: Any, shapes: tuple[tuple[int, ...], ...]) -> np.ndarray:
    """Return values as f64 of one of the shapes, on the CPU."""
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    expected = f"finite numbers {' or '.join(str(list(shape)) for shape in shapes)}"
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidInput(name, expected=expected, got=repr(values)[:80]) from None
    if array.shape not in shapes or not np.isfinite(array).all() or np.abs(array).max() > LARGEST:
        got = (
            f"shape {list(array.shape)}"
            if array.shape not in shapes
            else f"numbers that are none or beyond {LARGEST:g}"
        )
        raise InvalidInput(name, expected=expected, got=got)
    return array


def _proper(name: str, linear: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Return the nearest rotation to a matrix that is one but for rounding and a scale."""
    off = float(np.abs(linear @ linear.T / scale**2 - np.eye(3)).max())
    if off > NEAR or np.linalg.det(linear) < 0:
        description = "a reflection" if off <= NEAR else f"a matrix off by {off:.2g}"
        hint = "" if off <= NEAR else "a scale for each axis, or a shear, would make no Gaussians of Gaussians"
        raise InvalidInput(name, expected="a proper rotation", got=description, hint=hint)
    left, _, right = np.linalg.svd(linear)
    return left @ right
