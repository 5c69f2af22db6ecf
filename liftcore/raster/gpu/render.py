"""``A X`` on the device: images in blocks of channels, the argmax label of every ray, and rows of A of single rays.

The first two are products of a chunk's weights [256, CHUNK] with a row of values per splat: its channels, or its
one-hot label. A single ray has a program of its own, which composites the ray's tile as every product does, so its
row is bitwise identical to the A of the products.
"""

import torch
import triton.language as tl
from torch import Tensor

from liftcore.raster.base import RayRows
from liftcore.raster.gpu.composite import CHUNK, PART, PARTS, blend_chunk, fill_alphas, start_rays, weights_of
from liftcore.raster.gpu.launching import WARPS, jit, lang, launch
from liftcore.raster.gpu.tiles import Frame, TileLists
from liftcore.scene.compositing import TILE

WIDEST = 64  # channels per pass
NARROWEST = 16  # columns of a matrix product, at least

_CHUNK = tl.constexpr(CHUNK)
_TILE = tl.constexpr(TILE)
_PIXELS = tl.constexpr(TILE * TILE)
_SCRATCH, _WEIGHTS = tl.constexpr(PARTS * PART), tl.constexpr(PART)
_NO_LABEL = tl.constexpr(-1)


@jit
def _render(
    places, inks, starts, items, scratch, values, image, band_tile, own_tile, columns, width, height, channels,
    cap, stop, floor, KIND: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    list_tile = own_tile + tl.program_id(0)
    tile = band_tile + list_tile
    top = band_tile // columns * _TILE  # the image is the band's
    own_scratch = scratch + tl.program_id(0) * _SCRATCH
    pixel = tl.arange(0, _PIXELS)
    channel = tl.arange(0, CHANNELS)
    at = tl.load(starts + list_tile)
    last = tl.load(starts + list_tile + 1)
    transmittance = start_rays(tile, columns, width, height)
    sums = tl.zeros([_PIXELS, CHANNELS], tl.float32)
    brightest = lang.max(transmittance, 0)
    while (at < last) & (brightest > 0.0):
        count = (last - at).to(tl.int32)
        fill_alphas(places, inks, items, at, last, tile, columns, own_scratch, cap, floor, KIND, False)
        transmittance = blend_chunk(own_scratch, transmittance, stop, count)
        number = at + tl.arange(0, _CHUNK)
        item = tl.load(items + number, mask=number < last, other=0).to(tl.int64)
        mask = (number < last)[:, None] & (channel < channels)[None, :]
        rows = tl.load(values + item[:, None] * channels + channel[None, :], mask=mask, other=0.0)
        sums += tl.dot(tl.trans(weights_of(own_scratch, count, pixel)), rows, input_precision="ieee")
        brightest = lang.max(transmittance, 0)
        at += _CHUNK
    x = tile % columns * _TILE + pixel % _TILE
    y = tile // columns * _TILE + pixel // _TILE
    place = ((y - top).to(tl.int64) * width + x)[:, None] * channels + channel[None, :]
    tl.store(image + place, sums, mask=((x < width) & (y < height))[:, None] & (channel < channels)[None, :])


@jit
def _strongest(
    places, inks, starts, items, scratch, slots, label_starts, labels, image, band_tile, own_tile, columns, width,
    height, cap, stop, floor, KIND: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    list_tile = own_tile + tl.program_id(0)
    tile = band_tile + list_tile
    own_scratch = scratch + tl.program_id(0) * _SCRATCH
    pixel = tl.arange(0, _PIXELS)
    column = tl.arange(0, COLUMNS)
    last = tl.load(starts + list_tile + 1)
    first_label = tl.load(label_starts + list_tile)
    label_count = (tl.load(label_starts + list_tile + 1) - first_label).to(tl.int32)
    best = tl.zeros([_PIXELS], tl.float32)
    winner = tl.full([_PIXELS], _NO_LABEL, tl.int32)
    for block in range(0, label_count, COLUMNS):
        at = tl.load(starts + list_tile)
        transmittance = start_rays(tile, columns, width, height)
        sums = tl.zeros([_PIXELS, COLUMNS], tl.float32)
        brightest = lang.max(transmittance, 0)
        while (at < last) & (brightest > 0.0):
            count = (last - at).to(tl.int32)
            fill_alphas(places, inks, items, at, last, tile, columns, own_scratch, cap, floor, KIND, False)
            transmittance = blend_chunk(own_scratch, transmittance, stop, count)
            number = at + tl.arange(0, _CHUNK)
            slot = tl.load(slots + number, mask=number < last, other=-1)
            onehot = (slot[:, None] == (block + column)[None, :]).to(tl.float32)
            sums += tl.dot(tl.trans(weights_of(own_scratch, count, pixel)), onehot, input_precision="ieee")
            brightest = lang.max(transmittance, 0)
            at += _CHUNK
        largest, place = lang.max(sums, 1, return_indices=True, return_indices_tie_break_left=True)
        better = largest > best  # labels ascend, so the smallest of equal sums stays
        label = tl.load(labels + first_label + block + place, mask=better, other=_NO_LABEL)
        winner = tl.where(better, label, winner)
        best = tl.where(better, largest, best)
    x = tile % columns * _TILE + pixel % _TILE
    y = tile // columns * _TILE + pixel // _TILE
    tl.store(image + y.to(tl.int64) * width + x, winner, mask=(x < width) & (y < height))


def render(frame: Frame, values: Tensor) -> Tensor:
    """Return ``A X``: values [P, C] f32 on the host, C at most ``WIDEST`` -> [H, W, C] f32 on the host."""
    image = torch.empty(frame.height, frame.width, values.shape[1], dtype=torch.float32)
    for band in frame.bands:
        _render_band(frame, frame.lists_of(band), values, image)
    return image


def _render_band(frame: Frame, lists: TileLists, values: Tensor, image: Tensor) -> None:
    channels = values.shape[1]
    rows = frame.of_splats(values, lists)
    top = lists.first_row * TILE
    tall = min(lists.tiles // frame.columns * TILE, frame.height - top)
    band_image = torch.zeros(tall, frame.width, channels, device=frame.device, dtype=torch.float32)
    wide = max(NARROWEST, 1 << (channels - 1).bit_length())
    for first, last in frame.tile_runs(lists):
        launch(
            _render, last - first, *lists.splats, lists.starts, lists.items, frame.scratch(last - first),
            rows, band_image, lists.first_tile, first, *frame.size, channels, *frame.cuts,
            KIND=frame.kind, CHANNELS=wide, warps=8 if wide == WIDEST else WARPS,
        )  # fmt: skip
    image[top : top + tall] = band_image.cpu()


def strongest_labels(frame: Frame, labels: Tensor) -> Tensor:
    """Return ``argmax(A onehot(labels))``: labels [P] i32 of -1 or more, on the host -> [H, W] i32 on the device."""
    image = torch.full((frame.height, frame.width), -1, dtype=torch.int32, device=frame.device)
    classes = int(labels.max()) + 2
    for band in frame.bands:
        _strongest_in(frame, frame.lists_of(band), labels, classes, image)
    return image


def _strongest_in(frame: Frame, lists: TileLists, labels: Tensor, classes: int, image: Tensor) -> None:
    tiles = torch.arange(lists.tiles, device=frame.device)
    tile_of = torch.repeat_interleave(tiles, lists.starts.diff())
    # The labels that occur in each tile, ascending, and the index of each item's label among them.
    keys = tile_of * classes + frame.of_splats(labels, lists)[lists.items.long()] + 1
    tile_keys, slots = torch.unique(keys, return_inverse=True)
    edges = torch.arange(lists.tiles + 1, device=frame.device)
    label_starts = torch.searchsorted(tile_keys, edges * classes)
    slots = (slots - label_starts[tile_of]).to(torch.int32)
    tile_labels = (tile_keys % classes - 1).to(torch.int32)
    for first, last in frame.tile_runs(lists):
        launch(
            _strongest, last - first, *lists.splats, lists.starts, lists.items, frame.scratch(last - first),
            slots, label_starts, tile_labels, image, lists.first_tile, first, *frame.size, *frame.cuts,
            KIND=frame.kind, COLUMNS=NARROWEST,
        )  # fmt: skip


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
