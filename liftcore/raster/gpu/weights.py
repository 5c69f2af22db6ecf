"""``W = A'^T S`` on the device, a sum over the pixels of each tile.

It is the product of a chunk's weights [CHUNK, 256] with a matrix of the tile's pixels, the shares of the slots. A
slot of a region map is a distinct tuple of labels on all levels, a slot of a grid is a cell; either becomes one or
four taps per pixel. The pixel loop does not depend on labels or rows of the codebook. Item k of a tile's list has row
k of the tile's table of sums, so every sum has a fixed address, and no two programs add to the same one.

Sums over tiles are float64, in an order that does not depend on the division into blocks: the terms of a key are
added per unit of tiles (``tiles.UNIT``), and then the units' sums. A stable sort groups terms in their order, and
runs of up to ``RUN`` of them are added one after the other, until one sum is left.
"""

from typing import NamedTuple

import torch
import triton.language as tl
from torch import Tensor

from liftcore.raster.cpu.weights import ViewReading, reading_of
from liftcore.raster.gpu.composite import (
    CHUNK,
    PART,
    PARTS,
    blend_chunk,
    blend_largest,
    fill_alphas,
    rank_tile,
    start_rays,
    weights_of,
)
from liftcore.raster.gpu.launching import WARPS, jit, lang, launch
from liftcore.raster.gpu.tiles import Frame, TileLists, expand_counts
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import TILE, CompositingParams, Weighting
from liftcore.values.region_weights import RegionWeights, one_view
from liftcore.values.views import ViewFeatures

PIXELS = TILE * TILE
NONE = -1
_LARGEST_KEY = 1 << 62
RUN = 32  # terms that one thread adds
_RUNS_A_PROGRAM = 128
COLUMNS = 16  # of a tile's matrix at a time
BLOCK = 64  # of its rows at a time, as the operands must fit in registers

_CHUNK = tl.constexpr(CHUNK)
_TILE = tl.constexpr(TILE)
_PIXELS = tl.constexpr(TILE * TILE)
_SCRATCH = tl.constexpr(PARTS * PART)
_COLUMNS, _BLOCK = tl.constexpr(COLUMNS), tl.constexpr(BLOCK)
_INT32 = 1 << 31
MARKS = 12  # largest weights of a ray for which a launch may have all its tiles; with more, fewer tiles
_WIDE = 32  # largest weights of a ray from which on more warps share a tile, as registers are few


class TileInputs(NamedTuple):
    """Taps and slots of a run of tiles."""

    taps: Tensor  # [tiles, T, 256] i32, the slot of each pixel's taps, numbered within the tile; -1 none
    shares: Tensor  # [tiles, T, 256] f32, of the taps; [0] for region maps, whose shares are one
    starts: Tensor  # [tiles + 1] i64, the slots of each tile in rows
    rows: Tensor  # [slots, levels] i32, the codebook rows of a slot, -1 none


class DeviceReading:
    """S of one view, by pixel. It is built on the host, in any thread, and copied to the device at the first use."""

    def __init__(
        self, observation: ViewFeatures, camera: Camera, params: CompositingParams, device: torch.device
    ) -> None:
        reading = reading_of(observation, camera.width, camera.height, params)
        self.codebook_rows, self.levels = reading.codebook_rows, reading.levels
        self.taps = 4 if reading.is_grid else 1
        self._grid_width = reading.grid_width
        self._device, parts = device, _parts(reading)
        self._waiting = [part.pin_memory() for part in parts] if device.type == "cuda" else list(parts)

    def slots(self, first: int, last: int, columns: int) -> TileInputs:
        """Return the slots of tiles ``first..last`` of a view with ``columns`` tiles per row."""
        if self._waiting:
            parts = [part.to(self._device, non_blocking=True) for part in self._waiting]
            self._x, self._y, self._share_x, self._share_y, self._labels = parts
            self._waiting.clear()
        tile = torch.arange(first, last, device=self._x.device)[:, None]
        pixel = torch.arange(PIXELS, device=self._x.device)[None, :]
        x, y = tile % columns * TILE + pixel % TILE, tile // columns * TILE + pixel // TILE
        inside = (x < self._x.shape[0]) & (y < self._y.shape[0])
        x, y = x.clamp(max=self._x.shape[0] - 1), y.clamp(max=self._y.shape[0] - 1)
        return self._cells(x, y, inside) if self.taps == 4 else self._tuples(x, y, inside)

    def _tuples(self, x: Tensor, y: Tensor, inside: Tensor) -> TileInputs:
        labels = self._labels[:, self._y[y], self._x[x]]  # [L, tiles, 256]
        keys, classes = torch.zeros_like(x), 1
        for level in labels:
            if classes * (self.codebook_rows + 1) > _LARGEST_KEY:
                distinct, keys = torch.unique(keys, return_inverse=True)
                classes = distinct.shape[0]
            keys = keys * (self.codebook_rows + 1) + level + 1
            classes *= self.codebook_rows + 1
        keys = torch.where(inside & (labels >= 0).any(dim=0), keys, NONE)
        taps, starts, tile, place = _number_keys(keys)
        rows = labels[:, tile, place].T.contiguous()
        return TileInputs(taps, torch.empty(0, device=x.device, dtype=torch.float32), starts, rows)

    def _cells(self, x: Tensor, y: Tensor, inside: Tensor) -> TileInputs:
        keys, shares = [], []
        for right, below in ((0, 0), (1, 0), (0, 1), (1, 1)):
            share_x = self._share_x[x] if right else 1 - self._share_x[x]
            share_y = self._share_y[y] if below else 1 - self._share_y[y]
            share = share_x * share_y
            cell = (self._y[y] + below) * self._grid_width + self._x[x] + right
            keys.append(torch.where(inside & (share > 0), cell, NONE))
            shares.append(share)
        tile_keys = torch.cat(keys, dim=1)
        taps, starts, tile, place = _number_keys(tile_keys)
        return TileInputs(
            taps, torch.cat(shares, dim=1).contiguous(), starts, tile_keys[tile, place].to(torch.int32)[:, None]
        )


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

    keys: Tensor  # [n] i32 or i64, ascending; in sums of a piece once per unit, units in order
    values: Tensor  # [n, C] f64


@jit
def _add_runs(
    values, order, firsts, lasts, sums, runs, channels, ORDERED: tl.constexpr, RUNS: tl.constexpr,
    CHANNELS: tl.constexpr,
):  # fmt: skip
    run = tl.program_id(0) * RUNS + tl.arange(0, RUNS)
    channel = tl.arange(0, CHANNELS)
    at = tl.load(firsts + run, mask=run < runs, other=0)
    last = tl.load(lasts + run, mask=run < runs, other=0)
    total = tl.zeros([RUNS, CHANNELS], tl.float64)
    longest = lang.max(last - at, 0)
    for step in range(longest):
        mask = at + step < last
        term = at + step
        if ORDERED:
            term = tl.load(order + term, mask=mask, other=0)
        place = term[:, None] * channels + channel[None, :]
        value = tl.load(values + place, mask=mask[:, None] & (channel < channels)[None, :], other=0.0)
        total += value.to(tl.float64)
    place = run[:, None].to(tl.int64) * channels + channel[None, :]
    tl.store(sums + place, total, mask=(run < runs)[:, None] & (channel < channels)[None, :])


def sums_by_unit(keys: Tensor, units: Tensor, values: Tensor) -> Sums:
    """Return the sums of a piece by key and unit.

    Args:
        keys: [n] i32 or i64. units: [n] i32, ascending, each complete. values: [n, C] f32.
    """
    by_key = torch.sort(keys, stable=True)
    fresh = torch.ones_like(keys, dtype=torch.bool)
    key_units = units[by_key.indices]
    fresh[1:] = (by_key.values[1:] != by_key.values[:-1]) | (key_units[1:] != key_units[:-1])
    firsts = fresh.nonzero()[:, 0]
    counts = torch.diff(firsts, append=firsts.new_tensor([keys.shape[0]]))
    return Sums(by_key.values[firsts], _sums(values.contiguous(), by_key.indices, counts))


def sums_over_units(parts: list[Sums]) -> Sums:
    """Return the sums of all pieces, each key once."""
    keys, values = (torch.cat(column) for column in zip(*parts, strict=True))
    if len(parts) > 1:
        by_key = torch.sort(keys, stable=True)
        keys, values = by_key.values, values[by_key.indices]
    distinct, counts = torch.unique_consecutive(keys, return_counts=True)
    return Sums(distinct, _sums(values, None, counts))


def _sums(values: Tensor, order: Tensor | None, counts: Tensor) -> Tensor:
    """Return sums [u, C] f64 of runs of ``counts`` terms in the given order; None: in the order of ``values``."""
    while True:
        runs = (counts + RUN - 1) // RUN
        key, number = expand_counts(runs)
        ends = torch.cumsum(counts, 0)
        firsts = (ends - counts)[key] + number * RUN
        lasts = torch.minimum(firsts + RUN, ends[key])
        sums = torch.empty(key.shape[0], values.shape[1], dtype=torch.float64, device=values.device)
        launch(
            _add_runs, -(-key.shape[0] // _RUNS_A_PROGRAM), values, firsts if order is None else order, firsts, lasts,
            sums, key.shape[0], values.shape[1], ORDERED=order is not None, RUNS=_RUNS_A_PROGRAM,
            CHANNELS=1 << (values.shape[1] - 1).bit_length(),
        )  # fmt: skip
        if key.shape[0] == counts.shape[0]:
            return sums
        values, counts, order = sums, runs, None


@jit
def _weigh(
    places, inks, starts, items, scratch, taps, shares, slot_starts, table, table_starts, total_weight, least, ties,
    band_tile, own_tile, slots_tile, columns, width, height, cap, stop, floor,
    KIND: tl.constexpr, TAPS: tl.constexpr, TOP_K: tl.constexpr, SQUARED: tl.constexpr, WITH_UNSCALED: tl.constexpr,
):  # fmt: skip
    program = tl.program_id(0)
    list_tile = own_tile + program
    tile = band_tile + list_tile
    own_scratch = scratch + program * (2 if TOP_K or WITH_UNSCALED else 1) * _SCRATCH
    all_scratch = own_scratch + _SCRATCH
    column = tl.arange(0, _COLUMNS)
    at = tl.load(starts + list_tile)
    last = tl.load(starts + list_tile + 1)
    reads = list_tile - slots_tile
    slot_count = (tl.load(slot_starts + reads + 1) - tl.load(slot_starts + reads)).to(tl.int32)
    sums = tl.load(table_starts + program)
    transmittance = start_rays(tile, columns, width, height)
    unscaled_transmittance = transmittance
    threshold = transmittance
    ties_left = tl.zeros([_PIXELS], tl.int32)
    if TOP_K:
        mark = reads * _PIXELS + tl.arange(0, _PIXELS)
        threshold = tl.load(least + mark)
        ties_left = tl.load(ties + mark)
    brightest = lang.max(transmittance, 0)
    while (at < last) & (brightest > 0.0):
        count = (last - at).to(tl.int32)
        fill_alphas(places, inks, items, at, last, tile, columns, own_scratch, cap, floor, KIND, WITH_UNSCALED)
        if TOP_K:
            transmittance, ties_left = blend_largest(
                own_scratch, transmittance, stop, count, threshold, ties_left, not WITH_UNSCALED
            )
        else:
            transmittance = blend_chunk(own_scratch, transmittance, stop, count)
        brightest = lang.max(transmittance, 0)
        number = at + tl.arange(0, _CHUNK)
        if WITH_UNSCALED:
            unscaled_transmittance = blend_chunk(all_scratch, unscaled_transmittance, stop, count)
            brightest = tl.maximum(brightest, lang.max(unscaled_transmittance, 0))
        totals = tl.zeros([_CHUNK], tl.float32)
        for from_pixel in range(0, _PIXELS, _BLOCK):
            pixel = from_pixel + tl.arange(0, _BLOCK)
            totals += tl.sum(weights_of(all_scratch if TOP_K or WITH_UNSCALED else own_scratch, count, pixel), 1)
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
                    from_here = (reads * TAPS + tap) * _PIXELS + pixel
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
    frame: Frame, reading: DeviceReading, weighting: Weighting, with_unscaled: bool, splats: int
) -> RegionWeights:
    """Return ``A'^T S`` of a view and the total weight of unscaled weights, on the device.

    Args:
        with_unscaled: True if the scale of opacity logits is not one, so that unscaled weights differ.
    """
    rows = reading.codebook_rows
    weights: list[Sums] = []
    total_weight: list[Sums] = []
    for band in frame.bands:
        _weigh_band(frame, frame.lists_of(band), reading, weighting, with_unscaled, splats, weights, total_weight)
    sums, totals = sums_over_units(weights), sums_over_units(total_weight)
    splat_ids, counts = torch.unique_consecutive(sums.keys // rows, return_counts=True)
    indptr = torch.zeros(splat_ids.shape[0] + 1, dtype=torch.int64, device=frame.device)
    torch.cumsum(counts, 0, out=indptr[1:])
    return one_view(
        splat_ids.to(torch.int32), indptr, (sums.keys % rows).to(torch.int32), sums.values[:, 0].to(torch.float32),
        totals.keys.to(torch.int32), totals.values[:, 0].to(torch.float32), regions=rows,
    )  # fmt: skip


def _weigh_band(
    frame: Frame, lists: TileLists, reading: DeviceReading, weighting: Weighting, with_unscaled: bool, splats: int,
    weights: list[Sums], total_weight: list[Sums],
) -> None:  # fmt: skip
    """Append a band's sums to those of the weights and of the total weight."""
    rows = reading.codebook_rows
    item_totals = torch.zeros(lists.items.shape[0], 1, device=frame.device, dtype=torch.float32)
    for first, last in frame.tile_runs(lists):
        slots = reading.slots(lists.first_tile + first, lists.first_tile + last, frame.columns)
        marks = marks_of(frame, lists, (first, last), weighting.top_k) if weighting.top_k else None
        sizes = lists.starts[first : last + 1].diff() * slots.starts.diff()
        for begin, end, floats in frame.table_runs((first, last), sizes):
            job = _Run(lists, (begin, end), first, slots, sizes[begin - first : end - first], floats, marks)
            table, starts = _weigh_run(frame, job, reading.taps, weighting, with_unscaled, item_totals)
            places = table.nonzero()[:, 0]
            for part in _whole_units(frame, job, starts, places, frame.sums_at_once):
                weights.append(_sums_of(frame, job, table, starts, part, splats * rows, rows))
    total_weight.append(_of_items(frame, lists, (0, lists.tiles), item_totals))


class _Run(NamedTuple):
    """A run of tiles whose table is computed in one launch."""

    lists: TileLists
    tiles: tuple[int, int]  # first and last + 1, in the band
    slots_tile: int  # the first tile of ``slots`` and ``marks``, in the band
    slots: TileInputs
    sizes: Tensor  # [tiles] i64, floats of each tile's table
    floats: int  # of all tables
    marks: tuple[Tensor, Tensor] | None  # of top-k


def _weigh_run(
    frame: Frame, job: _Run, taps: int, weighting: Weighting, with_unscaled: bool, total_weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the table of a run, the start [tiles + 1] i64 of each part; write its total weight."""
    lists, slots, programs = job.lists, job.slots, job.tiles[1] - job.tiles[0]
    starts = torch.zeros(programs + 1, dtype=torch.int64, device=frame.device)
    torch.cumsum(job.sizes, 0, out=starts[1:])
    table = torch.zeros(job.floats, device=frame.device, dtype=torch.float32)
    parts = 2 * PARTS if with_unscaled or weighting.top_k else PARTS
    least, ties = job.marks or (slots.shares, slots.taps)  # any tensors where there are no marks
    launch(
        _weigh, programs, *lists.splats, lists.starts, lists.items, frame.scratch(programs, parts), slots.taps,
        slots.shares, slots.starts, table, starts, total_weight, least, ties, lists.first_tile, job.tiles[0],
        job.slots_tile, *frame.size, *frame.cuts, KIND=frame.kind, TAPS=taps, TOP_K=weighting.top_k > 0,
        SQUARED=weighting.power == 2, WITH_UNSCALED=with_unscaled,
    )  # fmt: skip
    return table, starts


def _whole_units(frame: Frame, job: _Run, starts: Tensor, places: Tensor, limit: int) -> list[Tensor]:
    """Split places [n] of a table into runs of whole units, of at most ``limit`` places unless one unit has more."""
    if places.shape[0] <= limit:
        return [places]
    ends = torch.tensor([end - job.tiles[0] for end in frame.unit_ends(*job.tiles)], device=starts.device)
    cuts, run_start = [0], 0
    by_unit = torch.searchsorted(places, starts[ends]).tolist()
    for before, end in zip([0, *by_unit], by_unit, strict=False):
        if before > run_start and end - run_start > limit:
            cuts.append(before)
            run_start = before
    return [places[begin:end] for begin, end in zip(cuts, [*cuts[1:], places.shape[0]], strict=True)]


def _sums_of(
    frame: Frame, job: _Run, table: Tensor, starts: Tensor, place: Tensor, largest_key: int, rows: int
) -> Sums:
    """Return the sums of the floats at ``place`` [n] i64 of a run's table, ``key = splat * rows + row``."""
    lists, slots = job.lists, job.slots
    tile = torch.searchsorted(starts[1:], place, right=True)
    in_slots = tile + (job.tiles[0] - job.slots_tile)
    slot_counts = slots.starts[in_slots + 1] - slots.starts[in_slots]
    within = place - starts[tile]
    item = lists.items[lists.starts[tile + job.tiles[0]] + within // slot_counts]
    columns = slots.rows[slots.starts[in_slots] + within % slot_counts]  # [n, levels]
    units = frame.unit_of(tile + (lists.first_tile + job.tiles[0]))
    entry, level = (columns >= 0).nonzero().unbind(1)
    keys = lists.ids[item].long()[entry] * rows + columns[entry, level]
    keys = keys.to(torch.int32) if largest_key < _INT32 else keys
    return sums_by_unit(keys, units[entry], table[place][entry][:, None])


def _of_items(frame: Frame, lists: TileLists, tiles: tuple[int, int], values: Tensor) -> Sums:
    """Return sums by splat of values [n, C] of the items of some tiles, whole units; rows of zeros are left out."""
    first = lists.starts[tiles[0]]
    nonzero = (values != 0).any(dim=1).nonzero()[:, 0]
    items = nonzero + first
    tile = torch.searchsorted(lists.starts[1:], items, right=True)
    return sums_by_unit(lists.ids[lists.items[items]], frame.unit_of(tile + lists.first_tile), values[nonzero])


def marks_of(frame: Frame, lists: TileLists, run: tuple[int, int], count: int) -> tuple[Tensor, Tensor]:
    """Compute the thresholds of top-k for every ray of a run of tiles.

    Returns:
        least [tiles, 256] f32, the k-th largest weight, 0 if there are fewer; ties [tiles, 256] i32, the number of
        weights equal to it that are among the k.
    """
    step = max(1, frame.tiles_at_once * MARKS // count)
    parts = [(first, min(first + step, run[1])) for first in range(run[0], run[1], step)]
    marks = [_marks(_largest_weights(frame, lists, part, count)) for part in parts]
    least, ties = (torch.cat(column) for column in zip(*marks, strict=True))
    return least, ties


def _largest_weights(frame: Frame, lists: TileLists, run: tuple[int, int], count: int) -> Tensor:
    """Return the largest weights of each ray of a run, [tiles, 256, count] f32, unordered; 0 if there are fewer."""
    tiles = run[1] - run[0]
    weights = torch.zeros(tiles, TILE * TILE, count, device=frame.device, dtype=torch.float32)
    wide = 1 << (count - 1).bit_length()
    launch(
        rank_tile, tiles, *lists.splats, lists.starts, lists.items, frame.scratch(tiles), weights,
        lists.first_tile, run[0], *frame.size, count, *frame.cuts, KIND=frame.kind,
        COUNT=wide, warps=8 if wide >= _WIDE else WARPS,
    )  # fmt: skip
    return weights


def _marks(weights: Tensor) -> tuple[Tensor, Tensor]:
    least = weights.amin(dim=2)
    return least, (weights == least[:, :, None]).sum(dim=2).to(torch.int32)
