"""What a camera's pinhole observes of a distorted photo: its maps, carried from the photo's pixels to its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.observe.observation import FeatureGrid, Observation, RegionMap

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.scene.cameras import Camera

BAND_VALUES = 1 << 22  # of a grid, carried at a time in float32


def as_pinhole_sees(observation: Observation, camera: Camera) -> Observation:
    """The observation of a camera's photo as one of its pinhole; itself where the camera has no lens.

    A pixel of the pinhole reads the label of the pixel of the photo that shows the same ray, so labels get the
    pinhole's size. A grid keeps the size of its cells, and each is read bilinearly where the ray of its centre
    meets the photo: smoother than the given one by less than a cell.
    """
    if camera.lens is None:
        return observation
    if isinstance(observation, RegionMap):
        return RegionMap(_labels(observation.labels, camera), observation.codebook)
    return FeatureGrid(_grid(observation.grid, camera))


def grid_sides(height: int, width: int, camera: Camera) -> tuple[int, int]:
    """Rows and columns of a grid [height, width] of the camera's photo, as its pinhole sees it."""
    if camera.lens is None:
        return height, width
    rows, columns = height * camera.height / camera.lens.height, width * camera.width / camera.lens.width
    return max(1, round(rows)), max(1, round(columns))


def _labels(labels: Tensor, camera: Camera) -> Tensor:
    """[L, H, W] i32 of labels [L, h, w] of the photo."""
    height, width = labels.shape[1:]
    x, y = _shares(camera.height, camera.width, camera)
    columns, rows = (x * width).astype(np.int64), (y * height).astype(np.int64)
    places = torch.from_numpy(rows.clip(0, height - 1) * width + columns.clip(0, width - 1))
    return labels.flatten(1)[:, places.flatten()].reshape(labels.shape[0], camera.height, camera.width)


def _grid(grid: Tensor, camera: Camera) -> Tensor:
    """[rows, columns, F] of a grid [h, w, F] of the photo, of its dtype."""
    height, width, channels = grid.shape
    x, y = _shares(*grid_sides(height, width, camera), camera)
    u, v = (x * width - 0.5).clip(0, width - 1), (y * height - 0.5).clip(0, height - 1)
    left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    cells = grid.reshape(-1, channels)
    carried = torch.empty((*x.shape, channels), dtype=grid.dtype)
    band = max(1, BAND_VALUES // (x.shape[1] * channels))
    for first in range(0, x.shape[0], band):
        here = slice(first, first + band)
        total = torch.zeros((*x[here].shape, channels))
        for row in (0, 1):
            for column in (0, 1):
                share = (1 - np.abs(u - left - column)) * (1 - np.abs(v - top - row))
                place = (top + row).clip(max=height - 1) * width + (left + column).clip(max=width - 1)
                taken = cells[torch.from_numpy(place[here])].to(torch.float32)
                total += taken * torch.from_numpy(share[here].astype(np.float32))[..., None]
        carried[here] = total.to(grid.dtype)
    return carried


def _shares(rows: int, columns: int, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Two arrays [rows, columns] f64: where on the photo the centres of such a map of the pinhole lie, as shares."""
    lens = camera.lens
    if lens is None:
        raise ValueError("the camera has no lens")
    u, v = np.meshgrid(
        (np.arange(columns) + 0.5) * camera.width / columns, (np.arange(rows) + 0.5) * camera.height / rows
    )
    x, y = lens.on_photo((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    return x / lens.width, y / lens.height
