"""S, tile by tile: which slots each half row of pixels reads, and how much.

Both kinds of observation become the same list of taps. A region map's slots are the distinct label tuples of the
tile (a ray's labels on all levels), its factors zeros and ones. The pixel loop adds ``weights * factors`` into lanes
of a slot and knows neither labels nor channels; slots are expanded to codebook rows when entries are merged.

Bilinear weights are products of a row's share and a column's, and all pixels of a half row have the rows' shares. So
a grid's taps are **lines**: a row of cells as one side of the tile reads it, two for a half row however many cells it
meets, with the row's share in all lanes. The columns' shares come once a splat is done: a line's lanes times those of
a column add up to what the splat gave that cell, which is the slot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from liftcore.features.views import Regions, ViewFeatures
from liftcore.jit import inlined, kernel
from liftcore.raster.constants import TILE
from liftcore.raster.cpu.lanes import HALVES, LANES, ROWS
from liftcore.raster.cpu.lanes_halves import all_are

if TYPE_CHECKING:
    from liftcore.raster.base import CompositingParams

SIDES = TILE // LANES  # of a tile: each half row lies on one
MAX_LINES = 2 * TILE  # rows or columns of cells: every pixel reads two of its own at worst
MAX_SLOTS = MAX_LINES * MAX_LINES
MAX_TAPS = HALVES * LANES  # every lane of a half row reads a slot of its own at worst
NO_SLOT = -1
LAST_BIT = 63
SEVERAL = -2  # a half row whose pixels read several slots, or parts of one


class Reading(NamedTuple):
    """S of one view as the compiled code takes it. Exactly one of the two kinds is in use."""

    is_grid: bool
    levels: int  # codebook rows a slot expands to: L of a region map, 1 of a grid
    labels: np.ndarray  # [L, h, w] i32, region map (else empty)
    label_x: np.ndarray  # [W] i32, the label column of a pixel column (else empty)
    label_y: np.ndarray  # [H] i32
    cell_x: np.ndarray  # [W] i32, the left grid column of a pixel column (else empty)
    cell_y: np.ndarray  # [H] i32
    share_x: np.ndarray  # [W] f32, the right column's share
    share_y: np.ndarray  # [H] f32
    grid_width: int
    codebook_rows: int  # M


class TileTaps(NamedTuple):
    """The taps of one tile."""

    starts: np.ndarray  # [33] i32, each half row's taps
    slots: np.ndarray  # [MAX_TAPS] i32
    alone: np.ndarray  # [32] i32, the slot that all pixels of a half row read and nothing else; -1 none, -2 see taps
    several: np.ndarray  # [1] u32, the set of half rows that read several slots, or none
    slot_sets: np.ndarray  # [32] u64, the slots that a half row reads, as ``slot_bit`` has sets of them
    factors: np.ndarray  # [MAX_TAPS * 8] f32
    slot_rows: np.ndarray  # [MAX_SLOTS, levels] i32, the codebook rows of a slot, -1 none
    sizes: np.ndarray  # [3] i32: slots in use; 1 when all pixels read slot 0 alone; columns of a grid in use
    spans: np.ndarray  # [SIDES, 2] i32, the columns that a side of the tile reads, first and last
    shares: np.ndarray  # [SIDES * MAX_LINES * 8] f32, what each lane of a side reads of each of the tile's columns


def reading_of(observation: ViewFeatures, width: int, height: int, walk: CompositingParams) -> Reading:
    """S of an observation for the walk's pixels of an image of ``width`` x ``height``."""
    left, top = (slice(first, None, walk.stride) for first in walk.offset)
    no_ints = np.empty(0, np.int32)
    no_floats = np.empty(0, np.float32)
    if isinstance(observation, Regions):
        labels = np.ascontiguousarray(observation.labels.to(torch.int32).numpy())
        levels, rows, columns = labels.shape
        label_x = np.ascontiguousarray(_nearest(width, columns)[left])
        label_y = np.ascontiguousarray(_nearest(height, rows)[top])
        return Reading(
            False, levels, labels, label_x, label_y,
            no_ints, no_ints, no_floats, no_floats, 0, observation.codebook.shape[0],
        )  # fmt: skip
    rows, columns = observation.grid.shape[:2]
    cell_x, share_x = (np.ascontiguousarray(part[left]) for part in _taps(width, columns))
    cell_y, share_y = (np.ascontiguousarray(part[top]) for part in _taps(height, rows))
    no_labels = np.empty((0, 0, 0), np.int32)
    return Reading(True, 1, no_labels, no_ints, no_ints, cell_x, cell_y, share_x, share_y, columns, rows * columns)


def _nearest(pixels: int, cells: int) -> np.ndarray:
    """[pixels] i32: floor((p + 0.5) cells / pixels), in whole numbers."""
    return ((2 * np.arange(pixels, dtype=np.int64) + 1) * cells // (2 * pixels)).astype(np.int32)


def _taps(pixels: int, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """The left cell and the right cell's share of every pixel, half-pixel centres, clamped borders."""
    position = ((np.arange(pixels) + 0.5) * cells / pixels - 0.5).clip(0, cells - 1)
    left = np.minimum(np.floor(position), max(cells - 2, 0)).astype(np.int32)
    return left, (position - left).astype(np.float32)


@kernel
def new_taps(levels):
    """Room for one tile's taps."""
    return TileTaps(
        np.zeros(HALVES + 1, np.int32),
        np.zeros(MAX_TAPS, np.int32),
        np.full(HALVES, NO_SLOT, np.int32),
        np.zeros(1, np.uint32),
        np.zeros(HALVES, np.uint64),
        np.zeros(MAX_TAPS * LANES, np.float32),
        np.zeros((MAX_SLOTS, levels), np.int32),
        np.zeros(3, np.int32),
        np.zeros((SIDES, 2), np.int32),
        np.zeros(SIDES * MAX_LINES * LANES, np.float32),
    )


@kernel
def read_tile(taps, reading, frame, tile):
    """Fill ``taps`` with what the tile's pixels read."""
    x0 = (tile % frame.columns) * TILE
    y0 = (tile // frame.columns) * TILE
    taps.sizes[:] = 0
    if reading.is_grid:
        _read_grid(taps, reading, frame, x0, y0)
    else:
        _read_regions(taps, reading, frame, x0, y0)
    taps.several[0] = 0
    for half in range(HALVES):
        if taps.alone[half] >= 0:
            taps.slot_sets[half] = slot_bit(taps.alone[half])
            continue
        taps.several[0] |= np.uint32(1) << np.uint32(half)
        taps.slot_sets[half] = 0
        for tap in range(taps.starts[half], taps.starts[half + 1]):
            taps.slot_sets[half] |= slot_bit(taps.slots[tap])


@inlined
def slot_bit(slot):
    """A set of one slot; the last bit stands for slot LAST_BIT and all beyond."""
    return np.uint64(1) << np.uint64(min(slot, LAST_BIT))


# Functions that are called for a pixel take the arrays that they read, no tuples of them: each array of a tuple is
# counted when it is handed on, there and back, by a locked instruction.


@kernel
def _slot_of_labels(labels, slot_rows, sizes, y, x):
    """The slot of the label tuple at label pixel (y, x); NO_SLOT when no level labels it."""
    levels = labels.shape[0]
    labelled = False
    for level in range(levels):
        labelled |= labels[level, y, x] >= 0
    if not labelled:
        return NO_SLOT
    known = sizes[0]
    for slot in range(known - 1, -1, -1):
        same = True
        for level in range(levels):
            same &= slot_rows[slot, level] == labels[level, y, x]
        if same:
            return slot
    for level in range(levels):
        slot_rows[known, level] = labels[level, y, x]
    sizes[0] = known + 1
    return known


@kernel
def _same_labels(labels, y, x, other):
    """Whether the label pixels (y, x) and (y, other) have the same labels on all levels."""
    same = True
    for level in range(labels.shape[0]):
        same &= labels[level, y, x] == labels[level, y, other]
    return same


@kernel
def _reads_only(labels, flat, rows, y, first):
    """Whether the eight label pixels from (y, first) on all have the labels ``rows`` [levels] of one slot."""
    levels, height, width = labels.shape
    only = True
    for level in range(levels):
        only &= all_are(flat, (level * height + y) * width + first, rows[level])
    return only


@kernel
def _read_regions(taps, reading, frame, x0, y0):
    slots = np.empty(LANES, np.int32)
    labels, label_x, label_y, flat = reading.labels, reading.label_x, reading.label_y, reading.labels.reshape(-1)
    slot_rows, sizes, starts, alone = taps.slot_rows, taps.sizes, taps.starts, taps.alone
    tap_slots, factors = taps.slots, taps.factors
    count = 0
    uniform = True
    guess = NO_SLOT  # what the half row before read: most read the same
    for half in range(HALVES):
        starts[half] = count
        alone[half] = NO_SLOT
        y = y0 + half % ROWS
        left = x0 + half // ROWS * LANES
        if y >= frame.height or left >= frame.width:
            continue
        row, first = label_y[y], label_x[left]
        last = min(left + LANES, frame.width) - 1
        in_line = label_x[last] - first == LANES - 1  # label pixels side by side, as the pixels are
        if guess != NO_SLOT and in_line and _reads_only(labels, flat, slot_rows[guess], row, first):
            alone[half] = guess
            uniform &= guess == 0
            continue
        for lane in range(LANES):
            # Pixels outside the image carry no light; they may read what their neighbour reads.
            x, before = label_x[min(left + lane, last)], label_x[min(left + max(lane, 1) - 1, last)]
            if lane > 0 and _same_labels(labels, row, x, before):
                slots[lane] = slots[lane - 1]
            else:
                slots[lane] = _slot_of_labels(labels, slot_rows, sizes, row, x)
        guess = slots[LANES - 1]
        if slots.min() == slots.max():
            alone[half] = guess
        else:
            alone[half] = SEVERAL
            count = _add_taps(tap_slots, factors, slots, count)
        uniform &= alone[half] == 0
    starts[HALVES] = count
    sizes[1] = uniform and sizes[0] == 1


@kernel
def _add_taps(tap_slots, factors, slots, first):
    """A tap for each slot that a half row's lanes read, from tap ``first`` on; the first tap after them."""
    count = first
    for lane in range(LANES):
        if slots[lane] == NO_SLOT:
            continue
        tap = first
        while tap < count and tap_slots[tap] != slots[lane]:
            tap += 1
        if tap == count:
            tap_slots[tap] = slots[lane]
            factors[tap * LANES : tap * LANES + LANES] = 0
            count += 1
        factors[tap * LANES + lane] = 1
    return count


@kernel
def _read_grid(taps, reading, frame, x0, y0):
    columns, rows = np.empty(MAX_LINES, np.int32), np.empty(MAX_LINES, np.int32)  # the cells', ascending
    read, width = np.full((TILE, 2), NO_SLOT, np.int32), 0
    taps.shares[:], taps.spans[:] = 0, 0
    for x in range(x0, min(x0 + TILE, frame.width)):
        side, lane = (x - x0) // LANES, (x - x0) % LANES
        width = _read_lines(read[x - x0], columns, width, reading.cell_x[x], reading.share_x[x])
        for right in range(2):
            line = read[x - x0, right]
            if line == NO_SLOT:
                continue
            if taps.spans[side, 1] == 0:
                taps.spans[side, 0] = line
            taps.spans[side, 1] = max(taps.spans[side, 1], line + 1)
            share = reading.share_x[x] if right else 1 - reading.share_x[x]
            taps.shares[(side * MAX_LINES + line) * LANES + lane] += share
    height, read[:] = 0, NO_SLOT
    for y in range(y0, min(y0 + TILE, frame.height)):
        height = _read_lines(read[y - y0], rows, height, reading.cell_y[y], reading.share_y[y])
    count = 0
    for half in range(HALVES):
        taps.starts[half], taps.alone[half] = count, NO_SLOT
        side, y = half // ROWS, y0 + half % ROWS
        if y >= frame.height or x0 + side * LANES >= frame.width:
            continue
        taps.alone[half] = SEVERAL
        for below in range(2):
            line = read[half % ROWS, below]
            if line != NO_SLOT:
                taps.slots[count] = SIDES * line + side
                share = reading.share_y[y] if below else 1 - reading.share_y[y]
                taps.factors[count * LANES : count * LANES + LANES] = share
                count += 1
    taps.starts[HALVES] = count
    for row in range(height):
        for column in range(width):
            taps.slot_rows[row * width + column, 0] = rows[row] * reading.grid_width + columns[column]
    taps.sizes[0], taps.sizes[2] = height * width, width


@kernel
def _read_lines(read, lines, known, cell, share):
    """Number the two lines that a pixel reads, from ``cell`` on, where it reads any of them.

    Args:
        read: [2] i32, written; NO_SLOT where the share is zero. lines: [MAX_LINES] i32, ascending; grows.

    Returns:
        How many lines there are now.
    """
    for after in range(2):
        if (share if after else 1 - share) == 0:
            continue
        line = max(known - 2, 0)  # pixels come in order: a line is new, or among the last two
        while line < known and lines[line] != cell + after:
            line += 1
        if line == known:
            lines[known] = cell + after
            known += 1
        read[after] = line
    return known
