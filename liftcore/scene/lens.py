"""Photos of a lens and the pinholes that stand for them.

Splats are drawn by pinholes, so a camera with a lens has the pinhole of the same place, pose and focal lengths
whose image is the largest upright rectangle all of which the photo shows: what gsplat and nerfstudio train on.
Features of the photo are carried to it (`liftcore.features.lens`), and pictures of answers are drawn by a
wider one, which sees all that the photo shows, and carried to the photo's pixels (`liftcore.query.in_photo`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liftcore.errors import InvalidCameras
from liftcore.scene.cameras import MAX_SIDE

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera
    from liftcore.scene.distortion import Distortion

WIDEST = float(np.tan(np.radians(60)))  # of a pinhole's image from its axis, in x and in y, on the plane one unit off
GROWTH = 0.5  # of the photo's sides, by which a pinhole's image is larger on each side at most
LEAST_SHARE = 0.1  # of the photo that its pinhole has to see: with less the calibration is broken
ROUNDING = 1e-3  # pixels
TINY = 1e-30  # of a direction's length, where there is none
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
        """The inverse: where on that plane the rays pass that the photo shows at pixels (u, v); else NaN."""
        x, y = self.distortion.straight((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        with np.errstate(invalid="ignore"):
            shown = np.hypot(x, y) <= _reach(self)
        return np.where(shown, x, np.nan), np.where(shown, y, np.nan)


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
        InvalidCameras: a pinhole would see hardly anything of the photo.
    """
    lens = Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, distortion)
    try:
        inner = _frames(lens).inner
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
    return camera if camera.lens is None else _pinhole(camera, camera.lens, _frames(camera.lens).outer)


def pixel_of(camera: Camera, x: int, y: int) -> tuple[int, int] | None:
    """The pixel of ``drawn_by`` that shows what the photo's pixel does; None where it shows none of it."""
    if camera.lens is None:
        return x, y
    pinhole, lens = drawn_by(camera), camera.lens
    across, down = lens.on_plane(np.array([x + 0.5]), np.array([y + 0.5]))
    column, row = (float(np.floor(at)) for at in (across[0] * lens.fx + pinhole.cx, down[0] * lens.fy + pinhole.cy))
    inside = 0 <= column < pinhole.width and 0 <= row < pinhole.height
    return (int(column), int(row)) if inside else None


def lifted_share(camera: Camera) -> float:
    """How much of the photo's area its camera's pinhole sees."""
    return 1.0 if camera.lens is None else _frames(camera.lens).share


def _pinhole(camera: Camera, lens: Lens, box: _Box) -> Camera:
    width, height = box.right - box.left, box.bottom - box.top
    cx, cy = lens.cx - box.left, lens.cy - box.top
    return camera.replace(width=width, height=height, cx=cx, cy=cy, lens=lens)


class _Frames(NamedTuple):
    """What pinholes see of a photo."""

    inner: _Box  # which the photo shows whole
    outer: _Box  # which shows all of the photo that pinholes may see
    share: float  # of the photo's area that the inner one sees


@lru_cache(maxsize=256)
def _reach(lens: Lens) -> float:
    """How far from the axis rays have places of their own, on the plane; infinity: all that pinholes may see."""
    return lens.distortion.reach(2 * WIDEST)


@lru_cache(maxsize=256)
def _frames(lens: Lens) -> _Frames:
    """The rectangle that the photo shows whole, and the one that shows the whole photo.

    Where the photo's border shows no ray, because the lens turns back before it, what has rays ends there.

    Raises:
        ValueError: there is none; the message says why.
    """
    x, y = _border(lens)
    sides = [_side(lens, *side) for side in ((x[0], 0), (y[1], 1), (x[2], 0), (y[3], 1))]
    inner = _within_reach(lens, [np.max(sides[0]), np.max(sides[1]), np.min(sides[2]), np.min(sides[3])])
    outer = _Box(
        *(int(np.floor(side.min())) for side in sides[:2]), *(int(np.ceil(side.max())) for side in sides[2:])
    )
    if inner.left >= inner.right or inner.top >= inner.bottom:
        raise ValueError("one that leaves a pinhole nothing of the photo")
    share = _share(lens, inner)
    if math.isnan(share):
        raise ValueError("one that turns back within the photo, so that two of its places show the same ray")
    if share < LEAST_SHARE:
        raise ValueError(f"one by which a pinhole sees {share:.1%} of the photo")
    return _Frames(inner, outer, share)


def _border(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """The photo's left, top, right and bottom side on the plane, two arrays [4, BORDER_PLACES].

    Where a side shows no ray, the last one in its direction stands for it.
    """
    across, down = np.linspace(0, lens.width, BORDER_PLACES), np.linspace(0, lens.height, BORDER_PLACES)
    u = np.stack([0 * down, across, 0 * down + lens.width, across])
    v = np.stack([down, 0 * across, down, 0 * across + lens.height])
    x, y = lens.on_plane(u, v)
    towards = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy])
    last = min(_reach(lens), 2 * WIDEST) * towards / np.maximum(np.hypot(*towards), TINY)
    return np.where(np.isnan(x), last[0], x), np.where(np.isnan(y), last[1], y)


def _side(lens: Lens, places: np.ndarray, axis: int) -> np.ndarray:
    """A side of the photo on the plane as pixels of the pinhole, kept to what a pinhole should draw."""
    focal, centre, length = ((lens.fx, lens.cx, lens.width), (lens.fy, lens.cy, lens.height))[axis]
    pixels = np.clip(places, -WIDEST, WIDEST) * focal + centre
    margin = min(GROWTH * length, (MAX_SIDE - length) / 2)
    return np.clip(pixels, -margin, length + margin)


def _within_reach(lens: Lens, sides: list[float]) -> _Box:
    """The whole pixels within such sides, which are drawn towards the axis until rays at the corners have places."""
    left, top, right, bottom = sides
    corners = (
        max(abs(left - lens.cx), abs(right - lens.cx)) / lens.fx,
        max(abs(top - lens.cy), abs(bottom - lens.cy)) / lens.fy,
    )
    nearer = min(1.0, _reach(lens) / np.hypot(*corners)) if np.hypot(*corners) > 0 else 1.0
    left, right = (lens.cx + nearer * (side - lens.cx) for side in (left, right))
    top, bottom = (lens.cy + nearer * (side - lens.cy) for side in (top, bottom))
    return _Box(int(np.ceil(left)), int(np.ceil(top)), int(np.floor(right)), int(np.floor(bottom)))


def _share(lens: Lens, box: _Box) -> float:
    """How much of the photo's area a box sees; NaN where it sees beyond the photo."""
    steps = np.linspace(0, 1, BORDER_PLACES)[:-1]
    width, height = box.right - box.left, box.bottom - box.top
    u = np.concatenate(
        [box.left + width * steps, 0 * steps + box.right, box.right - width * steps, 0 * steps + box.left]
    )
    v = np.concatenate(
        [0 * steps + box.top, box.top + height * steps, 0 * steps + box.bottom, box.bottom - height * steps]
    )
    x, y = lens.on_photo((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy)
    past = max(-x.min(), -y.min(), x.max() - lens.width, y.max() - lens.height)
    if not past <= ROUNDING:
        return math.nan
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
    return area / (lens.width * lens.height)


@lru_cache(maxsize=KEPT_PHOTOS)
def photo_places(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Two arrays [H, W] f32: where in the image of ``drawn_by`` the photo's pixels lie, in its pixels."""
    box, columns = _frames(lens).outer, np.arange(lens.width) + 0.5
    places = (np.empty((lens.height, lens.width), np.float32), np.empty((lens.height, lens.width), np.float32))
    rows = max(1, BAND_PIXELS // lens.width)
    for first in range(0, lens.height, rows):
        here = slice(first, first + rows)
        v, u = np.meshgrid(np.arange(lens.height)[here] + 0.5, columns, indexing="ij")
        x, y = lens.on_plane(u, v)
        places[0][here] = x * lens.fx + lens.cx - box.left
        places[1][here] = y * lens.fy + lens.cy - box.top
    return places
