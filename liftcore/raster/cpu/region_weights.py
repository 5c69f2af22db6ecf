"""``W = A'^T S`` of one view: the lift's only look at pixels.

Every tile writes entries (record, slot, weight, evidence) into its share's buffer: what a splat gave to the pixels
of one slot, and on its first entry of the tile the sum of its plain weights over all rays. A counting sort gathers
the entries by splat; only then are slots expanded to the codebook rows of all levels and summed, in float64.
"""

from __future__ import annotations

import numpy as np

from liftcore.jit import inlined, kernel
from liftcore.raster.constants import TILE
from liftcore.raster.cpu.lanes import (
    HALVES,
    LANES,
    PIXELS,
    TRANSMITTANCE,
    keep_lanes,
    lanes_at,
    no_lanes,
    plus,
    plus_product,
    sum_of_lanes,
    times,
)
from liftcore.raster.cpu.lanes_halves import lowest_rank, ranked_halves, without_lowest_rank
from liftcore.raster.cpu.lanes_select import any_above
from liftcore.raster.cpu.readings import LAST_BIT, MAX_LINES, MAX_SLOTS, NO_SLOT, SIDES, new_taps, read_tile
from liftcore.raster.cpu.selection import CENTRAL, LARGEST, NO_SPOT, chosen, new_marks, rank_tile, spot_of
from liftcore.raster.cpu.walk import CHECK_EVERY, blend_both, look, meets, new_rays, next_splat, start_rays

ROW_BITS = np.uint64((1 << SIDES) - 1)  # of a row of cells, in a set of slots


@kernel
def weigh_tiles(first, last, frame, reading, squared, gate, plain):
    """Entries of tiles ``first..last``.

    What a lift does not ask for is not compiled into its walk: it costs a tenth there even where it is passed over.
    One long function, as an array that a callee takes from a tuple is counted, by a locked instruction, at each call.

    Args:
        frame: Frame. reading: Reading. squared: whether a weight counts by its square; a gate sees to that itself.
        gate: Choice of the weights that count; None for all of them.
        plain: True when the evidence needs rays of its own, without the opacity gain; else None.

    Returns:
        places [n] i32 (records), slots [n] i32 (-1 none), weights [n] f32, evidence [n] f32, near to far tile by
        tile; and slot_rows [s, levels] i32, the codebook rows of a slot (-1 none).
    """
    rays = new_rays(frame)
    state = rays.state
    taps = new_taps(reading.levels)
    sums = np.zeros(MAX_SLOTS * LANES, np.float32)
    items, starts = frame.items, frame.starts
    tap_starts, tap_slots, factors = taps.starts, taps.slots, taps.factors
    alone, slot_sets, spans, shares = taps.alone, taps.slot_sets, taps.spans, taps.shares
    is_grid = reading.is_grid
    marks, spot = new_marks(gate), NO_SPOT
    # A slot that all pixels read holds just the evidence.
    reuse = plain is None and gate is None and not squared
    size = 1 << 15
    places, slots = np.empty(size, np.int32), np.empty(size, np.int32)
    weights, evidence = np.empty(size, np.float32), np.empty(size, np.float32)
    slot_rows = np.empty((1 << 12, reading.levels), np.int32)
    count = slot_count = 0
    for tile in range(first, last):
        if starts[tile] == starts[tile + 1]:
            continue
        x0 = float((tile % frame.columns) * TILE)
        y0 = float((tile // frame.columns) * TILE)
        if gate is not None and gate.kind == LARGEST:
            rank_tile(rays, frame, tile, marks, plain)
        start_rays(rays, frame, tile)
        read_tile(taps, reading, frame, tile)
        used, whole_tile, columns = taps.sizes[0], reuse and taps.sizes[1] == 1, taps.sizes[2]
        if slot_count + used > slot_rows.shape[0]:
            slot_rows = _grown_rows(slot_rows, slot_count + used)
        slot_rows[slot_count : slot_count + used] = taps.slot_rows[:used]
        for near in range(starts[tile], starts[tile + 1], CHECK_EVERY):
            if not look(rays, plain is not None):
                break
            # Here, not where an entry is written: arrays that may be replaced are counted at each use.
            needed = count + CHECK_EVERY * (used + 1)
            if needed > places.shape[0]:
                places, slots, weights, evidence = _grown(places, slots, weights, evidence, needed)
            for step in range(near, min(near + CHECK_EVERY, starts[tile + 1])):
                splat = next_splat(frame, tile, step, x0, y0)
                if gate is not None and gate.kind == CENTRAL:
                    spot = spot_of(splat)
                met, seen = np.uint64(0), no_lanes()
                # Half rows of several slots come last: a branch that changes once a splat is foreseen.
                ranked = ranked_halves(meets(rays, splat), taps.several[0])
                while ranked:
                    rank = lowest_rank(ranked)
                    ranked = without_lowest_rank(ranked)
                    half = rank & (HALVES - 1)
                    heavy, light = blend_both(rays, splat, half, plain)
                    seen = plus(seen, light)
                    if whole_tile:
                        continue
                    if gate is not None:
                        first_ray, rooms = half * LANES, gate.k * PIXELS + half * LANES
                        behind = lanes_at(state, TRANSMITTANCE + first_ray)
                        known = lanes_at(marks, rooms - PIXELS), lanes_at(marks, rooms)
                        heavy, room = chosen(gate, heavy, behind, known, spot - first_ray)
                        keep_lanes(marks, rooms, room)
                        if not any_above(heavy, no_lanes()):
                            continue
                    elif squared:
                        heavy = times(heavy, heavy)
                    met |= slot_sets[half]
                    if rank < HALVES:
                        slot = alone[half]
                        keep_lanes(sums, slot * LANES, plus(lanes_at(sums, slot * LANES), heavy))
                        continue
                    for tap in range(tap_starts[half], tap_starts[half + 1]):
                        slot = tap_slots[tap]
                        before = lanes_at(sums, slot * LANES)
                        keep_lanes(sums, slot * LANES, plus_product(before, heavy, lanes_at(factors, tap * LANES)))
                total = sum_of_lanes(seen)
                begun = count
                if whole_tile and total > 0:
                    slots[count], weights[count] = slot_count, total
                    count += 1
                while met and is_grid:  # a row of cells, as both sides of the tile read it
                    row = lowest_rank(met) // SIDES
                    sides = met >> np.uint64(SIDES * row)
                    met &= ~(ROW_BITS << np.uint64(SIDES * row))
                    begin = spans[0, 0] if sides & np.uint64(1) else spans[1, 0]
                    end = spans[1, 1] if sides & np.uint64(2) else spans[0, 1]
                    left, right = lanes_at(sums, SIDES * row * LANES), lanes_at(sums, (SIDES * row + 1) * LANES)
                    keep_lanes(sums, SIDES * row * LANES, no_lanes())
                    keep_lanes(sums, (SIDES * row + 1) * LANES, no_lanes())
                    for column in range(begin, end):
                        part = times(left, lanes_at(shares, column * LANES))
                        part = plus_product(part, right, lanes_at(shares, (MAX_LINES + column) * LANES))
                        given = sum_of_lanes(part)
                        if given > 0:
                            slots[count], weights[count] = slot_count + row * columns + column, given
                            count += 1
                while met:
                    slot = lowest_rank(met)
                    met = without_lowest_rank(met)
                    beyond = used if slot == LAST_BIT else slot + 1
                    while slot < beyond:
                        part = _drain(sums, slot * LANES)
                        if part > 0:
                            slots[count], weights[count] = slot_count + slot, part
                            count += 1
                        slot += 1
                if count == begun and total > 0:
                    slots[count], weights[count] = NO_SLOT, 0.0
                    count += 1
                for entry in range(begun, count):
                    places[entry] = items[step]
                    evidence[entry] = total if entry == begun else 0.0
        slot_count += used
    return places[:count], slots[:count], weights[:count], evidence[:count], slot_rows[:slot_count]


@inlined
def _drain(lanes, offset):
    """The sum of eight lanes, which are zero afterwards."""
    total = sum_of_lanes(lanes_at(lanes, offset))
    keep_lanes(lanes, offset, no_lanes())
    return total


@kernel
def _grown(places, slots, weights, evidence, needed):
    size = max(2 * places.shape[0], needed)
    new_places, new_slots = np.empty(size, np.int32), np.empty(size, np.int32)
    new_weights, new_evidence = np.empty(size, np.float32), np.empty(size, np.float32)
    kept = places.shape[0]
    new_places[:kept], new_slots[:kept] = places, slots
    new_weights[:kept], new_evidence[:kept] = weights, evidence
    return new_places, new_slots, new_weights, new_evidence


@kernel
def _grown_rows(slot_rows, needed):
    grown = np.empty((max(2 * slot_rows.shape[0], needed), slot_rows.shape[1]), np.int32)
    grown[: slot_rows.shape[0]] = slot_rows
    return grown
