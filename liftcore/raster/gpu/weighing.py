"""``W = A'^T S`` and ``A^T Y`` on the device: what the pixels of a tile give to each of its splats.

Both are the product of a chunk's weights [CHUNK, 256] with a matrix of the tile, which says what its pixels read:
the shares of the slots, or the channels of an image. The pixel loop knows neither labels nor rows of the codebook.
Item k of a tile's list has row k of the tile's table of sums for its own, so every sum has a place before the first
weight is known, and none is added to by two programs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
import triton.language as tl

from liftcore.raster.base import TILE, RegionWeights
from liftcore.raster.cpu.composite import FRONT, LARGEST
from liftcore.raster.gpu.launching import jit, lang, launch
from liftcore.raster.gpu.selecting import blend_chosen, counted, marks_of
from liftcore.raster.gpu.sums import Pieces, Sums, sums_by_unit
from liftcore.raster.gpu.walk import CHUNK, PART, PARTS, blend_chunk, fill_alphas, start_rays, weights_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

    from liftcore.raster.cpu.composite import Choice
    from liftcore.raster.gpu.frame import Frame
    from liftcore.raster.gpu.slots import DeviceReading, Slots
    from liftcore.raster.gpu.tile_lists import Lists

COLUMNS = 16  # of a tile's matrix at a time
BLOCK = 64  # of its rows: a thread has what it multiplies in registers, which are few
WIDEST = 32  # channels of an image a walk
AN_ENTRY, A_LEVEL = 48, 72  # bytes of a sum that becomes rows: where it is from; its keys and values, sorted, a level

_CHUNK = tl.constexpr(CHUNK)
_TILE = tl.constexpr(TILE)
_PIXELS = tl.constexpr(TILE * TILE)
_SCRATCH = tl.constexpr(PARTS * PART)
_COLUMNS, _BLOCK = tl.constexpr(COLUMNS), tl.constexpr(BLOCK)
_INT32 = 1 << 31
_LARGEST, _FRONT = tl.constexpr(LARGEST), tl.constexpr(FRONT)


@jit
def _weigh(
    places, inks, starts, items, scratch, taps, shares, slot_starts, table, table_starts, evidence, least, room,
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
        tl.store(evidence + number, seen, mask=number < last)
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
    """``A'^T S`` of a view and the evidence of plain weights; with_plain: whether there is a gain.

    On the device where the room holds it all, else on the host.
    """
    rows = reading.codebook_rows
    weights, evidence = (Pieces(frame.device, frame.room.kept) for _ in range(2))
    for band in frame.bands:
        _weigh_band(frame, frame.lists_of(band), (reading, choice, with_plain, splats), (weights, evidence))
    found = [_rows_of(part, rows, frame.room.kept is not None) for part in weights.joined(splats, rows)]
    met = [(part.keys.to(torch.int32), part.values[:, 0].to(torch.float32)) for part in evidence.joined(splats)]
    return _put_together(found, met, frame)


def _weigh_band(
    frame: Frame, lists: Lists, how: tuple[DeviceReading, Choice, bool, int], sums: tuple[Pieces, Pieces]
) -> None:
    """Add a band's sums to those of the weights and of the evidence."""
    (reading, choice, with_plain, splats), rows = how, how[0].codebook_rows
    given = torch.zeros(lists.items.shape[0], 1, device=frame.device)
    for first, last in frame.tile_runs(lists):
        slots = reading.slots(lists.first_tile + first, lists.first_tile + last, frame.columns)
        marks = marks_of(frame, lists, (first, last), choice.k) if choice.kind == LARGEST else None
        sizes = lists.starts[first : last + 1].diff() * slots.starts.diff()
        for begin, end, floats in frame.table_runs((first, last), sizes):
            job = _Run(lists, (begin, end), first, slots, sizes[begin - first : end - first], floats, marks)
            table = _weigh_run(frame, job, reading.taps, choice, with_plain, given)
            for part in _by_row(frame, job, table, splats * rows, rows):
                sums[0].add(part)
    sums[1].add(_of_items(frame, lists, (0, lists.tiles), given))


class _Rows(NamedTuple):
    """Rows of W of ascending splats."""

    splats: Tensor  # [n] i32
    counts: Tensor  # [n] i64, entries of each
    columns: Tensor  # [nnz] i32
    weights: Tensor  # [nnz] f32


def _rows_of(part: Sums, rows: int, home: bool) -> _Rows:
    """Sums by ``key = splat * rows + row`` as rows; home: whether they go to the host."""
    own, counts = torch.unique_consecutive(part.keys // rows, return_counts=True)
    columns, values = (part.keys % rows).to(torch.int32), part.values[:, 0].to(torch.float32)
    made = _Rows(own.to(torch.int32), counts, columns, values)
    return _Rows(*(column.cpu() for column in made)) if home else made


def _put_together(found: list[_Rows], met: list[tuple[Tensor, Tensor]], frame: Frame) -> RegionWeights:
    place = frame.device if frame.room.kept is None else torch.device("cpu")
    ints, floats = torch.empty(0, dtype=torch.int32, device=place), torch.empty(0, device=place)
    found = found or [_Rows(ints, ints.long(), ints, floats)]
    splats, counts, columns, weights = (torch.cat(column) for column in zip(*found, strict=True))
    indptr = torch.zeros(splats.shape[0] + 1, dtype=torch.int64, device=place)
    torch.cumsum(counts, 0, out=indptr[1:])
    ids, evidence = (
        torch.cat([part.to(place) for part in column]) for column in zip(*met or [(ints, floats)], strict=True)
    )
    return RegionWeights(splats, indptr, columns, weights, ids, evidence)


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
    frame: Frame, job: _Run, taps: int, choice: Choice, with_plain: bool, evidence: Tensor
) -> tuple[Tensor, Tensor]:
    """The table of a run and where each tile's part of it begins [tiles + 1] i64; the evidence of its items too."""
    lists, slots, programs = job.lists, job.slots, job.tiles[1] - job.tiles[0]
    starts = torch.zeros(programs + 1, dtype=torch.int64, device=frame.device)
    torch.cumsum(job.sizes, 0, out=starts[1:])
    table = torch.zeros(job.floats, device=frame.device)
    parts = 2 * PARTS if with_plain or choice.kind in (LARGEST, FRONT) else PARTS
    least, room = job.marks or (slots.shares, slots.taps)  # unread where there are no marks
    launch(
        _weigh, programs, *lists.splats, lists.starts, lists.items, frame.scratch(programs, parts), slots.taps,
        slots.shares, slots.starts, table, starts, evidence, least, room, lists.first_tile, job.tiles[0],
        job.slots_tile, *frame.size, float(choice.transmittance), float(choice.floor), *frame.cuts, KIND=frame.kind,
        TAPS=taps, SELECTION=choice.kind, POWER=choice.power, GAIN=with_plain,
    )  # fmt: skip
    return table, starts


def _by_row(frame: Frame, job: _Run, made: tuple[Tensor, Tensor], largest_key: int, rows: int) -> Iterator[Sums]:
    """The sums of a run's table by splat and row of the codebook, ``key = splat * rows + row``, in runs of units."""
    places = made[0].nonzero()[:, 0]
    most = frame.room.entry_bytes // (AN_ENTRY + A_LEVEL * job.slots.rows.shape[1])
    for part in _whole_units(frame, job, made[1], places, most):
        yield _sums_of(frame, job, made, part, (largest_key, rows))


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


def _sums_of(frame: Frame, job: _Run, made: tuple[Tensor, Tensor], place: Tensor, span: tuple[int, int]) -> Sums:
    """The sums of the floats at ``place`` [n] i64 of a run's table."""
    (table, starts), (largest_key, rows) = made, span
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
    pieces = Pieces(frame.device, frame.room.kept)
    for band in frame.bands:
        _gather_band(frame, frame.lists_of(band), image, pieces)
    result = torch.zeros(splats, channels)
    for part in pieces.joined(splats):
        result[part.keys.long().cpu()] = part.values.to(torch.float32).cpu()
    return result


def _gather_band(frame: Frame, lists: Lists, image: Tensor, pieces: Pieces) -> None:
    own, channels = frame.of_band(image, lists), image.shape[2]
    for first, last in frame.tile_runs(lists):
        sizes = lists.starts[first : last + 1].diff() * channels
        for begin, end, floats in frame.table_runs((first, last), sizes):
            table = torch.zeros(floats // channels, channels, device=frame.device)
            launch(
                _gather, end - begin, *lists.splats, lists.starts, lists.items, frame.scratch(end - begin), own,
                table, lists.first_tile, begin, *frame.size, channels, *frame.cuts, KIND=frame.kind,
                CHANNELS=max(COLUMNS, 1 << (channels - 1).bit_length()),
            )  # fmt: skip
            pieces.add(_of_items(frame, lists, (begin, end), table))
