"""Lens distortion, and the pinhole image within a distorted photo: the models of OpenCV and COLMAP.

A ray is given by its point on the plane one unit before the camera: a pinhole images the ray (x, y) at (x, y), the
lens at (x', y'). Where a model is not monotonic, so that two rays have the same image, it has no inverse, and
``straight`` gives NaN.

Splats are rasterized with pinholes, so a lens has the pinhole of the same focal lengths whose image is the largest
upright rectangle within the photo (``Lens.inner``), as gsplat and nerfstudio train on. Images of answers are rendered
with a wider one that covers the whole photo (``Lens.outer``), and resampled to the photo's pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from liftcore.scene.compositing import MAX_SIDE

ITERATIONS = 30  # of Newton's method, which needs four to six for real lenses
TOLERANCE = 1e-9  # on the plane: a millionth of a pixel
RADII, DIRECTIONS = 513, 16  # samples at which a model is checked to be monotonic
FARTHEST = 1e3  # on the plane: stands for rays of a fisheye that point sideways or backwards
WIDEST = float(np.tan(np.radians(60)))  # of a pinhole's image from its axis, in x and in y, on the plane
GROWTH = 0.5  # of the photo's sides, by which a pinhole's image is larger on each side at most
LEAST_SHARE = 0.1  # of the photo that its pinhole must cover: below it the calibration is broken
ROUNDING = 1e-3  # pixels
BORDER_PLACES = 33  # samples on each side of the photo, and again between the neighbours of the extreme one
NARROWINGS = 3  # rounds of sampling, which find the extreme one to 1e-6 pixels
INWARDS = np.array([1.0, 1.0, -1.0, -1.0])  # from the left, top, right and bottom side
BAND_PIXELS = 1 << 15  # resampled at a time: their arrays fit in the cache


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

    def distorted(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the lens images rays that a pinhole images at (x, y), f64, on the plane."""
        p1, p2, squares = self.p1, self.p2, x * x + y * y
        radial = self._radial(squares)[0]
        across = 2 * x * y
        return (
            radial * x + p1 * across + p2 * (squares + 2 * x * x),
            radial * y + p1 * (squares + 2 * y * y) + p2 * across,
        )

    def straight(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the inverse of ``distorted``, by Newton's method; NaN where there is none, or beyond ``reach``."""

        def miss(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            across, down = self.distorted(u, v)
            return across - x, down - y

        u, v = np.array(x, np.float64), np.array(y, np.float64)
        with np.errstate(all="ignore"):  # divergence shows in the residual
            for _ in range(ITERATIONS):
                miss_x, miss_y = miss(u, v)
                if max(np.abs(miss_x).max(), np.abs(miss_y).max()) < TOLERANCE:
                    break
                a, b, d = self._slopes(u, v)
                determinant = a * d - b * b
                u, v = u - (d * miss_x - b * miss_y) / determinant, v - (a * miss_y - b * miss_x) / determinant
            failed = ~(np.hypot(*miss(u, v)) < 100 * TOLERANCE)
        return np.where(failed, np.nan, u), np.where(failed, np.nan, v)

    def reach(self, radius: float) -> float:
        """Return the radius on the plane up to which the model is monotonic; infinity if it is up to ``radius``."""
        angles = np.arange(DIRECTIONS if self.p1 or self.p2 else 1) * (2 * np.pi / DIRECTIONS)
        radii = np.linspace(0, radius, RADII)
        with np.errstate(all="ignore"):  # at a pole no comparison is true
            a, b, d = self._slopes(radii[:, None] * np.cos(angles), radii[:, None] * np.sin(angles))
            forth = np.all((a * d - b * b > 0) & (a + d > 0), axis=1, keepdims=True)[:, 0]
        return _first_back(forth, radii)

    def _slopes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the derivatives of x' by x, of x' by y, which is that of y' by x, and of y' by y."""
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

    def distorted(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the lens images rays that a pinhole images at (x, y), f64, on the plane."""
        radius = np.hypot(x, y)
        factor = _ratio(self._distorted_radius(np.arctan(radius))[0], radius)
        return x * factor, y * factor

    def straight(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the inverse, by Newton's method; at FARTHEST what no pinhole sees; NaN as for ``Brown``."""
        radius = np.hypot(x, y)
        angle = radius.copy()
        with np.errstate(all="ignore"):
            for _ in range(ITERATIONS):
                distorted, slope = self._distorted_radius(angle)
                if np.abs(distorted - radius).max() < TOLERANCE:
                    break
                angle = angle - (distorted - radius) / slope
            failed = ~((np.abs(self._distorted_radius(angle)[0] - radius) < 100 * TOLERANCE) & (angle >= 0))
            reach = np.where(angle < np.pi / 2, np.minimum(np.tan(angle), FARTHEST), FARTHEST)
        factor = _ratio(reach, radius)
        return np.where(failed, np.nan, x * factor), np.where(failed, np.nan, y * factor)

    def reach(self, radius: float) -> float:
        """Return the radius on the plane up to which the model is monotonic; infinity if it is up to ``radius``."""
        angles = np.linspace(0, np.arctan(radius), RADII)
        with np.errstate(all="ignore"):
            return _first_back(self._distorted_radius(angles)[1] > 0, np.tan(angles))

    def _distorted_radius(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """r' and its derivative."""
        k1, k2, k3, k4, a = self.k1, self.k2, self.k3, self.k4, angle * angle
        distorted = angle * (1 + a * (k1 + a * (k2 + a * (k3 + a * k4))))
        return distorted, 1 + a * (3 * k1 + a * (5 * k2 + a * (7 * k3 + a * 9 * k4)))


def _ratio(lengths: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return lengths divided by a radius, 1 where it is zero."""
    return np.divide(lengths, radius, out=np.ones_like(radius), where=radius > 0)


def _first_back(forth: np.ndarray, radii: np.ndarray) -> float:
    """Return the last of the radii [n] before the first that is not ``forth`` [n]; infinity where all are."""
    return math.inf if forth.all() else float(radii[max(0, int(np.argmin(forth)) - 1)])


Distortion = Brown | Fisheye


@dataclass(frozen=True)
class Rectangle:
    """Whole pixels of a pinhole with a lens's focal lengths and principal point; the first ones may be negative."""

    left: int
    top: int
    right: int
    bottom: int


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
        """Project rays through (x, y), on the plane one unit before the camera, to pixels of the photo."""
        u, v = self.distortion.distorted(x, y)
        return self.fx * u + self.cx, self.fy * v + self.cy

    def on_plane(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unproject pixels (u, v) of the photo to points on that plane; NaN where a pixel shows no ray."""
        x, y = self.distortion.straight((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        with np.errstate(invalid="ignore"):
            within = np.hypot(x, y) <= self._reach
        return np.where(within, x, np.nan), np.where(within, y, np.nan)

    @cached_property
    def inner(self) -> Rectangle:
        """The largest rectangle within the photo."""
        rectangle = self._within_reach(self._ends_of_sides(INWARDS))
        if rectangle.left >= rectangle.right or rectangle.top >= rectangle.bottom:
            raise ValueError("one whose pinhole image within the photo is empty")
        share = self._share_of(rectangle)
        if math.isnan(share):
            raise ValueError(
                "one that is not monotonic within the photo, so that two of its pixels show the same ray"
            )
        if share < LEAST_SHARE:
            raise ValueError(f"one whose pinhole image covers {share:.1%} of the photo")
        return rectangle

    @cached_property
    def outer(self) -> Rectangle:
        """The smallest rectangle that covers the photo, as far as a pinhole can.

        Where the photo's border shows no ray, because it is beyond ``reach``, the last ray in its direction counts.
        """
        left, top, right, bottom = self._ends_of_sides(-INWARDS)
        return Rectangle(math.floor(left), math.floor(top), math.ceil(right), math.ceil(bottom))

    @cached_property
    def share(self) -> float:
        """Share of the photo's area that ``inner`` covers."""
        return self._share_of(self.inner)

    @cached_property
    def _reach(self) -> float:
        """Radius on the plane up to which pixels are unique; infinity: all that a pinhole can see."""
        return self.distortion.reach(2 * WIDEST)

    def _ends_of_sides(self, towards: np.ndarray) -> list[float]:
        """Return the extremes of the photo's left, top, right and bottom side, in pixels of the pinhole, x or y.

        A side is curved, and where the principal point is off the centre its extreme lies between evenly spaced
        samples: the interval about it is sampled again, NARROWINGS times. It is the largest or smallest x or y of a
        side, as ``towards`` [4] is 1 or -1.
        """
        sides, low, high = np.arange(4), np.zeros((4, 1)), np.ones((4, 1))
        positions, extreme = np.zeros((4, 1)), np.zeros(4, np.int64)
        for _ in range(NARROWINGS):
            places = low + (high - low) * np.linspace(0, 1, BORDER_PLACES)
            positions = self._sides(places)
            extreme = np.argmax(positions * towards[:, None], axis=1)
            low, high = (places[sides, (extreme + step).clip(0, BORDER_PLACES - 1)][:, None] for step in (-1, 1))
        return positions[sides, extreme].tolist()

    def _sides(self, places: np.ndarray) -> np.ndarray:
        """Map places [4, n] in 0..1 along the left, top, right and bottom side to pixels of the pinhole, x or y.

        Where a side shows no ray, the last one in its direction is used.
        """
        down, across = places[::2] * self.height, places[1::2] * self.width
        u = np.stack([0 * down[0], across[0], 0 * down[1] + self.width, across[1]])
        v = np.stack([down[0], 0 * across[0], down[1], 0 * across[1] + self.height])
        x, y = self.on_plane(u, v)
        towards = np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy])
        last = min(self._reach, 2 * WIDEST) * towards / np.maximum(np.hypot(*towards), np.finfo(np.float32).tiny)
        x, y = np.where(np.isnan(x), last[0], x), np.where(np.isnan(y), last[1], y)
        of_x, of_y = (self.fx, self.cx, self.width), (self.fy, self.cy, self.height)
        return np.stack([_pixels(x[0], *of_x), _pixels(y[1], *of_y), _pixels(x[2], *of_x), _pixels(y[3], *of_y)])

    def _within_reach(self, sides: list[float]) -> Rectangle:
        """Return the whole pixels within such sides, shrunk towards the axis until the corners are within reach."""
        left, top, right, bottom = sides
        corner = np.hypot(
            max(abs(left - self.cx), abs(right - self.cx)) / self.fx,
            max(abs(top - self.cy), abs(bottom - self.cy)) / self.fy,
        )
        nearer = min(1.0, self._reach / corner) if corner > 0 else 1.0
        left, right = (self.cx + nearer * (side - self.cx) for side in (left, right))
        top, bottom = (self.cy + nearer * (side - self.cy) for side in (top, bottom))
        return Rectangle(int(np.ceil(left)), int(np.ceil(top)), int(np.floor(right)), int(np.floor(bottom)))

    def _share_of(self, box: Rectangle) -> float:
        """Return the share of the photo's area that a rectangle covers; NaN where it extends beyond the photo."""
        steps = np.linspace(0, 1, BORDER_PLACES)[:-1]
        width, height = box.right - box.left, box.bottom - box.top
        along, back, still = box.left + width * steps, box.right - width * steps, 0 * steps
        u = np.concatenate([along, still + box.right, back, still + box.left])
        v = np.concatenate(
            [still + box.top, box.top + height * steps, still + box.bottom, box.bottom - height * steps]
        )
        x, y = self.on_photo((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        past = max(-x.min(), -y.min(), x.max() - self.width, y.max() - self.height)
        if not past <= ROUNDING:
            return math.nan
        area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
        return area / (self.width * self.height)


def _pixels(places: np.ndarray, focal: float, centre: float, length: int) -> np.ndarray:
    """Convert a side of the photo on the plane to pixels of the pinhole, clipped to a reasonable image."""
    margin = min(GROWTH * length, (MAX_SIDE - length) / 2)
    return np.clip(np.clip(places, -WIDEST, WIDEST) * focal + centre, -margin, length + margin)


@lru_cache(maxsize=256)
def shared_lens(lens: Lens) -> Lens:
    """Return the first lens that was equal to this one, whose rectangles are computed already."""
    return lens


@lru_cache(maxsize=1)  # 8 bytes a pixel; mostly all photos have the same lens
def photo_places(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y [H, W] f32 of the photo's pixels, in pixels of the image of ``lens.outer``."""
    columns = np.arange(lens.width) + 0.5
    places = (np.empty((lens.height, lens.width), np.float32), np.empty((lens.height, lens.width), np.float32))
    rows = max(1, BAND_PIXELS // lens.width)
    for first in range(0, lens.height, rows):
        band = slice(first, first + rows)
        v, u = np.meshgrid(np.arange(lens.height)[band] + 0.5, columns, indexing="ij")
        x, y = lens.on_plane(u, v)
        places[0][band] = x * lens.fx + lens.cx - lens.outer.left
        places[1][band] = y * lens.fy + lens.cy - lens.outer.top
    return places
