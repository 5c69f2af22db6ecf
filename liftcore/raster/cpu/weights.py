"""``W = A'^T S`` of one view: the only stage of a lift that iterates over pixels.

**Reading**: S, tile by tile, as a list of taps. A region map's slots are the distinct label tuples of the tile (a
ray's labels on all levels), its factors zeros and ones. A bilinear weight is a row's share times a column's share,
and all pixels of a row segment have the same row shares. So a grid's taps are **lines**: a row of cells read by one
side of the tile, two for each segment for any number of cells, with the row's share in all lanes. The column shares
are applied once per splat: the dot product of a line's lanes and a column's shares is the splat's weight on that
cell.

**Weighing**: every tile writes entries (row of a projected splat, slot, weight, total weight) into its share's
buffer: the sum of a splat's weights over the pixels of one slot, and on its first entry of the tile the sum of its
unscaled weights over all rays. The pixel loop does not depend on labels or channels.

**Merging**: a counting sort gathers the entries by splat; only then are slots expanded to the codebook rows of all
levels and summed, in float64. Ranges of splats are merged independently, and the result of a range depends on its
entries alone.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch

from liftcore.raster.cpu.composite import (
    CHECK_EVERY,
    Frame,
    blend_both,
    largest_weights,
    meets,
    new_marks,
    new_rays,
    next_splat,
    rank_tile,
    start_rays,
    update_active,
)
from liftcore.raster.cpu.simd import (
    LANES,
    PIXELS,
    ROWS,
    SEGMENTS,
    SIDES,
    all_are,
    any_above,
    fetch_place,
    lanes_at,
    lowest,
    no_lanes,
    plus,
    plus_product,
    store_lanes,
    sum_of_lanes,
    times,
    without_lowest,
)
from liftcore.runtime.jit import inlined, kernel
from liftcore.scene.compositing import TILE, CompositingParams
from liftcore.values.views import Regions, ViewFeatures, cells_under

Run = Callable[[Callable, list], list]

MAX_LINES = 2 * TILE  # rows or columns of cells: every pixel reads two different ones at worst
MAX_SLOTS = MAX_LINES * MAX_LINES
MAX_TAPS = SEGMENTS * LANES  # every lane of a segment reads a different slot at worst
NO_SLOT = -1
LAST_BIT = 63
SEVERAL = -2  # a segment whose pixels read several slots, or parts of one
_ROW_BITS = np.uint64((1 << SIDES) - 1)  # of a row of cells, in a set of slots
RANGE_ENTRIES = 1 << 23  # merged at a time, at least those of one splat: each range reads all entries again
_WORD = 64  # columns per word of a set
_NEAR, _FAR = 12, 24  # entries by which the target memory is prefetched, and before it the cursors that point there

# ----------------------------------------------------------------------------------------------------------- Reading


class ViewReading(NamedTuple):
    """S of one view for the compiled code, of a region map or of a grid."""

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

    starts: np.ndarray  # [33] i32, each segment's taps
    slots: np.ndarray  # [MAX_TAPS] i32
    single_slots: np.ndarray  # [32] i32, the one slot that all pixels of a segment read; -1 none, -2 several (taps)
    several: np.ndarray  # [1] u64, the set of segments that read several slots, or none
    slot_sets: np.ndarray  # [32] u64, the slots that a segment reads, as bits of ``slot_bit``
    factors: np.ndarray  # [MAX_TAPS * 8] f32
    slot_rows: np.ndarray  # [MAX_SLOTS, levels] i32, the codebook rows of a slot, -1 none
    sizes: np.ndarray  # [3] i32: slots in use; 1 when all pixels read slot 0 alone; columns of a grid in use
    spans: np.ndarray  # [SIDES, 2] i32, the columns that a side of the tile reads, first and last
    shares: np.ndarray  # [SIDES * MAX_LINES * 8] f32, the share of each of the tile's columns in each lane of a side


def reading_of(observation: ViewFeatures, width: int, height: int, params: CompositingParams) -> ViewReading:
    """Return S of an observation for the pixels of the stride in an image of ``width`` x ``height``."""
    left, top = (slice(first, None, params.stride) for first in params.offset)
    no_ints = np.empty(0, np.int32)
    no_floats = np.empty(0, np.float32)
    if isinstance(observation, Regions):
        labels = np.ascontiguousarray(observation.labels.to(torch.int32).numpy())
        levels, rows, columns = labels.shape
        label_x = cells_under(np.arange(width)[left], width, columns).astype(np.int32)
        label_y = cells_under(np.arange(height)[top], height, rows).astype(np.int32)
        return ViewReading(
            False, levels, labels, label_x, label_y,
            no_ints, no_ints, no_floats, no_floats, 0, observation.codebook.shape[0],
        )  # fmt: skip
    rows, columns = observation.grid.shape[:2]
    cell_x, share_x = (np.ascontiguousarray(part[left]) for part in _taps(width, columns))
    cell_y, share_y = (np.ascontiguousarray(part[top]) for part in _taps(height, rows))
    no_labels = np.empty((0, 0, 0), np.int32)
    return ViewReading(
        True, 1, no_labels, no_ints, no_ints, cell_x, cell_y, share_x, share_y, columns, rows * columns
    )


def _taps(pixels: int, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the left cell and the right cell's share of every pixel, half-pixel centres, clamped borders."""
    position = ((np.arange(pixels) + 0.5) * cells / pixels - 0.5).clip(0, cells - 1)
    left_cell = np.minimum(np.floor(position), max(cells - 2, 0)).astype(np.int32)
    return left_cell, (position - left_cell).astype(np.float32)


def new_taps(levels: int) -> TileTaps:
    """Allocate one tile's taps."""
    return TileTaps(
        np.zeros(SEGMENTS + 1, np.int32),
        np.zeros(MAX_TAPS, np.int32),
        np.full(SEGMENTS, NO_SLOT, np.int32),
        np.zeros(1, np.uint64),
        np.zeros(SEGMENTS, np.uint64),
        np.zeros(MAX_TAPS * LANES, np.float32),
        np.zeros((MAX_SLOTS, levels), np.int32),
        np.zeros(3, np.int32),
        np.zeros((SIDES, 2), np.int32),
        np.zeros(SIDES * MAX_LINES * LANES, np.float32),
    )


@kernel
def read_tile(taps, reading, width, height, x0, y0):
    """Fill ``taps`` for the pixels of the tile from (x0, y0) on, in an image of ``width`` x ``height``."""
    for k in range(3):
        taps.sizes[k] = 0
    if reading.is_grid:
        _read_grid(taps, reading, width, height, x0, y0)
    else:
        _read_regions(taps, reading, width, height, x0, y0)
    taps.several[0] = 0
    for segment in range(SEGMENTS):
        if taps.single_slots[segment] >= 0:
            taps.slot_sets[segment] = slot_bit(taps.single_slots[segment])
            continue
        taps.several[0] |= np.uint64(1) << np.uint64(segment)
        taps.slot_sets[segment] = 0
        for tap in range(taps.starts[segment], taps.starts[segment + 1]):
            taps.slot_sets[segment] |= slot_bit(taps.slots[tap])


@inlined
def slot_bit(slot):
    """Return a set of one slot; the last bit stands for slot LAST_BIT and all above."""
    return np.uint64(1) << np.uint64(min(slot, LAST_BIT))


# Functions that are called per pixel take arrays, not tuples of them: passing a tuple counts references to each of
# its arrays by locked instructions.


@kernel
def _slot_of_labels(labels, slot_rows, sizes, y, x):
    """Return the slot of the label tuple at label pixel (y, x), added if new; NO_SLOT if no level labels it."""
    levels = labels.shape[0]
    labelled = False
    for level in range(levels):
        labelled |= labels[level, y, x] >= 0
    if not labelled:
        return NO_SLOT
    slot_count = sizes[0]
    for slot in range(slot_count - 1, -1, -1):
        is_equal = True
        for level in range(levels):
            is_equal &= slot_rows[slot, level] == labels[level, y, x]
        if is_equal:
            return slot
    for level in range(levels):
        slot_rows[slot_count, level] = labels[level, y, x]
    sizes[0] = slot_count + 1
    return slot_count


@kernel
def _same_labels(labels, y, x, other):
    """Return True if the label pixels (y, x) and (y, other) have the same labels on all levels."""
    is_equal = True
    for level in range(labels.shape[0]):
        is_equal &= labels[level, y, x] == labels[level, y, other]
    return is_equal


@kernel
def _reads_only(labels, flat, rows, y, first):
    """Return True if the eight label pixels from (y, first) on all have the labels ``rows`` [levels] of one slot."""
    levels, height, width = labels.shape
    only = True
    for level in range(levels):
        only &= all_are(flat, (level * height + y) * width + first, rows[level])
    return only


@kernel
def _read_regions(taps, reading, width, height, x0, y0):
    slots = np.empty(LANES, np.int32)
    labels, label_x, label_y, flat = reading.labels, reading.label_x, reading.label_y, reading.labels.reshape(-1)
    slot_rows, sizes, starts, single_slots = taps.slot_rows, taps.sizes, taps.starts, taps.single_slots
    tap_slots, factors = taps.slots, taps.factors
    count = np.int64(0)  # a literal would be typed as such and compiled again
    uniform = True
    guess = NO_SLOT  # the slot of the segment before: most segments read the same
    for segment in range(SEGMENTS):
        starts[segment] = count
        single_slots[segment] = NO_SLOT
        y = y0 + segment % ROWS
        x_start = x0 + segment // ROWS * LANES
        if y >= height or x_start >= width:
            continue
        row, first = label_y[y], label_x[x_start]
        last = min(x_start + LANES, width) - 1
        in_line = label_x[last] - first == LANES - 1  # label pixels are adjacent, one per pixel
        if guess != NO_SLOT and in_line and _reads_only(labels, flat, slot_rows[guess], row, first):
            single_slots[segment] = guess
            uniform &= guess == 0
            continue
        for lane in range(LANES):
            # Pixels outside the image are not active; they may read their neighbour's slot.
            x, before = label_x[min(x_start + lane, last)], label_x[min(x_start + max(lane, 1) - 1, last)]
            if lane > 0 and _same_labels(labels, row, x, before):
                slots[lane] = slots[lane - 1]
            else:
                slots[lane] = _slot_of_labels(labels, slot_rows, sizes, row, x)
        guess = slots[LANES - 1]
        is_single = True
        for lane in range(LANES):
            is_single &= slots[lane] == guess
        if is_single:
            single_slots[segment] = guess
        else:
            single_slots[segment] = SEVERAL
            count = _add_taps(tap_slots, factors, slots, count)
        uniform &= single_slots[segment] == 0
    starts[SEGMENTS] = count
    sizes[1] = uniform and sizes[0] == 1


@kernel
def _add_taps(tap_slots, factors, slots, first):
    """Add a tap for each slot that a segment's lanes read, from tap ``first`` on; return the next free tap."""
    count = first
    for lane in range(LANES):
        if slots[lane] == NO_SLOT:
            continue
        tap = first
        while tap < count and tap_slots[tap] != slots[lane]:
            tap += 1
        if tap == count:
            tap_slots[tap] = slots[lane]
            for other in range(LANES):
                factors[tap * LANES + other] = 0
            count += 1
        factors[tap * LANES + lane] = 1
    return count


@kernel
def _read_grid(taps, reading, width, height, x0, y0):
    columns, rows = np.empty(MAX_LINES, np.int32), np.empty(MAX_LINES, np.int32)  # of cells, ascending
    pixel_lines = np.empty((TILE, 2), np.int32)  # the lines of each pixel column, then of each row
    spans, shares, factors = taps.spans, taps.shares, taps.factors
    for side in range(SIDES):
        spans[side, 0] = spans[side, 1] = 0
    for at in range(shares.shape[0]):
        shares[at] = 0
    across = down = count = np.int64(0)
    for x in range(x0, min(x0 + TILE, width)):
        side, lane = (x - x0) // LANES, (x - x0) % LANES
        across = _read_lines(pixel_lines, x - x0, columns, across, reading.cell_x[x], reading.share_x[x])
        for right in range(2):
            line = pixel_lines[x - x0, right]
            if line == NO_SLOT:
                continue
            if spans[side, 1] == 0:
                spans[side, 0] = line
            spans[side, 1] = max(spans[side, 1], line + 1)
            share = reading.share_x[x] if right else 1 - reading.share_x[x]
            shares[(side * MAX_LINES + line) * LANES + lane] += share
    for y in range(y0, min(y0 + TILE, height)):
        down = _read_lines(pixel_lines, y - y0, rows, down, reading.cell_y[y], reading.share_y[y])
    for segment in range(SEGMENTS):
        taps.starts[segment], taps.single_slots[segment] = count, NO_SLOT
        side, y = segment // ROWS, y0 + segment % ROWS
        if y >= height or x0 + side * LANES >= width:
            continue
        taps.single_slots[segment] = SEVERAL
        for below in range(2):
            line = pixel_lines[segment % ROWS, below]
            if line != NO_SLOT:
                taps.slots[count] = SIDES * line + side
                share = reading.share_y[y] if below else 1 - reading.share_y[y]
                for lane in range(LANES):
                    factors[count * LANES + lane] = share
                count += 1
    taps.starts[SEGMENTS] = count
    for row in range(down):
        for column in range(across):
            taps.slot_rows[row * across + column, 0] = rows[row] * reading.grid_width + columns[column]
    taps.sizes[0], taps.sizes[2] = down * across, across


@kernel
def _read_lines(pixel_lines, pixel, lines, line_count, cell, share):
    """Number the lines ``cell`` and ``cell + 1`` that a pixel reads.

    Args:
        pixel_lines: [TILE, 2] i32, row ``pixel`` is written; NO_SLOT where the share is zero.
        lines: [MAX_LINES] i32, ascending; new ones are appended.

    Returns:
        The new number of lines.
    """
    for after in range(2):
        pixel_lines[pixel, after] = NO_SLOT
        if (share if after else 1 - share) == 0:
            continue
        line = max(line_count - 2, 0)  # pixels are in order: a line is new or one of the last two
        while line < line_count and lines[line] != cell + after:
            line += 1
        if line == line_count:
            lines[line_count] = cell + after
            line_count += 1
        pixel_lines[pixel, after] = line
    return line_count


# ---------------------------------------------------------------------------------------------------------- Weighing


def weigh_tiles(
    first: int, last: int, frame: Frame, reading: ViewReading, squared: bool, top_k: int, with_unscaled: bool | None
) -> tuple[np.ndarray, ...]:
    """Return the entries of tiles ``first..last``.

    Options that are None are not compiled into the loop: skipping them at run time would cost a tenth of its time.

    Args:
        squared: square the weights. top_k: number of a ray's largest weights that count; 0 for all of them.
        with_unscaled: True if the total weight is of unscaled opacities, with transmittances of its own; else None.

    Returns:
        places [n] i32 (rows of projected splats), slots [n] i32 (-1 none), weights [n] f32, total weight [n] f32,
        near to far tile by tile; and slot_rows [s, levels] i32, the codebook rows of a slot (-1 none).
    """
    rays, taps, sums = new_rays(frame), new_taps(reading.levels), np.zeros(MAX_SLOTS * LANES, np.float32)
    *entries, slot_rows = _weigh(
        first, last, frame, reading, rays, taps, sums, squared, new_marks(top_k), with_unscaled
    )
    return *entries, slot_rows.reshape(-1, reading.levels)


@kernel
def _weigh(first, last, frame, reading, rays, taps, sums, squared, marks, with_unscaled):
    """Write the entries in one long function: a call would count references to arrays of a tuple by locked
    instructions.
    """
    state, levels = rays.state, reading.levels
    items, starts = frame.items, frame.starts
    tap_starts, tap_slots, factors = taps.starts, taps.slots, taps.factors
    single_slots, slot_sets, spans, shares = taps.single_slots, taps.slot_sets, taps.spans, taps.shares
    is_grid = reading.is_grid
    # The weight of a slot that all pixels read is the total weight.
    reuse = with_unscaled is None and marks is None and not squared
    size = max(1 << 15, 2 * levels)
    places, slots = np.empty(size, np.int32), np.empty(size, np.int32)
    weights, total_weight = np.empty(size, np.float32), np.empty(size, np.float32)
    slot_rows = np.empty(size, np.int32)
    count = slot_count = 0
    for tile in range(first, last):
        if starts[tile] == starts[tile + 1]:
            continue
        column, row = tile % frame.columns, tile // frame.columns
        x0, y0 = float(column * TILE), float(row * TILE)
        if marks is not None:
            rank_tile(rays, frame, tile, marks, with_unscaled)
        start_rays(state, column * TILE, row * TILE, frame.width, frame.height)
        read_tile(taps, reading, frame.width, frame.height, column * TILE, row * TILE)
        tile_slots, whole_tile, columns = taps.sizes[0], reuse and taps.sizes[1] == 1, taps.sizes[2]
        if (slot_count + tile_slots) * levels > slot_rows.shape[0]:
            slot_rows = _longer(slot_rows, max(2 * slot_rows.shape[0], (slot_count + tile_slots) * levels))
        for slot in range(tile_slots):
            for level in range(levels):
                slot_rows[(slot_count + slot) * levels + level] = taps.slot_rows[slot, level]
        for near in range(starts[tile], starts[tile + 1], CHECK_EVERY):
            if not update_active(rays, with_unscaled is not None):
                break
            # Grow here, not where an entry is written: numba counts references to arrays that may be replaced.
            required = count + CHECK_EVERY * (tile_slots + 1)
            if required > places.shape[0]:
                required = max(2 * places.shape[0], required)
                places, slots = _longer(places, required), _longer(slots, required)
                weights, total_weight = _longer(weights, required), _longer(total_weight, required)
            for step in range(near, min(near + CHECK_EVERY, starts[tile + 1])):
                splat = next_splat(frame, tile, step, x0, y0)
                hit_slots, unscaled_sums = np.uint64(0), no_lanes()
                # Segments of several slots come last: the branch then changes once per splat, and is predicted.
                several, hit_segments = taps.several[0], meets(rays, splat)
                ranked = (hit_segments & ~several) | ((hit_segments & several) << np.uint64(SEGMENTS))
                while ranked:
                    rank = lowest(ranked)
                    ranked = without_lowest(ranked)
                    segment = rank & (SEGMENTS - 1)
                    lane_weights, unscaled = blend_both(rays, splat, segment, with_unscaled)
                    unscaled_sums = plus(unscaled_sums, unscaled)
                    if whole_tile:
                        continue
                    if marks is not None:
                        ties_at = marks.shape[0] - PIXELS + segment * LANES
                        least, ties = lanes_at(marks, ties_at - PIXELS), lanes_at(marks, ties_at)
                        lane_weights, ties = largest_weights(lane_weights, least, ties)
                        store_lanes(marks, ties_at, ties)
                        if not any_above(lane_weights, no_lanes()):
                            continue
                    if squared:
                        lane_weights = times(lane_weights, lane_weights)
                    hit_slots |= slot_sets[segment]
                    if rank < SEGMENTS:
                        slot = single_slots[segment]
                        store_lanes(sums, slot * LANES, plus(lanes_at(sums, slot * LANES), lane_weights))
                        continue
                    for tap in range(tap_starts[segment], tap_starts[segment + 1]):
                        slot = tap_slots[tap]
                        before = lanes_at(sums, slot * LANES)
                        store_lanes(
                            sums, slot * LANES, plus_product(before, lane_weights, lanes_at(factors, tap * LANES))
                        )
                total = sum_of_lanes(unscaled_sums)
                first_entry = count
                if whole_tile and total > 0:
                    slots[count], weights[count] = slot_count, total
                    count += 1
                while hit_slots and is_grid:  # a row of cells, read by both sides of the tile
                    line = lowest(hit_slots) // SIDES
                    sides = hit_slots >> np.uint64(SIDES * line)
                    hit_slots &= ~(_ROW_BITS << np.uint64(SIDES * line))
                    begin = spans[0, 0] if sides & np.uint64(1) else spans[1, 0]
                    end = spans[1, 1] if sides & np.uint64(2) else spans[0, 1]
                    left, right = lanes_at(sums, SIDES * line * LANES), lanes_at(sums, (SIDES * line + 1) * LANES)
                    store_lanes(sums, SIDES * line * LANES, no_lanes())
                    store_lanes(sums, (SIDES * line + 1) * LANES, no_lanes())
                    for cell in range(begin, end):
                        part = times(left, lanes_at(shares, cell * LANES))
                        part = plus_product(part, right, lanes_at(shares, (MAX_LINES + cell) * LANES))
                        weight = sum_of_lanes(part)
                        if weight > 0:
                            slots[count], weights[count] = slot_count + line * columns + cell, weight
                            count += 1
                while hit_slots:
                    slot = lowest(hit_slots)
                    hit_slots = without_lowest(hit_slots)
                    beyond = tile_slots if slot == LAST_BIT else slot + 1
                    while slot < beyond:
                        weight = sum_of_lanes(lanes_at(sums, slot * LANES))
                        store_lanes(sums, slot * LANES, no_lanes())
                        if weight > 0:
                            slots[count], weights[count] = slot_count + slot, weight
                            count += 1
                        slot += 1
                if count == first_entry and total > 0:
                    slots[count], weights[count] = NO_SLOT, 0.0
                    count += 1
                for entry in range(first_entry, count):
                    places[entry] = items[step]
                    total_weight[entry] = total if entry == first_entry else 0.0
        slot_count += tile_slots
    return places[:count], slots[:count], weights[:count], total_weight[:count], slot_rows[: slot_count * levels]


@kernel
def _longer(array, size):
    """Return a longer copy."""
    longer = np.empty(size, array.dtype)
    for i in range(array.shape[0]):
        longer[i] = array[i]
    return longer


# ----------------------------------------------------------------------------------------------------------- Merging


def merge_entries(
    entries: list[tuple[np.ndarray, ...]], ids: np.ndarray, codebook_rows: int, threads: int, run: Run
) -> tuple:
    """Merge the entries of all shares, as ``weigh_tiles`` returns them, into one sparse row per splat.

    A range's rows depend on its own entries only, so the number of ranges may depend on the threads: each range reads
    all entries. Maps with a vector per pixel have tens of millions of entries, so the ranges are bounded as well.

    Args:
        entries: of all shares, in order; the list is emptied, as the entries take more memory than the result.
        ids: [P] i32, the splat of each row. run: calls a function for each of a list of argument tuples.

    Returns:
        splats, indptr, columns, weights, total_weight_splats, total weight of ``RegionWeights``, as arrays.
    """
    slot_rows = np.concatenate([share[4] for share in entries])
    bases = np.cumsum([0, *(share[4].shape[0] for share in entries)])

    def count(first: int, last: int) -> np.ndarray:
        counts = np.zeros(len(ids), np.int32)
        for share in entries[first:last]:
            count_entries(share[0], counts)
        return counts

    edges = [len(entries) * k // threads for k in range(threads + 1)]
    ends = np.cumsum(np.sum(run(count, list(pairwise(edges))), axis=0, dtype=np.int64))

    def merge(first: int, last: int) -> tuple[np.ndarray, ...]:
        before = ends[first - 1] if first else 0
        starts = np.concatenate([[before], ends[first:last]]) - before
        words, totals = np.empty((starts[-1], 2), np.int32), np.zeros(last - first)
        row_entries, cursors = (words, words.view(np.float32), totals), starts[:-1].copy()
        for share, base in zip(entries, bases[:-1], strict=True):
            gather_entries(first, last, share[:4], base, cursors, row_entries)
        return merge_range(starts, row_entries, slot_rows, codebook_rows, ids[first:last])

    ranges = max(threads, -(-int(ends[-1]) // RANGE_ENTRIES)) if len(ids) else 1
    marks = np.searchsorted(ends, np.linspace(0, ends[-1], ranges + 1)[1:-1], side="right")
    parts = run(merge, list(pairwise([0, *marks.tolist(), len(ids)])))
    entries.clear()
    splats, lengths, columns, weights, hit_splats, total_weight = (
        np.concatenate(part) for part in zip(*parts, strict=True)
    )
    return (
        splats,
        np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        columns,
        weights,
        hit_splats,
        total_weight,
    )


@kernel
def count_entries(places, counts):
    """Add the number of entries of each row of projected splats to ``counts`` [P] i32."""
    for place in places:
        counts[place] += np.int32(1)


@kernel
def gather_entries(first, last, entries, slot_base, cursors, row_entries):
    """Scatter the entries of rows ``first..last`` to their offsets, and advance the cursors.

    ``entries = (places, slots, weights, total_weight)`` of one tile share, its slots numbered from ``slot_base``.
    ``row_entries = (words, numbers, totals)``: one table [n, 2] of slot and weight, viewed as i32 and as f32, so that
    an entry is one write; and the total weight of each row, [last - first] f64, which is added to.
    """
    places, slots, weights, total_weight = entries
    words, numbers, totals = row_entries
    flat, end = words.reshape(-1), places.shape[0] - 1
    for i in range(places.shape[0]):
        far, near, place = places[min(i + _FAR, end)], places[min(i + _NEAR, end)], places[i]
        if first <= far < last:
            fetch_place(cursors, far - first)
            fetch_place(totals, far - first)
        if first <= near < last:
            fetch_place(flat, 2 * cursors[near - first])
        if first <= place < last:
            at = cursors[place - first]
            cursors[place - first] = at + 1
            words[at, 0] = slots[i] + slot_base if slots[i] >= 0 else -1
            numbers[at, 1] = weights[i]
            totals[place - first] += total_weight[i]


@kernel
def merge_range(starts, row_entries, slot_rows, codebook_rows, ids):
    """Expand, sum and sort the entries of a range of rows.

    Args:
        starts: [n + 1] i64, each row's entries in ``row_entries``, as ``gather_entries`` writes it.
        slot_rows: [S, levels] i32. codebook_rows: M. ids: [n] i32, the splat of each row.

    Returns:
        splats [r] i32, lengths [r] i64, columns [nnz] i32, weights [nnz] f32, and the splats [m] i32 and sums [m] f32
        of the total weight.
    """
    words, numbers, totals = row_entries
    levels = slot_rows.shape[1]
    size = ids.shape[0]
    sums = np.zeros(codebook_rows)
    # The columns of a row as a bit set, which is ordered, where a list would have to be sorted.
    column_sets = np.zeros(codebook_rows // _WORD + 1, np.uint64)
    splats, lengths = np.empty(size, np.int32), np.empty(size, np.int64)
    hit_splats, total_weight = np.empty(size, np.int32), np.empty(size, np.float32)
    capacity = words.shape[0] * levels  # not grown: numba counts references to arrays that are replaced
    columns, weights = np.empty(capacity, np.int32), np.empty(capacity, np.float32)
    row_count = count = hit_count = 0
    for row in range(size):
        total, row_start, low, high = totals[row], count, column_sets.shape[0], -1
        for i in range(starts[row], starts[row + 1]):
            slot = words[i, 0]
            if slot < 0:
                continue
            for level in range(levels):
                column = slot_rows[slot, level]
                if column >= 0:
                    word = column // _WORD
                    column_sets[word] |= np.uint64(1) << np.uint64(column % _WORD)
                    low, high = min(low, word), max(high, word)
                    sums[column] += numbers[i, 1]
        if total > 0:
            hit_splats[hit_count], total_weight[hit_count] = ids[row], total
            hit_count += 1
        for word in range(low, high + 1):
            bits, column_sets[word] = column_sets[word], 0
            while bits:
                column = word * _WORD + lowest(bits)
                bits = without_lowest(bits)
                columns[count], weights[count], sums[column] = column, sums[column], 0
                count += 1
        if count > row_start:
            splats[row_count], lengths[row_count] = ids[row], count - row_start
            row_count += 1
    return (
        splats[:row_count],
        lengths[:row_count],
        columns[:count],
        weights[:count],
        hit_splats[:hit_count],
        total_weight[:hit_count],
    )
