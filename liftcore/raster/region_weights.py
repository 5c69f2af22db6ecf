"""``W = A^p^T S`` of one view: the lift's only look at pixels.

Every tile writes (record, column, weight) entries into its share's buffer; a counting sort gathers them by splat
and each splat's few entries are sorted by column and summed in float64. Column M, one past the codebook, carries
the evidence: the sum of plain weights over all rays.
"""

from __future__ import annotations

import numpy as np

from liftcore.jit import inlined, kernel
from liftcore.lanes import LANES, add_lanes, add_product_lanes, square_lanes
from liftcore.raster.constants import TILE
from liftcore.raster.projection import PLAIN
from liftcore.raster.readings import MAX_SLOTS, new_taps, read_tile
from liftcore.raster.walk import (
    CHECK_EVERY,
    HALVES,
    blend,
    blend_plain,
    footprint,
    look,
    new_rays,
    row_centre,
    start_rays,
    touches,
)

LONG_ROW = 64  # entries; longer rows are sorted by the library


@kernel
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
    records, items, starts = frame.records, frame.items, frame.starts
    tap_starts, tap_slots, tap_whole = taps.starts, taps.slots, taps.whole
    evidence_source = plain.weights if with_plain else rays.weights
    places = np.empty(1 << 16, np.int32)
    columns = np.empty(1 << 16, np.int32)
    weights = np.empty(1 << 16, np.float32)
    count = 0
    for tile in range(first, last):
        if starts[tile] == starts[tile + 1]:
            continue
        x0 = float((tile % frame.columns) * TILE)
        y0 = float((tile // frame.columns) * TILE)
        start_rays(rays, frame, tile)
        start_rays(plain, frame, tile)
        read_tile(taps, reading, frame, tile)
        room = taps.sizes[1] + reading.levels + 1
        for step in range(starts[tile], starts[tile + 1]):
            if (step - starts[tile]) % CHECK_EVERY == 0 and not look_at_both(rays, plain, with_plain):
                break
            place = items[step]
            splat = footprint(records, place, x0, y0)
            low_slot, high_slot = MAX_SLOTS, -1
            for row in range(splat.top, splat.bottom + 1):
                centre, base = row_centre(splat, row)
                for side in range(2):
                    half = 2 * row + side
                    if not rays.alive[half] or not touches(splat, centre, base, side):
                        continue
                    offset = half * LANES
                    blend(rays, splat, centre, base, half, limits)
                    if with_plain:
                        blend_plain(plain, rays.falloff, records[place, PLAIN], half, limits)
                    add_lanes(evidence, 0, evidence_source, offset)
                    if power == 2:
                        square_lanes(rays.weights, offset)
                    for tap in range(tap_starts[half], tap_starts[half + 1]):
                        slot = tap_slots[tap]
                        low_slot = min(low_slot, slot)
                        high_slot = max(high_slot, slot)
                        if tap_whole[tap]:
                            add_lanes(slots, slot * LANES, rays.weights, offset)
                        else:
                            add_product_lanes(slots, slot * LANES, rays.weights, offset, taps.factors, tap * LANES)
            if count + room > places.shape[0]:
                places, columns, weights = _grow(places, columns, weights, count + room)
            total = _drain(evidence, 0)
            if total > 0:
                places[count] = place
                columns[count] = reading.codebook_rows
                weights[count] = total
                count += 1
            if high_slot == low_slot:  # most splats meet one slot a tile
                total = _drain(slots, low_slot * LANES)
                for level in range(reading.levels if total > 0 else 0):
                    column = taps.slot_columns[low_slot, level]
                    if column >= 0:
                        places[count] = place
                        columns[count] = taps.columns[column]
                        weights[count] = total
                        count += 1
            elif high_slot >= 0:
                kept = _flush_slots(taps, slots, local, low_slot, high_slot, columns, weights, count)
                places[count:kept] = place
                count = kept
    return places[:count], columns[:count], weights[:count]


@inlined
def look_at_both(rays, plain, with_plain):
    """Note in ``rays.alive`` which half rows let light through, with or without the gain; whether any does."""
    alive = look(rays)
    if with_plain:
        alive |= look(plain)
        for half in range(HALVES):
            rays.alive[half] |= plain.alive[half]
    return alive


@inlined
def _drain(lanes, offset):
    """The sum of eight lanes, in a fixed tree; the lanes are zero afterwards."""
    total = ((lanes[offset] + lanes[offset + 4]) + (lanes[offset + 2] + lanes[offset + 6])) + (
        (lanes[offset + 1] + lanes[offset + 5]) + (lanes[offset + 3] + lanes[offset + 7])
    )
    for lane in range(LANES):
        lanes[offset + lane] = 0
    return total


@kernel
def _grow(places, columns, weights, needed):
    size = max(2 * places.shape[0], needed)
    new_places = np.empty(size, np.int32)
    new_columns = np.empty(size, np.int32)
    new_weights = np.empty(size, np.float32)
    new_places[: places.shape[0]] = places
    new_columns[: columns.shape[0]] = columns
    new_weights[: weights.shape[0]] = weights
    return new_places, new_columns, new_weights


@kernel
def _flush_slots(taps, slots, local, low_slot, high_slot, columns, weights, count):
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
            columns[count] = taps.columns[column]
            weights[count] = local[column]
            count += 1
            local[column] = 0
    return count


@kernel
def count_entries(first, last, places, counts):
    """Add to ``counts`` [P] i64 how many entries each of the records ``first..last`` has."""
    for place in places:
        if first <= place < last:
            counts[place] += 1


@kernel
def group_entries(first, last, entries, cursors, columns, weights):
    """Scatter the entries of the records ``first..last`` to their ranges (cursors [P] i64 move on).

    ``entries = (places, columns, weights)`` of one tile share, as ``weigh_tiles`` gave them.
    """
    places, entry_columns, entry_weights = entries
    for i in range(places.shape[0]):
        place = places[i]
        if first <= place < last:
            at = cursors[place]
            cursors[place] = at + 1
            columns[at] = entry_columns[i]
            weights[at] = entry_weights[i]


@kernel
def merge_rows(first, last, starts, columns, weights, column_count, kept):
    """Sum each record's entries by column in float64 and sort them by column, in place.

    ``kept`` [P] i64 receives how many entries each of the records ``first..last`` keeps.
    """
    sums = np.zeros(column_count)
    for row in range(first, last):
        begin, end = starts[row], starts[row + 1]
        out = begin
        for i in range(begin, end):
            column = columns[i]
            if sums[column] == 0:
                columns[out] = column  # out <= i: entries before i are already summed
                out += 1
            sums[column] += weights[i]
        if out - begin > LONG_ROW:
            columns[begin:out] = np.sort(columns[begin:out])
        for i in range(begin + 1, out):  # insertion sort: most rows are short
            column = columns[i]
            k = i - 1
            while k >= begin and columns[k] > column:
                columns[k + 1] = columns[k]
                k -= 1
            columns[k + 1] = column
        for i in range(begin, out):
            weights[i] = sums[columns[i]]
            sums[columns[i]] = 0
        kept[row] = out - begin


@kernel
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
