"""Photos of a lens and the pinholes that stand for them.

Splats are drawn by pinholes, so a camera with a lens has the pinhole of the same place, pose and focal lengths
whose image is the largest upright rectangle all of which the photo shows: what gsplat and nerfstudio train on.
Features of the photo are carried to it (`liftcore.observe.through_lens`), and pictures of answers are drawn by a
wider one, which sees all that the photo shows, and carried to the photo's pixels (`liftcore.query.in_photo`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidCameras

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera
    from liftcore.scene.distortion import Distortion

WIDEST = float(np.tan(np.radians(60)))  # of a pinhole's image from its axis, on the plane one unit before it
GROWTH = 0.5  # of the photo's sides, by which a pinhole's image is larger on each side at most
BORDER_PLACES = 33  # on each side of the photo
BAND_PIXELS = 1 << 15  # carried at a time: what that takes stays in the cache
KEPT_PHOTOS = 1  # whose places are kept, 8 bytes a pixel: mostly one lens took all photos


@dataclass(frozen=True)
class Lens:
    """The lens of a photo, and the photo's own intrinsics; pixel centres at +0.5."""

    width: int  # pixels
    height: int  # pixels
    fx: float  # pixels
    fy: float  # pixels
    cx: float  # pixels
    cy: float  # pixels
    distortion: Distortion

    def on_photo(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where on the photo, in pixels, rays lie that pass (x, y) on the plane one unit before the camera."""
        u, v = self.distortion.bent(x, y)
        return self.fx * u + self.cx, self.fy * v + self.cy

    def on_plane(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse: where on that plane the rays pass that the photo shows at pixels (u, v)."""
        return self.distortion.straight((u - self.cx) / self.fx, (v - self.cy) / self.fy)


@dataclass(frozen=True)
class _Box:
    """Whole pixels of a pinhole with a lens's focal lengths and principal point; the first ones may be negative."""

    left: int
    top: int
    right: int
    bottom: int


def behind_lens(camera: Camera, distortion: Distortion) -> Camera:
    """The camera of a distorted photo, from a camera with the photo's size and intrinsics.

    Raises:
        InvalidCameras: the distortion turns back within the photo, or leaves no image of a pinhole.
    """
    lens = Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, distortion)
    try:
        inner, _ = _boxes(lens)
    except ValueError as error:
        hint = "calibrate the camera again, or undistort the photos, and train and lift on them"
        raise InvalidCameras(
            f"camera {camera.name!r} distortion", expected="one that a lens may have", got=str(error), hint=hint
        ) from None
    return _pinhole(camera, lens, inner)


def photo_size(camera: Camera) -> tuple[int, int]:
    """Width and height in pixels of the photo that a camera stands for."""
    whole = camera.lens or camera
    return whole.width, whole.height


def drawn_by(camera: Camera) -> Camera:
    """The pinhole that draws pictures of a camera: its own, or one that sees all that its lens's photo shows."""
    return camera if camera.lens is None else _pinhole(camera, camera.lens, _boxes(camera.lens)[1])


def pixel_of(camera: Camera, x: int, y: int) -> tuple[int, int] | None:
    """The pixel of ``drawn_by`` that shows what the photo's pixel does; None where it shows none of it."""
    if camera.lens is None:
        return x, y
    pinhole, places = drawn_by(camera), photo_places(camera.lens)
    column, row = (float(np.floor(axis[y, x])) for axis in places)
    inside = 0 <= column < pinhole.width and 0 <= row < pinhole.height
    return (int(column), int(row)) if inside else None


def _pinhole(camera: Camera, lens: Lens, box: _Box) -> Camera:
    width, height = box.right - box.left, box.bottom - box.top
    cx, cy = lens.cx - box.left, lens.cy - box.top
    return replace(camera, width=width, height=height, cx=cx, cy=cy, lens=lens)


@lru_cache(maxsize=256)
def _boxes(lens: Lens) -> tuple[_Box, _Box]:
    """The rectangle that the photo shows whole, and the one that shows the whole photo.

    Raises:
        ValueError: there is none; the message says why.
    """
    across, down = np.linspace(0, lens.width, BORDER_PLACES), np.linspace(0, lens.height, BORDER_PLACES)
    u = np.stack([0 * down, across, 0 * down + lens.width, across])  # left, top, right, bottom
    v = np.stack([down, 0 * across, down, 0 * across + lens.height])
    x, y = lens.on_plane(u, v)
    radius = float(np.hypot(x, y).max())
    if not np.isfinite(radius) or lens.distortion.turns_back(radius):
        raise ValueError("one that turns back within the photo, so that two of its places show the same ray")
    left, top, right, bottom = (
        _within(lens, x[0], 0),
        _within(lens, y[1], 1),
        _within(lens, x[2], 0),
        _within(lens, y[3], 1),
    )
    inner = _Box(*(int(np.ceil(side.max())) for side in (left, top)), *(int(side.min()) for side in (right, bottom)))
    outer = _Box(
        *(int(np.floor(side.min())) for side in (left, top)), *(int(np.ceil(side.max())) for side in (right, bottom))
    )
    if inner.left >= inner.right or inner.top >= inner.bottom:
        raise ValueError("one that leaves a pinhole nothing of the photo")
    return inner, outer


def _within(lens: Lens, side: np.ndarray, axis: int) -> np.ndarray:
    """A side of the photo on the plane as pixels of the pinhole, kept to what a pinhole should draw."""
    focal, centre, length = ((lens.fx, lens.cx, lens.width), (lens.fy, lens.cy, lens.height))[axis]
    pixels = np.clip(side, -WIDEST, WIDEST) * focal + centre
    return np.clip(pixels, -GROWTH * length, (1 + GROWTH) * length)


@lru_cache(maxsize=KEPT_PHOTOS)
def photo_places(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Two arrays [H, W] f32: where in the image of ``drawn_by`` the photo's pixels lie, in its pixels."""
    box, columns = _boxes(lens)[1], np.arange(lens.width) + 0.5
    places = (np.empty((lens.height, lens.width), np.float32), np.empty((lens.height, lens.width), np.float32))
    rows = max(1, BAND_PIXELS // lens.width)
    for first in range(0, lens.height, rows):
        here = slice(first, first + rows)
        v, u = np.meshgrid(np.arange(lens.height)[here] + 0.5, columns, indexing="ij")
        x, y = lens.on_plane(u, v)
        places[0][here] = x * lens.fx + lens.cx - box.left
        places[1][here] = y * lens.fy + lens.cy - box.top
    return places
