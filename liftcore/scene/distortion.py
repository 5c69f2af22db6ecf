"""How a lens bends rays, and back: the models of OpenCV and COLMAP, on the plane one unit before the camera.

A pinhole meets a ray at (x, y) on this plane, the lens at (x', y'). Where a model turns back, so that two rays
would meet in one place, it has no way back, and ``straight`` gives NaN.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

ITERATIONS = 30  # of Newton's method, which needs four to six where a lens is one
TOLERANCE = 1e-9  # on the plane: a millionth of a pixel
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
        p1, p2, u, v = self.p1, self.p2, np.array(x, np.float64), np.array(y, np.float64)
        with np.errstate(all="ignore"):  # what diverges is found by its residual
            for _ in range(ITERATIONS):
                miss_x, miss_y = (bent - given for bent, given in zip(self.bent(u, v), (x, y), strict=True))
                if max(np.abs(miss_x).max(), np.abs(miss_y).max()) < TOLERANCE:
                    break
                radial, slope = self._radial(u * u + v * v)
                a = radial + 2 * u * u * slope + 2 * p1 * v + 6 * p2 * u
                b = 2 * u * v * slope + 2 * p1 * u + 2 * p2 * v  # the Jacobian is symmetric
                d = radial + 2 * v * v * slope + 6 * p1 * v + 2 * p2 * u
                determinant = a * d - b * b
                u, v = u - (d * miss_x - b * miss_y) / determinant, v - (a * miss_y - b * miss_x) / determinant
            miss = np.hypot(*(bent - given for bent, given in zip(self.bent(u, v), (x, y), strict=True)))
            lost = ~(miss < 100 * TOLERANCE)
        return np.where(lost, np.nan, u), np.where(lost, np.nan, v)

    def turns_back(self, radius: float) -> bool:
        """Whether what lies farther out comes to lie farther in, up to this radius of a pinhole."""
        with np.errstate(all="ignore"):
            squares = np.linspace(0, radius, 257) ** 2
            radial, slope = self._radial(squares)
            return not bool((radial + 2 * squares * slope > 0).all())

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

    def turns_back(self, radius: float) -> bool:
        """Whether what lies farther out comes to lie farther in, up to this radius of a pinhole."""
        return not bool((self._bent(np.linspace(0, np.arctan(radius), 257))[1] > 0).all())

    def _bent(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """r' and its derivative."""
        k1, k2, k3, k4, a = self.k1, self.k2, self.k3, self.k4, angle * angle
        bent = angle * (1 + a * (k1 + a * (k2 + a * (k3 + a * k4))))
        return bent, 1 + a * (3 * k1 + a * (5 * k2 + a * (7 * k3 + a * 9 * k4)))


Distortion = Brown | Fisheye
