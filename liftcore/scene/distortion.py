"""How a lens bends rays, and back: the models of OpenCV and COLMAP, on the plane one unit before the camera.

A pinhole meets a ray at (x, y) on this plane, the lens at (x', y'). Where a model turns back, so that two rays
would meet in one place, it has no way back, and ``straight`` gives NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

ITERATIONS = 30  # of Newton's method, which needs four to six where a lens is one
TOLERANCE = 1e-9  # on the plane: a millionth of a pixel
RADII, DIRECTIONS = 513, 16  # at which it is looked whether a lens turns back
FARTHEST = 1e3  # on the plane: what a fisheye sees beside or behind the camera is put so far out


@dataclass(frozen=True)
class Brown:
    """A perspective lens with radial and tangential distortion: OpenCV's rational model, COLMAP's FULL_OPENCV.

    With ``g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)``:
    ``x' = g x + 2 p1 x y + p2 (r^2 + 2 x^2)`` and ``y' = g y + p1 (r^2 + 2 y^2) + 2 p2 x y``.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def bent(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the lens sees what a pinhole sees at (x, y), f64."""
        p1, p2, squares = self.p1, self.p2, x * x + y * y
        radial = self._radial(squares)[0]
        across = 2 * x * y
        return (
            radial * x + p1 * across + p2 * (squares + 2 * x * x),
            radial * y + p1 * (squares + 2 * y * y) + p2 * across,
        )

    def straight(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse of ``bent``, by Newton's method; NaN where there is none, or the lens turned back before."""
        u, v = np.array(x, np.float64), np.array(y, np.float64)
        with np.errstate(all="ignore"):  # what diverges is found by its residual
            for _ in range(ITERATIONS):
                miss_x, miss_y = (bent - given for bent, given in zip(self.bent(u, v), (x, y), strict=True))
                if max(np.abs(miss_x).max(), np.abs(miss_y).max()) < TOLERANCE:
                    break
                a, b, d = self._slopes(u, v)
                determinant = a * d - b * b
                u, v = u - (d * miss_x - b * miss_y) / determinant, v - (a * miss_y - b * miss_x) / determinant
            miss = np.hypot(*(bent - given for bent, given in zip(self.bent(u, v), (x, y), strict=True)))
            lost = ~(miss < 100 * TOLERANCE)
        return np.where(lost, np.nan, u), np.where(lost, np.nan, v)

    def reach(self, radius: float) -> float:
        """How far from the axis of a pinhole the lens turns back, looked for up to a radius; infinity: nowhere."""
        angles = np.arange(DIRECTIONS if self.p1 or self.p2 else 1) * (2 * np.pi / DIRECTIONS)
        radii = np.linspace(0, radius, RADII)
        with np.errstate(all="ignore"):  # at a pole nothing is above zero
            a, b, d = self._slopes(radii[:, None] * np.cos(angles), radii[:, None] * np.sin(angles))
            forth = np.all((a * d - b * b > 0) & (a + d > 0), axis=1, keepdims=True)[:, 0]
        return _first_back(forth, radii)

    def _slopes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The derivatives of x' by x, of x' by y, which is that of y' by x, and of y' by y."""
        p1, p2 = self.p1, self.p2
        radial, slope = self._radial(x * x + y * y)
        return (
            radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
            2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
            radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
        )

    def _radial(self, squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """g and its derivative by r^2."""
        top = 1 + squares * (self.k1 + squares * (self.k2 + squares * self.k3))
        base = 1 + squares * (self.k4 + squares * (self.k5 + squares * self.k6))
        top_slope = self.k1 + squares * (2 * self.k2 + squares * 3 * self.k3)
        base_slope = self.k4 + squares * (2 * self.k5 + squares * 3 * self.k6)
        return top / base, (top_slope * base - top * base_slope) / (base * base)


@dataclass(frozen=True)
class Fisheye:
    """OpenCV's fisheye, COLMAP's OPENCV_FISHEYE: ``r' = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8)``, a the angle."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def bent(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the lens sees what a pinhole sees at (x, y), f64."""
        radius = np.hypot(x, y)
        factor = np.where(radius > 0, self._bent(np.arctan(radius))[0] / np.where(radius > 0, radius, 1.0), 1.0)
        return x * factor, y * factor

    def straight(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse of ``bent``, by Newton's method; at FARTHEST what no pinhole sees, and NaN as for ``Brown``."""
        radius = np.hypot(x, y)
        angle = radius.copy()
        with np.errstate(all="ignore"):
            for _ in range(ITERATIONS):
                bent, slope = self._bent(angle)
                if np.abs(bent - radius).max() < TOLERANCE:
                    break
                angle = angle - (bent - radius) / slope
            lost = ~((np.abs(self._bent(angle)[0] - radius) < 100 * TOLERANCE) & (angle >= 0))
            reach = np.where(angle < np.pi / 2, np.minimum(np.tan(angle), FARTHEST), FARTHEST)
        factor = np.where(radius > 0, reach / np.where(radius > 0, radius, 1.0), 1.0)
        return np.where(lost, np.nan, x * factor), np.where(lost, np.nan, y * factor)

    def reach(self, radius: float) -> float:
        """How far from the axis of a pinhole the lens turns back, looked for up to a radius; infinity: nowhere."""
        angles = np.linspace(0, np.arctan(radius), RADII)
        with np.errstate(all="ignore"):
            return _first_back(self._bent(angles)[1] > 0, np.tan(angles))

    def _bent(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """r' and its derivative."""
        k1, k2, k3, k4, a = self.k1, self.k2, self.k3, self.k4, angle * angle
        bent = angle * (1 + a * (k1 + a * (k2 + a * (k3 + a * k4))))
        return bent, 1 + a * (3 * k1 + a * (5 * k2 + a * (7 * k3 + a * 9 * k4)))


def _first_back(forth: np.ndarray, radii: np.ndarray) -> float:
    """The last of the radii [n] before the first that is not ``forth`` [n]; infinity where all are."""
    return math.inf if forth.all() else float(radii[max(0, int(np.argmin(forth)) - 1)])


Distortion = Brown | Fisheye
