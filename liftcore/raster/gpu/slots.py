"""S on the device: which slots the pixels of each tile read, and how much.

As on the CPU (``cpu.weights``), a slot of a region map is a distinct tuple of labels on all levels, a
slot of a grid is a cell, and both become the same thing: one or four taps a pixel, a slot and a share each. A sort of
every tile's keys finds its slots, so their numbers do not depend on who is first.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch

from liftcore.raster.base import TILE
from liftcore.raster.cpu.weights import reading_of

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.features.views import ViewFeatures
    from liftcore.raster.base import CompositingParams
    from liftcore.raster.cpu.weights import Reading
    from liftcore.scene.cameras import Camera

PIXELS = TILE * TILE
NONE = -1
_LARGEST_KEY = 1 << 62


class Slots(NamedTuple):
    """What the tiles of a run read."""

    taps: Tensor  # [tiles, T, 256] i32, the slot of each pixel's taps, counted in the tile; -1 none
    shares: Tensor  # [tiles, T, 256] f32, of the taps; [0] for region maps, whose shares are one
    starts: Tensor  # [tiles + 1] i64, the slots of each tile in rows
    rows: Tensor  # [slots, levels] i32, the codebook rows of a slot, -1 none


class DeviceReading:
    """S of one view, by pixel. It is made on the host, by any thread, and comes to the device when first asked."""

    def __init__(
        self, observation: ViewFeatures, camera: Camera, walk: CompositingParams, device: torch.device
    ) -> None:
        reading = reading_of(observation, camera.width, camera.height, walk)
        self.codebook_rows, self.levels = reading.codebook_rows, reading.levels
        self.taps = 4 if reading.is_grid else 1
        self._grid_width = reading.grid_width
        self._device, parts = device, _parts(reading)
        self._waiting = [part.pin_memory() for part in parts] if device.type == "cuda" else list(parts)

    def slots(self, first: int, last: int, columns: int) -> Slots:
        """The slots of tiles ``first..last`` of a view with ``columns`` tiles a row."""
        if self._waiting:
            there = [part.to(self._device, non_blocking=True) for part in self._waiting]
            self._x, self._y, self._share_x, self._share_y, self._labels = there
            self._waiting.clear()
        tile = torch.arange(first, last, device=self._x.device)[:, None]
        pixel = torch.arange(PIXELS, device=self._x.device)[None, :]
        x, y = tile % columns * TILE + pixel % TILE, tile // columns * TILE + pixel // TILE
        inside = (x < self._x.shape[0]) & (y < self._y.shape[0])
        x, y = x.clamp(max=self._x.shape[0] - 1), y.clamp(max=self._y.shape[0] - 1)
        return self._cells(x, y, inside) if self.taps == 4 else self._tuples(x, y, inside)

    def _tuples(self, x: Tensor, y: Tensor, inside: Tensor) -> Slots:
        labels = self._labels[:, self._y[y], self._x[x]]  # [L, tiles, 256]
        keys, classes = torch.zeros_like(x), 1
        for level in labels:
            if classes * (self.codebook_rows + 1) > _LARGEST_KEY:
                known, keys = torch.unique(keys, return_inverse=True)
                classes = known.shape[0]
            keys = keys * (self.codebook_rows + 1) + level + 1
            classes *= self.codebook_rows + 1
        keys = torch.where(inside & (labels >= 0).any(dim=0), keys, NONE)
        taps, starts, tile, place = _numbered(keys)
        rows = labels[:, tile, place].T.contiguous()
        return Slots(taps, torch.empty(0, device=x.device), starts, rows)

    def _cells(self, x: Tensor, y: Tensor, inside: Tensor) -> Slots:
        keys, shares = [], []
        for right, below in ((0, 0), (1, 0), (0, 1), (1, 1)):
            share_x = self._share_x[x] if right else 1 - self._share_x[x]
            share_y = self._share_y[y] if below else 1 - self._share_y[y]
            share = share_x * share_y
            cell = (self._y[y] + below) * self._grid_width + self._x[x] + right
            keys.append(torch.where(inside & (share > 0), cell, NONE))
            shares.append(share)
        every = torch.cat(keys, dim=1)
        taps, starts, tile, place = _numbered(every)
        return Slots(taps, torch.cat(shares, dim=1).contiguous(), starts, every[tile, place].to(torch.int32)[:, None])


def _parts(reading: Reading) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Columns and rows that pixels read [W], [H] i64, the shares of the next ones f32, and the labels [L, h, w]."""
    x, y = (reading.cell_x, reading.cell_y) if reading.is_grid else (reading.label_x, reading.label_y)
    columns, rows = torch.from_numpy(x).long(), torch.from_numpy(y).long()
    shares = torch.from_numpy(reading.share_x), torch.from_numpy(reading.share_y)
    return columns, rows, *shares, torch.from_numpy(reading.labels)


def _numbered(keys: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The distinct keys of every row of [tiles, n], numbered from 0 on; a key of -1 is none.

    Returns:
        numbers [tiles, n] i32; starts [tiles + 1] i64 of each row's distinct keys; and where each of them stands for
        the first time: row [s] i64 and place [s] i64.
    """
    by_key = torch.sort(keys, dim=1, stable=True)
    fresh = by_key.values != NONE
    fresh[:, 1:] &= by_key.values[:, 1:] != by_key.values[:, :-1]
    numbers = torch.empty_like(keys, dtype=torch.int32)
    numbers.scatter_(1, by_key.indices, (torch.cumsum(fresh, 1) - 1).to(torch.int32))
    starts = torch.zeros(keys.shape[0] + 1, dtype=torch.int64, device=keys.device)
    torch.cumsum(fresh.sum(dim=1), 0, out=starts[1:])
    row, place = fresh.nonzero().unbind(1)
    return numbers, starts, row, by_key.indices[row, place]
