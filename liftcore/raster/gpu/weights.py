"""``W = A'^T S`` and ``A^T Y`` on the device: what the pixels of a tile give to each of its splats.

Both are the product of a chunk's weights [CHUNK, 256] with a matrix of the tile, which says what its pixels read:
the shares of the slots, or the channels of an image. A slot of a region map is a distinct tuple of labels on all
levels, a slot of a grid is a cell, and both become the same thing: one or four taps a pixel. The pixel loop knows
neither labels nor rows of the codebook. Item k of a tile's list has row k of the tile's table of sums for its own, so
every sum has a place before the first weight is known, and none is added to by two programs.

Sums over tiles are float64, in an order that knows nothing of how the work was cut: the terms of a key are added unit
by unit of tiles (``tiles.UNIT``), and then the units' sums. A stable sort brings terms together in the order in which
they came, and runs of up to ``RUN`` of them are added one after the other, until there is one sum.
"""

from typing import NamedTuple

import torch
import triton.language as tl
from torch import Tensor

from liftcore.raster.cpu.composite import FRONT, LARGEST, Choice
from liftcore.raster.cpu.weights import Reading, reading_of
from liftcore.raster.gpu.composite import (
    CHUNK,
    PART,
    PARTS,
    blend_chosen,
    blend_chunk,
    counted,
    fill_alphas,
    rank_tile,
    start_rays,
    weights_of,
)
from liftcore.raster.gpu.launching import WARPS, jit, lang, launch
from liftcore.raster.gpu.tiles import Frame, Lists, expanded
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import TILE, CompositingParams
from liftcore.values.region_weights import RegionWeights, one_view
from liftcore.values.views import ViewFeatures

PIXELS = TILE * TILE
NONE = -1
_LARGEST_KEY = 1 << 62
RUN = 32  # terms that one thread adds
_RUNS_A_PROGRAM = 128  # runs a program
COLUMNS = 16  # of a tile's matrix at a time
BLOCK = 64  # of its rows: a thread has what it multiplies in registers, which are few
WIDEST = 32  # channels of an image a walk

_CHUNK = tl.constexpr(CHUNK)
_TILE = tl.constexpr(TILE)
_PIXELS = tl.constexpr(TILE * TILE)
_SCRATCH = tl.constexpr(PARTS * PART)
_COLUMNS, _BLOCK = tl.constexpr(COLUMNS), tl.constexpr(BLOCK)
_INT32 = 1 << 31
MARKS = 12  # of a ray's largest weights are found at a time, on all tiles of a launch
_WIDE = 32  # ranks a ray that more warps share, or the registers of a thread would not hold its part
_LARGEST, _FRONT = tl.constexpr(LARGEST), tl.constexpr(FRONT)


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
        return Slots(taps, torch.empty(0, device=x.device, dtype=torch.float32), starts, rows)

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


class Sums(NamedTuple):
    """Sums by key, and the keys."""

    keys: Tensor  # [n] i32 or i64, ascending; of a piece once for every unit, those in their order
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
        given = at + step < last
        term = at + step
        if ORDERED:
            term = tl.load(order + term, mask=given, other=0)
        place = term[:, None] * channels + channel[None, :]
        value = tl.load(values + place, mask=given[:, None] & (channel < channels)[None, :], other=0.0)
        total += value.to(tl.float64)
    place = run[:, None].to(tl.int64) * channels + channel[None, :]
    tl.store(sums + place, total, mask=(run < runs)[:, None] & (channel < channels)[None, :])


def sums_by_unit(keys: Tensor, units: Tensor, values: Tensor) -> Sums:
    """The sums of a piece.

    Args:
        keys: [n] i32 or i64. units: [n] i32, ascending, whole ones. values: [n, C] f32.
    """
    by_key = torch.sort(keys, stable=True)
    fresh = torch.ones_like(keys, dtype=torch.bool)
    own = units[by_key.indices]
    fresh[1:] = (by_key.values[1:] != by_key.values[:-1]) | (own[1:] != own[:-1])
    firsts = fresh.nonzero()[:, 0]
    counts = torch.diff(firsts, append=firsts.new_tensor([keys.shape[0]]))
    return Sums(by_key.values[firsts], _sums(values.contiguous(), by_key.indices, counts))


def sums_over_units(parts: list[Sums]) -> Sums:
    """The sums of all pieces, each key once."""
    keys, values = (torch.cat(column) for column in zip(*parts, strict=True))
    if len(parts) > 1:
        by_key = torch.sort(keys, stable=True)
        keys, values = by_key.values, values[by_key.indices]
    known, counts = torch.unique_consecutive(keys, return_counts=True)
    return Sums(known, _sums(values, None, counts))


def _sums(values: Tensor, order: Tensor | None, counts: Tensor) -> Tensor:
    """Sums [u, C] f64 of runs of ``counts`` terms, which ``order`` names one after the other; None as they lie."""
    while True:
        runs = (counts + RUN - 1) // RUN
        key, number = expanded(runs)
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
    places, inks, starts, items, scratch, taps, shares, slot_starts, table, table_starts, total_weight, least, room,
    band_tile, own_tile, slots_tile, columns, width, height, light_in_front, smallest, cap, stop, floor,
    KIND: tl.constexpr, TAPS: tl.constexpr, SELECTION: tl.constexpr, POWER: tl.constexpr, GAIN: tl.constexpr,
):  # fmt: skip
    GATED: tl.constexpr = (SELECTION == _LARGEST) | (SELECTION == _FRONT)
    program = tl.program_id(0)
    own = own_tile + program
    tile = band_tile + own
    mine = scratch + program * (2 if GATED or GAIN else 1) * _SCRATCH
    others = mine + _SCRATCH
    column = tl.arange(0, _COLUMNS)
    at = tl.load(starts + own)
    last = tl.load(starts + own + 1)
    reads = own - slots_tile
    used = (tl.load(slot_starts + reads + 1) - tl.load(slot_starts + reads)).to(tl.int32)
    sums = tl.load(table_starts + program)
    light = start_rays(tile, columns, width, height)
    plain_light = light
    fewest = light
    left = tl.zeros([_PIXELS], tl.int32)
    if SELECTION == _LARGEST:
        mark = reads * _PIXELS + tl.arange(0, _PIXELS)
        fewest = tl.load(least + mark)
        left = tl.load(room + mark)
    lit = lang.max(light, 0)
    while (at < last) & (lit > 0.0):
        count = (last - at).to(tl.int32)
        fill_alphas(places, inks, items, at, last, tile, columns, mine, cap, floor, KIND, GAIN)
        if GATED:
            light, left = blend_chosen(mine, light, stop, count, fewest, left, light_in_front, SELECTION, not GAIN)
        else:
            light = blend_chunk(mine, light, stop, count)
        lit = lang.max(light, 0)
        number = at + tl.arange(0, _CHUNK)
        if GAIN:
            plain_light = blend_chunk(others, plain_light, stop, count)
            lit = tl.maximum(lit, lang.max(plain_light, 0))
        seen = tl.zeros([_CHUNK], tl.float32)
        for from_pixel in range(0, _PIXELS, _BLOCK):
            pixel = from_pixel + tl.arange(0, _BLOCK)
            seen += tl.sum(weights_of(others if GATED or GAIN else mine, count, pixel), 1)
        tl.store(total_weight + number, seen, mask=number < last)
        for block in range(0, used, _COLUMNS):
            product = tl.zeros([_CHUNK, _COLUMNS], tl.float32)
            for from_pixel in range(0, _PIXELS, _BLOCK):
                pixel = from_pixel + tl.arange(0, _BLOCK)
                weights = weights_of(mine, count, pixel)
                weights = counted(weights, pixel, places, items, at, last, tile, columns, smallest, SELECTION, POWER)
                factors = tl.zeros([_BLOCK, _COLUMNS], tl.float32)
                for tap in lang.static_range(TAPS):
                    from_here = (reads * TAPS + tap) * _PIXELS + pixel
                    slot = tl.load(taps + from_here)
                    share = tl.full([_BLOCK], 1.0, tl.float32)
                    if TAPS > 1:
                        share = tl.load(shares + from_here)
                    factors += tl.where(slot[:, None] == (block + column)[None, :], share[:, None], 0.0)
                product += tl.dot(weights, factors, input_precision="ieee")
            to = sums + tl.arange(0, _CHUNK)[:, None] * used + block + column[None, :]
            tl.store(table + to, product, mask=(number < last)[:, None] & (block + column < used)[None, :])
        sums += _CHUNK * used
        at += _CHUNK


@jit
def _gather(
    places, inks, starts, items, scratch, image, table, band_tile, own_tile, columns, width, height, channels,
    cap, stop, floor, KIND: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    own = own_tile + tl.program_id(0)
    tile = band_tile + own
    top = band_tile // columns * _TILE  # the image is the band's
    mine = scratch + tl.program_id(0) * _SCRATCH
    channel = tl.arange(0, CHANNELS)
    base = tl.load(starts + own_tile)
    at = tl.load(starts + own)
    last = tl.load(starts + own + 1)
    light = start_rays(tile, columns, width, height)
    lit = lang.max(light, 0)
    while (at < last) & (lit > 0.0):
        count = (last - at).to(tl.int32)
        fill_alphas(places, inks, items, at, last, tile, columns, mine, cap, floor, KIND, False)
        light = blend_chunk(mine, light, stop, count)
        product = tl.zeros([_CHUNK, CHANNELS], tl.float32)
        for from_pixel in range(0, _PIXELS, _BLOCK):
            pixel = from_pixel + tl.arange(0, _BLOCK)
            x = tile % columns * _TILE + pixel % _TILE
            y = tile // columns * _TILE + pixel // _TILE
            place = ((y - top).to(tl.int64) * width + x)[:, None] * channels + channel[None, :]
            inside = ((x < width) & (y < height))[:, None] & (channel < channels)[None, :]
            own_pixels = tl.load(image + place, mask=inside, other=0.0)
            product += tl.dot(weights_of(mine, count, pixel), own_pixels, input_precision="ieee")
        number = at + tl.arange(0, _CHUNK)
        to = (number - base)[:, None] * channels + channel[None, :]
        tl.store(table + to, product, mask=(number < last)[:, None] & (channel < channels)[None, :])
        lit = lang.max(light, 0)
        at += _CHUNK


def region_weights(
    frame: Frame, reading: DeviceReading, choice: Choice, with_plain: bool, splats: int
) -> RegionWeights:
    """``A'^T S`` of a view and the total weight of plain weights, on the device.

    Args:
        with_plain: whether plain weights are others, as the opacities have a scale on their logits.
    """
    rows = reading.codebook_rows
    weights: list[Sums] = []
    total_weight: list[Sums] = []
    for band in frame.bands:
        _weigh_band(frame, frame.lists_of(band), reading, choice, with_plain, splats, weights, total_weight)
    found, met = sums_over_units(weights), sums_over_units(total_weight)
    own, counts = torch.unique_consecutive(found.keys // rows, return_counts=True)
    indptr = torch.zeros(own.shape[0] + 1, dtype=torch.int64, device=frame.device)
    torch.cumsum(counts, 0, out=indptr[1:])
    return one_view(
        own.to(torch.int32), indptr, (found.keys % rows).to(torch.int32), found.values[:, 0].to(torch.float32),
        met.keys.to(torch.int32), met.values[:, 0].to(torch.float32), regions=rows,
    )  # fmt: skip


def _weigh_band(
    frame: Frame, lists: Lists, reading: DeviceReading, choice: Choice, with_plain: bool, splats: int,
    weights: list[Sums], total_weight: list[Sums],
) -> None:  # fmt: skip
    """Add a band's sums to those of the weights and of the total weight."""
    rows = reading.codebook_rows
    given = torch.zeros(lists.items.shape[0], 1, device=frame.device, dtype=torch.float32)
    for first, last in frame.tile_runs(lists):
        slots = reading.slots(lists.first_tile + first, lists.first_tile + last, frame.columns)
        marks = marks_of(frame, lists, (first, last), choice.k) if choice.kind == LARGEST else None
        sizes = lists.starts[first : last + 1].diff() * slots.starts.diff()
        for begin, end, floats in frame.table_runs((first, last), sizes):
            job = _Run(lists, (begin, end), first, slots, sizes[begin - first : end - first], floats, marks)
            table, starts = _weigh_run(frame, job, reading.taps, choice, with_plain, given)
            places = table.nonzero()[:, 0]
            for part in _whole_units(frame, job, starts, places, frame.sums_at_once):
                weights.append(_sums_of(frame, job, table, starts, part, splats * rows, rows))
    total_weight.append(_of_items(frame, lists, (0, lists.tiles), given))


class _Run(NamedTuple):
    """Tiles whose table is made in one launch."""

    lists: Lists
    tiles: tuple[int, int]  # first and last + 1, in the band
    slots_tile: int  # the first tile of the slots and of the marks, in the band
    slots: Slots
    sizes: Tensor  # [tiles] i64, floats of each tile's table
    floats: int  # of all of them
    marks: tuple[Tensor, Tensor] | None  # of top-k


def _weigh_run(
    frame: Frame, job: _Run, taps: int, choice: Choice, with_plain: bool, total_weight: Tensor
) -> tuple[Tensor, Tensor]:
    """The table of a run and where each tile's part of it begins [tiles + 1] i64; total weights of its items too."""
    lists, slots, programs = job.lists, job.slots, job.tiles[1] - job.tiles[0]
    starts = torch.zeros(programs + 1, dtype=torch.int64, device=frame.device)
    torch.cumsum(job.sizes, 0, out=starts[1:])
    table = torch.zeros(job.floats, device=frame.device, dtype=torch.float32)
    parts = 2 * PARTS if with_plain or choice.kind in (LARGEST, FRONT) else PARTS
    least, room = job.marks or (slots.shares, slots.taps)  # unread where there are no marks
    launch(
        _weigh, programs, *lists.splats, lists.starts, lists.items, frame.scratch(programs, parts), slots.taps,
        slots.shares, slots.starts, table, starts, total_weight, least, room, lists.first_tile, job.tiles[0],
        job.slots_tile, *frame.size, float(choice.transmittance), float(choice.floor), *frame.cuts, KIND=frame.kind,
        TAPS=taps, SELECTION=choice.kind, POWER=choice.power, GAIN=with_plain,
    )  # fmt: skip
    return table, starts


def _whole_units(frame: Frame, job: _Run, starts: Tensor, places: Tensor, most: int) -> list[Tensor]:
    """Places [n] of a table in runs of whole units, of at most so many places where a unit does not have more."""
    if places.shape[0] <= most:
        return [places]
    ends = torch.tensor([end - job.tiles[0] for end in frame.unit_ends(*job.tiles)], device=starts.device)
    cuts, begun = [0], 0
    by_unit = torch.searchsorted(places, starts[ends]).tolist()
    for before, end in zip([0, *by_unit], by_unit, strict=False):
        if before > begun and end - begun > most:
            cuts.append(before)
            begun = before
    return [places[begin:end] for begin, end in zip(cuts, [*cuts[1:], places.shape[0]], strict=True)]


def _sums_of(
    frame: Frame, job: _Run, table: Tensor, starts: Tensor, place: Tensor, largest_key: int, rows: int
) -> Sums:
    """The sums of the floats at ``place`` [n] i64 of a run's table, ``key = splat * rows + row``."""
    lists, slots = job.lists, job.slots
    tile = torch.searchsorted(starts[1:], place, right=True)
    in_slots = tile + (job.tiles[0] - job.slots_tile)
    used = slots.starts[in_slots + 1] - slots.starts[in_slots]
    within = place - starts[tile]
    item = lists.items[lists.starts[tile + job.tiles[0]] + within // used]
    columns = slots.rows[slots.starts[in_slots] + within % used]  # [n, levels]
    units = frame.unit_of(tile + (lists.first_tile + job.tiles[0]))
    entry, level = (columns >= 0).nonzero().unbind(1)
    keys = lists.ids[item].long()[entry] * rows + columns[entry, level]
    keys = keys.to(torch.int32) if largest_key < _INT32 else keys
    return sums_by_unit(keys, units[entry], table[place][entry][:, None])


def _of_items(frame: Frame, lists: Lists, tiles: tuple[int, int], values: Tensor) -> Sums:
    """Sums by splat of values [n, C] of the items of some tiles, whole units; items without any are left out."""
    first = lists.starts[tiles[0]]
    kept = (values != 0).any(dim=1).nonzero()[:, 0]
    items = kept + first
    tile = torch.searchsorted(lists.starts[1:], items, right=True)
    return sums_by_unit(lists.ids[lists.items[items]], frame.unit_of(tile + lists.first_tile), values[kept])


def adjoint(frame: Frame, image: Tensor, splats: int) -> Tensor:
    """``A^T Y``: image [H, W, C] f32 on the host, C at most ``WIDEST`` -> [P, C] f32 on the host."""
    channels = image.shape[2]
    pieces: list[Sums] = []
    for band in frame.bands:
        _gather_band(frame, frame.lists_of(band), image, pieces)
    found = sums_over_units(pieces)
    result = torch.zeros(splats, channels, dtype=torch.float32)
    result[found.keys.long().cpu()] = found.values.to(torch.float32).cpu()
    return result


def _gather_band(frame: Frame, lists: Lists, image: Tensor, pieces: list[Sums]) -> None:
    own, channels = frame.of_band(image, lists), image.shape[2]
    for first, last in frame.tile_runs(lists):
        sizes = lists.starts[first : last + 1].diff() * channels
        for begin, end, floats in frame.table_runs((first, last), sizes):
            table = torch.zeros(floats // channels, channels, device=frame.device, dtype=torch.float32)
            launch(
                _gather, end - begin, *lists.splats, lists.starts, lists.items, frame.scratch(end - begin), own,
                table, lists.first_tile, begin, *frame.size, channels, *frame.cuts, KIND=frame.kind,
                CHANNELS=max(COLUMNS, 1 << (channels - 1).bit_length()),
            )  # fmt: skip
            pieces.append(_of_items(frame, lists, (begin, end), table))


def marks_of(frame: Frame, lists: Lists, run: tuple[int, int], count: int) -> tuple[Tensor, Tensor]:
    """What top-k knows of every ray of a run of tiles.

    Returns:
        least [tiles, 256] f32, the k-th largest weight, 0 when there are fewer; room [tiles, 256] i32, how many
        weights equal to it are among the k.
    """
    step = max(1, frame.tiles_at_once * MARKS // count)
    parts = [(first, min(first + step, run[1])) for first in range(run[0], run[1], step)]
    marks = [_marks(_largest_weights(frame, lists, part, count)) for part in parts]
    least, room = (torch.cat(column) for column in zip(*marks, strict=True))
    return least, room


def _largest_weights(frame: Frame, lists: Lists, run: tuple[int, int], count: int) -> Tensor:
    """[tiles, 256, count] f32: the largest weights of each ray of a run, in no order; 0 where there are fewer."""
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
