"""Maps of a distorted photo, resampled to the pinhole of a camera."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from liftcore.scene.cameras import Camera
from liftcore.scene.distortion import Lens
from liftcore.values.views import FeatureGrid, Regions, ViewFeatures

BAND_VALUES = 1 << 22  # of a grid, carried at a time in float32
BAND_PIXELS = 1 << 15  # distorted at a time: their arrays fit in the cache
KEPT_PINHOLES = 6  # whose labels' places are kept: mostly one lens took all photos


def as_pinhole_sees(observation: ViewFeatures, camera: Camera) -> ViewFeatures:
    """Return the observation of a camera's photo as one of its pinhole; itself where that is the photo's own.

    A pixel of the pinhole reads the label of the pixel of the photo that shows the same ray, so labels get the
    pinhole's size. A grid keeps the size of its cells, and each is read bilinearly where the ray of its centre
    meets the photo: smoother than the given one by less than a cell.
    """
    if camera.lens is None:
        return observation
    pinhole = _Pinhole(camera.lens, camera.width, camera.height, camera.cx, camera.cy)
    if isinstance(observation, FeatureGrid):
        height, width = observation.grid.shape[:2]
        return FeatureGrid.unchecked(_grid(observation.grid, pinhole, grid_sides(height, width, camera)))
    places = _label_places(pinhole, *observation.labels.shape[1:])
    labels = observation.labels.flatten(1).index_select(1, places)
    return Regions.unchecked(labels.reshape(-1, camera.height, camera.width), observation.codebook)


def grid_sides(height: int, width: int, camera: Camera) -> tuple[int, int]:
    """Return rows and columns of a grid [height, width] of the camera's photo, as its pinhole sees it."""
    photo = camera.lens
    if photo is None:
        return height, width
    rows, columns = height * camera.height / photo.height, width * camera.width / photo.width
    return max(1, round(rows)), max(1, round(columns))


@lru_cache(maxsize=KEPT_PINHOLES)
def _label_places(pinhole: "_Pinhole", height: int, width: int) -> Tensor:
    """Return [H * W] i32, i64 of huge maps: the index in labels [height, width] of the photo for each pixel."""
    places = np.empty((pinhole.height, pinhole.width), np.int32 if height * width < 1 << 31 else np.int64)
    band = max(1, BAND_PIXELS // pinhole.width)
    columns = np.arange(pinhole.width) + 0.5
    for first in range(0, pinhole.height, band):
        band_rows = slice(first, first + band)
        u, v = np.meshgrid(columns, np.arange(pinhole.height)[band_rows] + 0.5)
        x, y = _shares(u, v, pinhole)
        rows, column_indices = (y * height).astype(np.int64), (x * width).astype(np.int64)
        places[band_rows] = rows.clip(0, height - 1) * width + column_indices.clip(0, width - 1)
    return torch.from_numpy(places.ravel())


def _grid(grid: Tensor, pinhole: "_Pinhole", sides: tuple[int, int]) -> Tensor:
    """Return [rows, columns, F] of a grid [h, w, F] of the photo, of its dtype."""
    (height, width, channels), (rows, columns) = grid.shape, sides
    centres = np.meshgrid(
        (np.arange(columns) + 0.5) * pinhole.width / columns, (np.arange(rows) + 0.5) * pinhole.height / rows
    )
    x, y = _shares(*centres, pinhole)
    u, v = (x * width - 0.5).clip(0, width - 1), (y * height - 0.5).clip(0, height - 1)
    left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    cells = grid.reshape(-1, channels)
    carried = torch.empty((*x.shape, channels), dtype=grid.dtype)
    band = max(1, BAND_VALUES // (x.shape[1] * channels))
    for first in range(0, x.shape[0], band):
        band_rows = slice(first, first + band)
        total = torch.zeros((*x[band_rows].shape, channels), dtype=torch.float32)
        for row in (0, 1):
            for column in (0, 1):
                share = (1 - np.abs(u - left - column)) * (1 - np.abs(v - top - row))
                place = (top + row).clip(max=height - 1) * width + (left + column).clip(max=width - 1)
                features = cells[torch.from_numpy(place[band_rows])].to(torch.float32)
                total += features * torch.from_numpy(share[band_rows].astype(np.float32))[..., None]
        carried[band_rows] = total.to(grid.dtype)
    return carried


class _Pinhole(NamedTuple):
    """A camera of a distorted photo, by what its maps depend on."""

    photo: Lens
    width: int
    height: int
    cx: float
    cy: float


def _shares(u: np.ndarray, v: np.ndarray, pinhole: _Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """Project places (u, v) of a pinhole to the photo, as shares of its sides."""
    photo = pinhole.photo
    x, y = photo.on_photo((u - pinhole.cx) / photo.fx, (v - pinhole.cy) / photo.fy)
    return x / photo.width, y / photo.height
