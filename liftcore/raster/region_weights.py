"""``W = A^p^T S`` of one view: the lift's only look at pixels.

Every tile writes (record, column, weight) entries into its share's buffer; a counting sort gathers them by splat
and each splat's few entries are sorted by column and summed in float64. Column M, one past the codebook, carries
the evidence: the sum of plain weights over all rays.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from liftcore.raster.lanes import LANES, add_lanes, add_product_lanes, square_lanes
from liftcore.raster.readings import MAX_SLOTS, new_taps, read_tile
from liftcore.raster.walk import (
    CHECK_EVERY,
    blend,
    blend_plain,
    look,
    new_rays,
    row_centre,
    row_range,
    start_rays,
    touches,
)

LONG_ROW = 64  # entries; longer rows are merge-sorted first


@njit(nogil=True, cache=True)
def weigh_tiles(first, last, frame, reading, power, with_plain):
    """Entries of tiles ``first..last``.

    Args:
        frame: Frame. reading: Reading. power: 1 or 2.
        with_plain: whether the evidence needs rays of its own, without the opacity gain.

    Returns:
        places [n] i32 (records), columns [n] i32, weights [n] f32, near to far tile by tile.
    """
    rays = new_rays()
    plain = new_rays()
    taps = new_taps(reading.levels)
    slots = np.zeros(MAX_SLOTS * LANES, np.float32)
    local = np.zeros(MAX_SLOTS * reading.levels, np.float32)
    evidence = np.zeros(LANES, np.float32)
    limits = (np.float32(frame.cap), np.float32(frame.stop))
    places = np.empty(1 << 14, np.int32)
    columns = np.empty(1 << 14, np.int32)
    weights = np.empty(1 << 14, np.float32)
    count = 0
    for tile in range(first, last):
        if frame.starts[tile] == frame.starts[tile + 1]:
            continue
        x0 = float((tile % frame.columns) * 16)
        y0 = float((tile // frame.columns) * 16)
        start_rays(rays, frame, tile)
        start_rays(plain, frame, tile)
        read_tile(taps, reading, frame, tile)
        for step in range(frame.starts[tile], frame.starts[tile + 1]):
            if (step - frame.starts[tile]) % CHECK_EVERY == 0:
                alive = look(rays)
                if with_plain:
                    alive |= look(plain)
                    for half in range(rays.alive.shape[0]):
                        rays.alive[half] |= plain.alive[half]
                if not alive:
                    break
            place = frame.items[step]
            record = frame.records[place]
            top, bottom = row_range(record, y0)
            met = False
            low_slot, high_slot = MAX_SLOTS, -1
            for row in range(top, bottom + 1):
                centre, base = row_centre(record, row, x0, y0)
                for side in range(2):
                    half = 2 * row + side
                    if not rays.alive[half] or not touches(record, centre, base, side):
                        continue
                    met = True
                    offset = half * LANES
                    blend(rays, record, centre, base, half, limits)
                    if with_plain:
                        blend_plain(plain, rays.falloff, record, half, limits)
                        add_lanes(evidence, 0, plain.weights, offset)
                    else:
                        add_lanes(evidence, 0, rays.weights, offset)
                    if power == 2:
                        square_lanes(rays.weights, offset)
                    for tap in range(taps.starts[half], taps.starts[half + 1]):
                        slot = taps.slots[tap]
                        low_slot = min(low_slot, slot)
                        high_slot = max(high_slot, slot)
                        if taps.whole[tap]:
                            add_lanes(slots, slot * LANES, rays.weights, offset)
                        else:
                            add_product_lanes(
                                slots, slot * LANES, rays.weights, offset, taps.factors, tap * LANES
                            )
            if not met:
                continue
            room = taps.sizes[1] + 1
            if count + room > places.shape[0]:
                places, columns, weights = _grow(places, columns, weights, count + room)
            count = _flush_slots(taps, slots, local, low_slot, high_slot, place, places, columns, weights, count)
            total = _drain(evidence, 0)
            if total > 0:
                places[count] = place
                columns[count] = reading.codebook_rows
                weights[count] = total
                count += 1
    return places[:count], columns[:count], weights[:count]


@njit(nogil=True, cache=True, inline="always")
def _drain(lanes, offset):
    """The sum of eight lanes, in a fixed tree; the lanes are zero afterwards."""
    total = (
        (lanes[offset] + lanes[offset + 4]) + (lanes[offset + 2] + lanes[offset + 6])
    ) + ((lanes[offset + 1] + lanes[offset + 5]) + (lanes[offset + 3] + lanes[offset + 7]))
    for lane in range(LANES):
        lanes[offset + lane] = 0
    return total


@njit(nogil=True, cache=True)
def _grow(places, columns, weights, needed):
    size = max(2 * places.shape[0], needed)
    new_places = np.empty(size, np.int32)
    new_columns = np.empty(size, np.int32)
    new_weights = np.empty(size, np.float32)
    new_places[: places.shape[0]] = places
    new_columns[: columns.shape[0]] = columns
    new_weights[: weights.shape[0]] = weights
    return new_places, new_columns, new_weights


@njit(nogil=True, cache=True)
def _flush_slots(taps, slots, local, low_slot, high_slot, place, places, columns, weights, count):
    """Expand a splat's slots to codebook rows and append them; slots and local sums are zero afterwards."""
    levels = taps.slot_columns.shape[1]
    low_column, high_column = taps.sizes[1], -1
    for slot in range(low_slot, high_slot + 1):
        total = _drain(slots, slot * LANES)
        if total <= 0:
            continue
        for level in range(levels):
            column = taps.slot_columns[slot, level]
            if column >= 0:
                local[column] += total
                low_column = min(low_column, column)
                high_column = max(high_column, column)
    for column in range(low_column, high_column + 1):
        if local[column] > 0:
            places[count] = place
            columns[count] = taps.columns[column]
            weights[count] = local[column]
            count += 1
            local[column] = 0
    return count


@njit(nogil=True, cache=True)
def group_entries(places, columns, weights, cursors, grouped_columns, grouped_weights):
    """Scatter one share's entries to their records' ranges (cursors [P + 1] i64 move on)."""
    for i in range(places.shape[0]):
        at = cursors[places[i]]
        cursors[places[i]] = at + 1
        grouped_columns[at] = columns[i]
        grouped_weights[at] = weights[i]


@njit(nogil=True, cache=True)
def count_entries(places, counts):
    """Add to ``counts`` [P] i64 how many entries each record has."""
    for place in places:
        counts[place] += 1


@njit(nogil=True, cache=True)
def merge_rows(first, last, starts, columns, weights, kept):
    """Sort each record's entries by column and sum equal columns in float64, in place.

    ``kept`` [P] i64 receives how many entries each of the records ``first..last`` keeps.
    """
    for row in range(first, last):
        begin, end = starts[row], starts[row + 1]
        if end - begin > LONG_ROW:
            order = np.argsort(columns[begin:end], kind="mergesort")
            columns[begin:end] = columns[begin:end][order]
            weights[begin:end] = weights[begin:end][order]
        for i in range(begin + 1, end):  # insertion sort: stable, and most rows are short
            column, weight = columns[i], weights[i]
            k = i - 1
            while k >= begin and columns[k] > column:
                columns[k + 1] = columns[k]
                weights[k + 1] = weights[k]
                k -= 1
            columns[k + 1] = column
            weights[k + 1] = weight
        out = begin
        i = begin
        while i < end:
            column = columns[i]
            total = 0.0
            while i < end and columns[i] == column:
                total += weights[i]
                i += 1
            columns[out] = column
            weights[out] = total
            out += 1
        kept[row] = out - begin


@njit(nogil=True, cache=True)
def split_evidence(starts, kept, columns, weights, evidence_column, ids, out):
    """Pack the merged rows: region weights on one side, the evidence column on the other.

    ``out = (splats, row_starts, columns, weights, evidence_splats, evidence)``, sized by the caller.

    Returns:
        (rows, entries, evidence rows) written.
    """
    splats, row_starts, out_columns, out_weights, evidence_splats, evidence = out
    rows = entries = met = 0
    row_starts[0] = 0
    for row in range(kept.shape[0]):
        begin = starts[row]
        end = begin + kept[row]
        if end > begin and columns[end - 1] == evidence_column:
            end -= 1
            evidence_splats[met] = ids[row]
            evidence[met] = weights[end]
            met += 1
        if end > begin:
            splats[rows] = ids[row]
            for i in range(begin, end):
                out_columns[entries] = columns[i]
                out_weights[entries] = weights[i]
                entries += 1
            rows += 1
            row_starts[rows] = entries
    return rows, entries, met
