"""Rows of A on the device: one program a ray walks the tile that the ray is in, as every product walks it.

The weights that a ray meets go to its own part of a table, as long as its tile's list, and what is not zero there is
its row. So the rows are those of the A that the products know, to the bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton.language as tl

from liftcore.raster.base import TILE, RayRows
from liftcore.raster.gpu.launching import jit, lang, launch
from liftcore.raster.gpu.walk import CHUNK, PART, PARTS, blend_chunk, fill_alphas, start_rays

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.gpu.frame import Frame
    from liftcore.raster.gpu.tile_lists import Lists

_CHUNK = tl.constexpr(CHUNK)
_SCRATCH, _WEIGHTS = tl.constexpr(PARTS * PART), tl.constexpr(PART)
_PIXELS = tl.constexpr(TILE * TILE)


@jit
def _trace(
    places, inks, starts, items, scratch, tiles, pixels, table, table_starts, band_tile, columns, width,
    height, cap, stop, floor, KIND: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0)
    own = tl.load(tiles + ray)
    pixel = tl.load(pixels + ray)
    tile = band_tile + own
    mine = scratch + tl.program_id(0) * _SCRATCH
    at = tl.load(starts + own)
    last = tl.load(starts + own + 1)
    to = table + tl.load(table_starts + ray) + tl.arange(0, _CHUNK)
    # Other rays of the tile are dark, so the walk ends with the one that is asked for.
    light = tl.where(tl.arange(0, _PIXELS) == pixel, start_rays(tile, columns, width, height), 0.0)
    lit = lang.max(light, 0)
    while (at < last) & (lit > 0.0):
        count = (last - at).to(tl.int32)
        fill_alphas(places, inks, items, at, last, tile, columns, mine, cap, floor, KIND, False)
        light = blend_chunk(mine, light, stop, count)
        number = tl.arange(0, _CHUNK)
        weights = tl.load(mine + _WEIGHTS + number * _PIXELS + pixel, mask=number < count, other=0.0)
        tl.store(to, weights, mask=number < count)
        lit = lang.max(light, 0)
        to += _CHUNK
        at += _CHUNK


def ray_rows(frame: Frame, pixels: Tensor) -> RayRows:
    """Rows of A for pixels [n, 2] i32 (x, y) of the frame; all on the host."""
    tile_rows = pixels[:, 1].long() // TILE
    bands = [band for band in frame.bands if bool(((tile_rows >= band[0]) & (tile_rows < band[1])).any())]
    numbers, parts = [torch.empty(0, dtype=torch.int64)], []
    for band in bands:
        own = ((tile_rows >= band[0]) & (tile_rows < band[1])).nonzero()[:, 0]
        numbers.append(own)
        parts += _rows_in(frame, frame.lists_of(band), pixels[own].long())
    found = [torch.cat(column) for column in zip(*parts, strict=True)] if parts else _nothing()
    return _in_order(torch.cat(numbers), *found)


def _rows_in(frame: Frame, lists: Lists, pixels: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Lengths, splats and weights of the rows of a band's pixels [n, 2] i64, as many at a time as fit."""
    x, y = pixels.unbind(1)
    tiles = (y // TILE - lists.first_row) * frame.columns + x // TILE
    within = (y % TILE * TILE + x % TILE).to(torch.int32).to(frame.device)
    lengths = lists.starts.diff()[tiles.to(frame.device)]
    starts = torch.zeros(len(pixels) + 1, dtype=torch.int64, device=frame.device)
    torch.cumsum(lengths, 0, out=starts[1:])
    ends, found, first = starts.tolist(), [], 0
    for ray in range(1, len(pixels) + 1):
        full = ray - first == frame.room.tiles or ends[min(ray + 1, len(pixels))] - ends[first] > frame.room.table
        if ray == len(pixels) or full:
            rays = tiles[first:ray].to(torch.int32).to(frame.device), within[first:ray].clone()
            found.append(_walked(frame, lists, rays, starts[first : ray + 1] - ends[first], ends[ray] - ends[first]))
            first = ray
    return found


def _walked(
    frame: Frame, lists: Lists, rays: tuple[Tensor, Tensor], starts: Tensor, floats: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Lengths i64, splats i32 and weights f32 of the rows of rays, given by tile and pixel [n] i32."""
    table, count = torch.zeros(floats, device=frame.device), rays[0].shape[0]
    launch(
        _trace, count, *lists.splats, lists.starts, lists.items, frame.scratch(count), *rays, table, starts,
        lists.first_tile, *frame.size, *frame.cuts, KIND=frame.kind,
    )  # fmt: skip
    met = table.nonzero()[:, 0]
    ray = torch.searchsorted(starts[1:], met, right=True)
    item = lists.items[lists.starts[rays[0].long()][ray] + met - starts[ray]]
    lengths = torch.searchsorted(met, starts).diff()
    return lengths.cpu(), lists.ids[item.long()].cpu(), table[met].cpu()


def _nothing() -> list[Tensor]:
    return [torch.empty(0, dtype=dtype) for dtype in (torch.int64, torch.int32, torch.float32)]


def _in_order(numbers: Tensor, lengths: Tensor, splats: Tensor, weights: Tensor) -> RayRows:
    """Rows of the rays ``numbers`` [n], put into the order of the rays."""
    order = torch.sort(numbers).indices
    begins = torch.cumsum(lengths, 0) - lengths
    indptr = torch.zeros(len(numbers) + 1, dtype=torch.int64)
    torch.cumsum(lengths[order], 0, out=indptr[1:])
    own = torch.repeat_interleave(begins[order] - indptr[:-1], lengths[order]) + torch.arange(len(splats))
    return RayRows(indptr, splats[own], weights[own])
