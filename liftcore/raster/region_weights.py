"""``W = A'^T S`` of one view: the lift's only look at pixels.

Every tile writes entries (record, slot, weight, evidence) into its share's buffer: what a splat gave to the pixels
of one slot, and on its first entry of the tile the sum of its plain weights over all rays. A counting sort gathers
the entries by splat; only then are slots expanded to the codebook rows of all levels and summed, in float64.
"""

from __future__ import annotations

import numpy as np

from liftcore.jit import inlined, kernel
from liftcore.lanes import (
    HALVES,
    LANES,
    WEIGHTS,
    keep_lanes,
    lanes_at,
    no_lanes,
    plus,
    plus_product,
    sum_of_lanes,
    times,
)
from liftcore.lanes_halves import lowest_rank, ranked_halves, without_lowest_rank
from liftcore.raster.constants import TILE
from liftcore.raster.readings import MAX_SLOTS, NO_SLOT, new_taps, read_tile
from liftcore.raster.selection import CENTRAL, LARGEST, NO_SPOT, choose, new_marks, rank_tile, spot_of
from liftcore.raster.walk import CHECK_EVERY, blend, blend_both, look, meets, new_rays, next_splat, start_rays


@kernel
def weigh_tiles(first, last, frame, reading, choice, with_plain):
    """Entries of tiles ``first..last``.

    Args:
        frame: Frame. reading: Reading. choice: Choice, what counts as a weight.
        with_plain: whether the evidence needs rays of its own, without the opacity gain.

    Returns:
        places [n] i32 (records), slots [n] i32 (-1 none), weights [n] f32, evidence [n] f32, near to far tile by
        tile; and slot_rows [s, levels] i32, the codebook rows of a slot (-1 none).
    """
    rays = new_rays(frame)
    state = rays.state
    taps = new_taps(reading.levels)
    sums = np.zeros(MAX_SLOTS * LANES, np.float32)
    items, starts = frame.items, frame.starts
    tap_starts, tap_slots, alone, factors = taps.starts, taps.slots, taps.alone, taps.factors
    gated = choice.gated
    squared = not gated and choice.power == 2
    marks = new_marks(choice)
    least, room = marks.least, marks.room
    spot = NO_SPOT
    reuse = (
        choice.power == 1 and not with_plain and not gated
    )  # then a slot that all pixels read holds just the evidence
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
        if choice.kind == LARGEST:
            rank_tile(rays, frame, tile, marks, choice.k)
        start_rays(rays, frame, tile)
        read_tile(taps, reading, frame, tile)
        used, whole_tile = taps.sizes[0], reuse and taps.sizes[1] == 1
        if slot_count + used > slot_rows.shape[0]:
            slot_rows = _grown_rows(slot_rows, slot_count + used)
        slot_rows[slot_count : slot_count + used] = taps.slot_rows[:used]
        for step in range(starts[tile], starts[tile + 1]):
            if (step - starts[tile]) % CHECK_EVERY == 0 and not look(rays, with_plain):
                break
            place = items[step]
            splat = next_splat(frame, tile, step, x0, y0)
            if choice.kind == CENTRAL:
                spot = spot_of(splat)
            low, high, seen = MAX_SLOTS, -1, no_lanes()
            # Half rows of several slots come last: a branch that changes once a splat is foreseen.
            ranked = ranked_halves(meets(rays, splat), taps.several[0])
            while ranked:
                rank = lowest_rank(ranked)
                ranked = without_lowest_rank(ranked)
                half = rank % HALVES
                if with_plain:
                    heavy, plain = blend_both(rays, splat, half)
                    seen = plus(seen, plain)
                else:
                    heavy = blend(rays, splat, half)
                    seen = plus(seen, heavy)
                if whole_tile:
                    continue
                if gated:
                    keep_lanes(state, WEIGHTS + half * LANES, heavy)
                    if not choose(choice, state, least, room, half, spot):
                        continue
                    heavy = lanes_at(state, WEIGHTS + half * LANES)
                elif squared:
                    heavy = times(heavy, heavy)
                if rank < HALVES:
                    slot = alone[half]
                    low, high = min(low, slot), max(high, slot)
                    keep_lanes(sums, slot * LANES, plus(lanes_at(sums, slot * LANES), heavy))
                    continue
                for tap in range(tap_starts[half], tap_starts[half + 1]):
                    slot = tap_slots[tap]
                    low, high = min(low, slot), max(high, slot)
                    before = lanes_at(sums, slot * LANES)
                    keep_lanes(sums, slot * LANES, plus_product(before, heavy, lanes_at(factors, tap * LANES)))
            total = sum_of_lanes(seen)
            if count + used + 1 > places.shape[0]:
                places, slots, weights, evidence = _grown(places, slots, weights, evidence, count + used + 1)
            begun = count
            if whole_tile and total > 0:
                slots[count], weights[count] = slot_count, total
                count += 1
            for slot in range(low, high + 1):
                part = _drain(sums, slot * LANES)
                if part > 0:
                    slots[count], weights[count] = slot_count + slot, part
                    count += 1
            if count == begun and total > 0:
                slots[count], weights[count] = NO_SLOT, 0.0
                count += 1
            for entry in range(begun, count):
                places[entry] = place
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
