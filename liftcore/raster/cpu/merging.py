"""From tile entries to one sparse row a splat.

Ranges of splats are merged independently: each range counts its entries, gathers them by splat in the order of the
tiles, expands slots to codebook rows and sums in float64. What a range gives depends on nothing but the entries.
"""

from __future__ import annotations

import numpy as np

from liftcore.jit import kernel
from liftcore.raster.cpu.lanes import fetch_place
from liftcore.raster.cpu.lanes_halves import lowest_rank, without_lowest_rank

WORD = 64  # columns of a set that a word holds
NEAR, FAR = 12, 24  # entries ahead whose places in memory are asked for, and whose cursors, by which they are known


@kernel
def count_entries(places, counts):
    """Add to ``counts`` [P] i32 how many entries each record has."""
    for place in places:
        counts[place] += np.int32(1)


@kernel
def gather_entries(first, last, entries, slot_base, cursors, gathered):
    """Scatter the entries of the records ``first..last`` to their places (cursors move on).

    ``entries = (places, slots, weights, evidence)`` of one tile share, its slots counted from ``slot_base``.
    ``gathered = (words, numbers, totals)``: one table [n, 2] of slot and weight, so that an entry is written at one
    place in memory, seen as i32 and as f32; and the evidence of each record, [last - first] f64, which grows.
    """
    places, slots, weights, evidence = entries
    words, numbers, totals = gathered
    flat, end = words.reshape(-1), places.shape[0] - 1
    for i in range(places.shape[0]):
        far, near, place = places[min(i + FAR, end)], places[min(i + NEAR, end)], places[i]
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
            totals[place - first] += evidence[i]


@kernel
def merge_range(starts, gathered, slot_rows, codebook_rows, ids):
    """Expand, sum and sort the entries of a range of records.

    Args:
        starts: [n + 1] i64, each record's entries in ``gathered``, as ``gather_entries`` writes it.
        slot_rows: [S, levels] i32. codebook_rows: M. ids: [n] i32, the splat of each record.

    Returns:
        splats [r] i32, lengths [r] i64, columns [nnz] i32, weights [nnz] f32, and the splats [m] i32 and sums [m] f32
        of the evidence.
    """
    words, numbers, totals = gathered
    levels = slot_rows.shape[1]
    records = ids.shape[0]
    sums = np.zeros(codebook_rows)
    # The columns that a record has: a set is in order as it is, where rows of fine cells had to be sorted.
    touched = np.zeros(codebook_rows // WORD + 1, np.uint64)
    splats, lengths = np.empty(records, np.int32), np.empty(records, np.int64)
    met, evidence = np.empty(records, np.int32), np.empty(records, np.float32)
    most = words.shape[0] * levels  # known before: arrays that may be replaced in a loop are counted at each use
    columns, weights = np.empty(most, np.int32), np.empty(most, np.float32)
    rows = count = met_count = 0
    for record in range(records):
        total, begun, low, high = totals[record], count, touched.shape[0], -1
        for i in range(starts[record], starts[record + 1]):
            slot = words[i, 0]
            if slot < 0:
                continue
            for level in range(levels):
                column = slot_rows[slot, level]
                if column >= 0:
                    word = column // WORD
                    touched[word] |= np.uint64(1) << np.uint64(column % WORD)
                    low, high = min(low, word), max(high, word)
                    sums[column] += numbers[i, 1]
        if total > 0:
            met[met_count], evidence[met_count] = ids[record], total
            met_count += 1
        for word in range(low, high + 1):
            left, touched[word] = touched[word], 0
            while left:
                column = word * WORD + lowest_rank(left)
                left = without_lowest_rank(left)
                columns[count], weights[count], sums[column] = column, sums[column], 0
                count += 1
        if count > begun:
            splats[rows], lengths[rows] = ids[record], count - begun
            rows += 1
    return splats[:rows], lengths[:rows], columns[:count], weights[:count], met[:met_count], evidence[:met_count]
