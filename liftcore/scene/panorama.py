"""Panoramas: an equirectangular photo as the six faces of a cube around its camera, each of which is a pinhole.

Splats are drawn by pinholes, so a panorama ``NAME`` is the cameras ``NAME@front``, ``NAME@right`` and so on, which
share its photo and the features of that. A ray (u, v, w) of its camera (OpenCV axes) is seen at
``x = (atan2(u, w) / 2 pi + 1/2) width`` and ``y = (atan2(v, sqrt(u^2 + w^2)) / pi + 1/2) height``: COLMAP's
EQUIRECTANGULAR, and nerfstudio's.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

# Rows are a face's axes (right, down, ahead) in the axes of the panorama's camera.
TURNS = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


@dataclass(frozen=True)
class Face:
    """A face of the cube around a panorama's camera."""

    photo: str  # the name of the panorama, as its features have it
    width: int  # pixels of the panorama
    height: int  # pixels of the panorama
    turn: str  # of TURNS

    @property
    def side(self) -> int:
        """Pixels of the face's sides: in its middle as many a radian as the photo has along its horizon."""
        return max(1, round(self.width / math.pi))

    @property
    def fx(self) -> float:
        """Focal length of the face, pixels: it sees 90 degrees."""
        return self.side / 2

    fy = fx

    @property
    def rotation(self) -> np.ndarray:
        """[3, 3] f64, from the axes of the panorama's camera to those of the face."""
        return np.array(TURNS[self.turn], dtype=np.float64)

    def on_photo(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project rays through (x, y), on the plane one unit before the face, to pixels of the panorama."""
        u, v, w = np.einsum("ij,i...->j...", self.rotation, np.stack([x, y, np.ones_like(x)]))
        across, down = np.arctan2(u, w) / (2 * np.pi) + 0.5, np.arctan2(v, np.hypot(u, w)) / np.pi + 0.5
        return across * self.width, down * self.height


def with_panoramas(cameras: Collection[str]) -> set[str]:
    """Return the names of cameras, and those of the panoramas that some of them are faces of."""
    parts = (name.rpartition("@") for name in cameras)
    return {*cameras, *(photo for photo, _, turn in parts if photo and turn in TURNS)}
