"""``W = A'^T S`` on the device, a sum over the pixels of each tile.

It is the product of a chunk's weights [CHUNK, 256] with a matrix of the tile's pixels, the shares of the slots. A
slot of a region map is a distinct tuple of labels on all levels, a slot of a grid is a cell; either becomes one or
four taps per pixel. The pixel loop does not depend on labels or rows of the codebook. Item k of a tile's list has row
k of the tile's table of sums, so every sum has a fixed address, and no two programs add to the same one.

Sums over tiles are float64, in a fixed order: a stable sort groups the terms of a key in the order of tiles, and runs
of up to ``RUN`` of them are added one after the other, until one sum is left. Tiles are weighed in runs that bound
the memory, and then the sums of all runs are added.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
import triton.language as tl
from torch import Tensor

from liftcore.raster.cpu.weights import ViewReading, reading_of
from liftcore.raster.gpu.composite import CHUNK, PART, PARTS, blend_chunk, fill_alphas, start_rays, weights_of
from liftcore.raster.gpu.launching import jit, lang, launch
from liftcore.raster.gpu.tiles import Frame, expand_counts
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import TILE, CompositingParams
from liftcore.values.region_weights import RegionWeights, one_view
from liftcore.values.views import ViewFeatures

PIXELS = TILE * TILE
NONE = -1
_LARGEST_KEY = 1 << 62
RUN = 32  # terms that one thread adds
_RUNS_A_PROGRAM = 128
COLUMNS = 16  # of a tile's matrix at a time
BLOCK = 64  # of its rows at a time, as the operands must fit in registers
TILES_AT_ONCE = 1 << 12  # programs of a launch, each with its own scratch
FLOATS_AT_ONCE = 1 << 24  # of a launch's table of sums, unless a tile alone has more

_CHUNK = tl.constexpr(CHUNK)
_TILE = tl.constexpr(TILE)
_PIXELS = tl.constexpr(TILE * TILE)
_SCRATCH = tl.constexpr(PARTS * PART)
_COLUMNS, _BLOCK = tl.constexpr(COLUMNS), tl.constexpr(BLOCK)


class TileInputs(NamedTuple):
    """Taps and slots of all tiles of a view."""

    taps: Tensor  # [tiles, T, 256] i32, the slot of each pixel's taps, numbered within the tile; -1 none
    shares: Tensor  # [tiles, T, 256] f32, of the taps; [0] for region maps, whose shares are one
    starts: Tensor  # [tiles + 1] i64, the slots of each tile in rows
    rows: Tensor  # [slots, levels] i32, the codebook rows of a slot, -1 none


class DeviceReading:
    """S of one view, by pixel. It is built on the host, in any thread, and copied to the device by `slots`."""

    def __init__(
        self, observation: ViewFeatures, camera: Camera, params: CompositingParams, device: torch.device
    ) -> None:
        reading = reading_of(observation, camera.width, camera.height, params)
        self.codebook_rows, self.taps = reading.codebook_rows, 4 if reading.is_grid else 1
        self._grid_width = reading.grid_width
        self._device, parts = device, _parts(reading)
        self._parts = [part.pin_memory() for part in parts] if device.type == "cuda" else list(parts)

    def slots(self, tiles: int, columns: int) -> TileInputs:
        """Return the slots of all tiles of a view with ``columns`` tiles per row."""
        x_reads, y_reads, *rest = (part.to(self._device, non_blocking=True) for part in self._parts)
        tile = torch.arange(tiles, device=self._device)[:, None]
        pixel = torch.arange(PIXELS, device=self._device)[None, :]
        x, y = tile % columns * TILE + pixel % TILE, tile // columns * TILE + pixel // TILE
        inside = (x < x_reads.shape[0]) & (y < y_reads.shape[0])
        x, y = x.clamp(max=x_reads.shape[0] - 1), y.clamp(max=y_reads.shape[0] - 1)
        share_x, share_y, labels = rest
        if self.taps == 1:
            return self._tuples(labels[:, y_reads[y], x_reads[x]], inside)
        return self._cells(x_reads[x], y_reads[y], share_x[x], share_y[y], inside)

    def _tuples(self, labels: Tensor, inside: Tensor) -> TileInputs:
        """Return the slots of labels [L, tiles, 256]."""
        keys, classes = torch.zeros_like(inside, dtype=torch.int64), 1
        for level in labels:
            if classes * (self.codebook_rows + 1) > _LARGEST_KEY:
                distinct, keys = torch.unique(keys, return_inverse=True)
                classes = distinct.shape[0]
            keys = keys * (self.codebook_rows + 1) + level + 1
            classes *= self.codebook_rows + 1
        keys = torch.where(inside & (labels >= 0).any(dim=0), keys, NONE)
        taps, starts, tile, place = _number_keys(keys)
        rows = labels[:, tile, place].T.contiguous()
        return TileInputs(taps, torch.empty(0, device=keys.device, dtype=torch.float32), starts, rows)

    def _cells(self, x: Tensor, y: Tensor, share_x: Tensor, share_y: Tensor, inside: Tensor) -> TileInputs:
        """Return the slots of pixels [tiles, 256] that read the cell (x, y), the next ones by their shares."""
        keys, shares = [], []
        for right, below in ((0, 0), (1, 0), (0, 1), (1, 1)):
            share = (share_x if right else 1 - share_x) * (share_y if below else 1 - share_y)
            keys.append(torch.where(inside & (share > 0), (y + below) * self._grid_width + x + right, NONE))
            shares.append(share)
        tile_keys = torch.cat(keys, dim=1)
        taps, starts, tile, place = _number_keys(tile_keys)
        rows = tile_keys[tile, place].to(torch.int32)[:, None]
        return TileInputs(taps, torch.cat(shares, dim=1).contiguous(), starts, rows)


def _parts(reading: ViewReading) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return columns [W] and rows [H] i64 that pixels read, the shares of the next ones f32, and the labels [L, h,
    w].
    """
    x, y = (reading.cell_x, reading.cell_y) if reading.is_grid else (reading.label_x, reading.label_y)
    columns, rows = torch.from_numpy(x).long(), torch.from_numpy(y).long()
    shares = torch.from_numpy(reading.share_x), torch.from_numpy(reading.share_y)
    return columns, rows, *shares, torch.from_numpy(reading.labels)


def _number_keys(keys: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Number the distinct keys of every row of [tiles, n] from 0 on; -1 is no key.

    Returns:
        numbers [tiles, n] i32; starts [tiles + 1] i64 of each row's distinct keys; and the first position of each of
        them: row [s] i64 and place [s] i64.
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


class Sums(NamedTuple):
    """Sums by key."""

    keys: Tensor  # [n] i32 or i64, ascending
    values: Tensor  # [n] f64


@jit
def _add_runs(values, firsts, lasts, sums, runs, RUNS: tl.constexpr):
    run = tl.program_id(0) * RUNS + tl.arange(0, RUNS)
    at = tl.load(firsts + run, mask=run < runs, other=0)
    last = tl.load(lasts + run, mask=run < runs, other=0)
    total = tl.zeros([RUNS], tl.float64)
    longest = lang.max(last - at, 0)
    for step in range(longest):
        total += tl.load(values + at + step, mask=at + step < last, other=0.0)
    tl.store(sums + run, total, mask=run < runs)


def sums_by_key(keys: Tensor, values: Tensor) -> Sums:
    """Return the sums of values [n] f32 or f64 by key [n] i32 or i64."""
    by_key = torch.sort(keys, stable=True)
    distinct, counts = torch.unique_consecutive(by_key.values, return_counts=True)
    values = values[by_key.indices].double()
    while True:
        runs = (counts + RUN - 1) // RUN
        key, number = expand_counts(runs)
        ends = torch.cumsum(counts, 0)
        firsts = (ends - counts)[key] + number * RUN
        lasts = torch.minimum(firsts + RUN, ends[key])
        sums = torch.empty(key.shape[0], dtype=torch.float64, device=values.device)
        launch(
            _add_runs, -(-key.shape[0] // _RUNS_A_PROGRAM), values, firsts, lasts, sums, key.shape[0],
            RUNS=_RUNS_A_PROGRAM,
        )  # fmt: skip
        if key.shape[0] == counts.shape[0]:
            return Sums(distinct, sums)
        values, counts = sums, runs


@jit
def _weigh(
    places, inks, starts, items, scratch, tiles, taps, shares, slot_starts, table, table_starts, total_weight,
    columns, width, height, cap, stop, floor,
    KIND: tl.constexpr, TAPS: tl.constexpr, SQUARED: tl.constexpr, WITH_UNSCALED: tl.constexpr,
):  # fmt: skip
    program = tl.program_id(0)
    tile = tl.load(tiles + program)
    own_scratch = scratch + program * (2 if WITH_UNSCALED else 1) * _SCRATCH
    all_scratch = own_scratch + _SCRATCH
    column = tl.arange(0, _COLUMNS)
    at = tl.load(starts + tile)
    last = tl.load(starts + tile + 1)
    slot_count = (tl.load(slot_starts + tile + 1) - tl.load(slot_starts + tile)).to(tl.int32)
    sums = tl.load(table_starts + program)
    transmittance = start_rays(tile, columns, width, height)
    unscaled_transmittance = transmittance
    brightest = lang.max(transmittance, 0)
    while (at < last) & (brightest > 0.0):
        count = (last - at).to(tl.int32)
        fill_alphas(places, inks, items, at, last, tile, columns, own_scratch, cap, floor, KIND, WITH_UNSCALED)
        transmittance = blend_chunk(own_scratch, transmittance, stop, count)
        brightest = lang.max(transmittance, 0)
        number = at + tl.arange(0, _CHUNK)
        if WITH_UNSCALED:
            unscaled_transmittance = blend_chunk(all_scratch, unscaled_transmittance, stop, count)
            brightest = tl.maximum(brightest, lang.max(unscaled_transmittance, 0))
        totals = tl.zeros([_CHUNK], tl.float32)
        for from_pixel in range(0, _PIXELS, _BLOCK):
            pixel = from_pixel + tl.arange(0, _BLOCK)
            totals += tl.sum(weights_of(all_scratch if WITH_UNSCALED else own_scratch, count, pixel), 1)
        tl.store(total_weight + number, totals, mask=number < last)
        for block in range(0, slot_count, _COLUMNS):
            product = tl.zeros([_CHUNK, _COLUMNS], tl.float32)
            for from_pixel in range(0, _PIXELS, _BLOCK):
                pixel = from_pixel + tl.arange(0, _BLOCK)
                weights = weights_of(own_scratch, count, pixel)
                if SQUARED:
                    weights = weights * weights
                factors = tl.zeros([_BLOCK, _COLUMNS], tl.float32)
                for tap in lang.static_range(TAPS):
                    from_here = (tile * TAPS + tap) * _PIXELS + pixel
                    slot = tl.load(taps + from_here)
                    share = tl.full([_BLOCK], 1.0, tl.float32)
                    if TAPS > 1:
                        share = tl.load(shares + from_here)
                    factors += tl.where(slot[:, None] == (block + column)[None, :], share[:, None], 0.0)
                product += tl.dot(weights, factors, input_precision="ieee")
            to = sums + tl.arange(0, _CHUNK)[:, None] * slot_count + block + column[None, :]
            tl.store(table + to, product, mask=(number < last)[:, None] & (block + column < slot_count)[None, :])
        sums += _CHUNK * slot_count
        at += _CHUNK


def region_weights(
    frame: Frame, reading: DeviceReading, squared: bool, with_unscaled: bool, *, labelled_tiles: bool = False
) -> RegionWeights:
    """Return ``A'^T S`` of a view and the total weight of unscaled weights, on the device.

    Args:
        with_unscaled: True if the scale of opacity logits is not one, so that unscaled weights differ.
        labelled_tiles: True omits tiles without labels, whose rays count for the total weight alone.
    """
    rows, lengths = reading.codebook_rows, frame.starts.diff()
    slots = reading.slots(lengths.shape[0], frame.size[0])
    slot_counts = slots.starts.diff()
    sizes = lengths * slot_counts
    tiles = (sizes if labelled_tiles else lengths).nonzero()[:, 0]
    item_totals = torch.zeros(frame.items.shape[0], device=lengths.device, dtype=torch.float32)
    parts = list[Sums]()
    for first, last in _runs(sizes[tiles].tolist()):
        tile = tiles[first:last].clone()  # kernels are compiled for aligned tensors
        starts = torch.zeros(last - first + 1, dtype=torch.int64, device=lengths.device)
        torch.cumsum(sizes[tile], 0, out=starts[1:])
        table = torch.zeros(int(starts[-1]), device=lengths.device, dtype=torch.float32)
        scratch = table.new_empty((last - first) * (2 * PARTS if with_unscaled else PARTS) * PART)
        launch(
            _weigh, last - first, *frame.splats, frame.starts, frame.items, scratch, tile, slots.taps, slots.shares,
            slots.starts, table, starts, item_totals, *frame.size, *frame.cuts, KIND=frame.kind, TAPS=reading.taps,
            SQUARED=squared, WITH_UNSCALED=with_unscaled,
        )  # fmt: skip
        place = table.nonzero()[:, 0]
        program = torch.searchsorted(starts[1:], place, right=True)
        within, at = place - starts[program], tile[program]
        item = frame.items[frame.starts[at] + within // slot_counts[at]]
        columns = slots.rows[slots.starts[at] + within % slot_counts[at]]  # [n, levels]
        entry, level = (columns >= 0).nonzero().unbind(1)
        keys = frame.ids[item].long()[entry] * rows + columns[entry, level]
        parts.append(sums_by_key(keys, table[place][entry]))
    keys, values = (torch.cat(column) for column in zip(*parts, strict=True))
    if len(parts) > 1:
        keys, values = sums_by_key(keys, values)
    hit_items = item_totals.nonzero()[:, 0]
    totals = sums_by_key(frame.ids[frame.items[hit_items]], item_totals[hit_items])
    splat_ids, counts = torch.unique_consecutive(keys // rows, return_counts=True)
    indptr = torch.zeros(splat_ids.shape[0] + 1, dtype=torch.int64, device=keys.device)
    torch.cumsum(counts, 0, out=indptr[1:])
    return one_view(
        splat_ids.to(torch.int32), indptr, (keys % rows).to(torch.int32), values.to(torch.float32),
        totals.keys, totals.values.to(torch.float32), regions=rows,
    )  # fmt: skip


def _runs(sizes: list[int]) -> Iterator[tuple[int, int]]:
    """Yield ranges of tiles whose tables of ``sizes`` floats fit into one launch."""
    first = floats = 0
    for tile, size in enumerate(sizes):
        if tile > first and (tile - first == TILES_AT_ONCE or floats + size > FLOATS_AT_ONCE):
            yield first, tile
            first, floats = tile, 0
        floats += size
    yield first, len(sizes)
