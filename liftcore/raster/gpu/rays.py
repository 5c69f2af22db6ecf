"""Rows of A of single rays on the device.

A ray has a program of its own, which composites the ray's tile as every product does, so its row is bitwise identical
to the A of the products.
"""

import torch
import triton.language as tl
from torch import Tensor

from liftcore.raster.base import RayRows
from liftcore.raster.gpu.composite import CHUNK, PART, PARTS, blend_chunk, fill_alphas, start_rays
from liftcore.raster.gpu.launching import jit, lang, launch
from liftcore.raster.gpu.tiles import Frame, TileLists
from liftcore.scene.compositing import TILE

_CHUNK = tl.constexpr(CHUNK)
_TILE = tl.constexpr(TILE)
_PIXELS = tl.constexpr(TILE * TILE)
_SCRATCH, _WEIGHTS = tl.constexpr(PARTS * PART), tl.constexpr(PART)


@jit
def _trace(
    places, inks, starts, items, scratch, tiles, pixels, table, table_starts, band_tile, columns, width,
    height, cap, stop, floor, KIND: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0)
    list_tile = tl.load(tiles + ray)
    pixel = tl.load(pixels + ray)
    tile = band_tile + list_tile
    own_scratch = scratch + tl.program_id(0) * _SCRATCH
    at = tl.load(starts + list_tile)
    last = tl.load(starts + list_tile + 1)
    to = table + tl.load(table_starts + ray) + tl.arange(0, _CHUNK)
    # Other rays of the tile have T = 0, so the loop ends when the requested ray terminates.
    transmittance = tl.where(tl.arange(0, _PIXELS) == pixel, start_rays(tile, columns, width, height), 0.0)
    brightest = lang.max(transmittance, 0)
    while (at < last) & (brightest > 0.0):
        count = (last - at).to(tl.int32)
        fill_alphas(places, inks, items, at, last, tile, columns, own_scratch, cap, floor, KIND, False)
        transmittance = blend_chunk(own_scratch, transmittance, stop, count)
        number = tl.arange(0, _CHUNK)
        weights = tl.load(own_scratch + _WEIGHTS + number * _PIXELS + pixel, mask=number < count, other=0.0)
        tl.store(to, weights, mask=number < count)
        brightest = lang.max(transmittance, 0)
        to += _CHUNK
        at += _CHUNK


def ray_rows(frame: Frame, pixels: Tensor) -> RayRows:
    """Return rows of A for pixels [n, 2] i32 (x, y) of the frame; all on the host."""
    tile_rows = pixels[:, 1].long() // TILE
    bands = [band for band in frame.bands if bool(((tile_rows >= band[0]) & (tile_rows < band[1])).any())]
    numbers, parts = [torch.empty(0, dtype=torch.int64)], []
    for band in bands:
        rays = ((tile_rows >= band[0]) & (tile_rows < band[1])).nonzero()[:, 0]
        numbers.append(rays)
        parts += _rows_in(frame, frame.lists_of(band), pixels[rays].long())
    columns = [torch.cat(column) for column in zip(*parts, strict=True)] if parts else _no_entries()
    return _in_order(torch.cat(numbers), *columns)


def _rows_in(frame: Frame, lists: TileLists, pixels: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return lengths, splats and weights of the rows of a band's pixels [n, 2] i64, in blocks that fit in memory."""
    x, y = pixels.unbind(1)
    tiles = (y // TILE - lists.first_row) * frame.columns + x // TILE
    within = (y % TILE * TILE + x % TILE).to(torch.int32).to(frame.device)
    lengths = lists.starts.diff()[tiles.to(frame.device)]
    starts = torch.zeros(len(pixels) + 1, dtype=torch.int64, device=frame.device)
    torch.cumsum(lengths, 0, out=starts[1:])
    ends, rows, first = starts.tolist(), [], 0
    for ray in range(1, len(pixels) + 1):
        full = (
            ray - first == frame.tiles_at_once or ends[min(ray + 1, len(pixels))] - ends[first] > frame.floats_at_once
        )
        if ray == len(pixels) or full:
            rays = tiles[first:ray].to(torch.int32).to(frame.device), within[first:ray].clone()
            rows.append(_ray_rows(frame, lists, rays, starts[first : ray + 1] - ends[first], ends[ray] - ends[first]))
            first = ray
    return rows


def _ray_rows(
    frame: Frame, lists: TileLists, rays: tuple[Tensor, Tensor], starts: Tensor, floats: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return lengths i64, splats i32 and weights f32 of the rows of rays = (tile [n] i32, pixel [n] i32)."""
    table, count = torch.zeros(floats, device=frame.device, dtype=torch.float32), rays[0].shape[0]
    launch(
        _trace, count, *lists.splats, lists.starts, lists.items, frame.scratch(count), *rays, table, starts,
        lists.first_tile, *frame.size, *frame.cuts, KIND=frame.kind,
    )  # fmt: skip
    hit = table.nonzero()[:, 0]
    ray = torch.searchsorted(starts[1:], hit, right=True)
    item = lists.items[lists.starts[rays[0].long()][ray] + hit - starts[ray]]
    lengths = torch.searchsorted(hit, starts).diff()
    return lengths.cpu(), lists.ids[item.long()].cpu(), table[hit].cpu()


def _no_entries() -> list[Tensor]:
    return [torch.empty(0, dtype=dtype) for dtype in (torch.int64, torch.int32, torch.float32)]


def _in_order(numbers: Tensor, lengths: Tensor, splats: Tensor, weights: Tensor) -> RayRows:
    """Sort the rows of the rays ``numbers`` [n] into the order of the rays."""
    order = torch.sort(numbers).indices
    begins = torch.cumsum(lengths, 0) - lengths
    indptr = torch.zeros(len(numbers) + 1, dtype=torch.int64)
    torch.cumsum(lengths[order], 0, out=indptr[1:])
    entries = torch.repeat_interleave(begins[order] - indptr[:-1], lengths[order]) + torch.arange(len(splats))
    return RayRows(indptr, splats[entries], weights[entries])
