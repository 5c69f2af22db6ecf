"""How far the regions of a view agree with what all other views read: the compiled half of the robust step.

A splat's entries follow one another view by view, so those of one view are a run. Sums of the runs, strip by strip of
channels, give the splat's sum over all views and, without their own, r of each view; then each entry's row of e is
multiplied by the r of its view while strip and sums are in the cache.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from liftcore.jit import kernel
from liftcore.raster.cpu.lanes import LANES, in_all_lanes, keep_lanes, lanes_at, no_lanes, plus, plus_product
from liftcore.raster.cpu.lanes_rows import AHEAD, WIDE, add_row_products
from liftcore.solve.weight_tables import floats_at, rows_between, table_at
from liftcore.solve.weighted_sums import LONG, MOST_ROWS, Entries, block_end, sum_strip

BLOCK_ENTRIES = 1 << 10  # judged strip by strip: the sums of their runs stay in the cache


class Judged(NamedTuple):
    """What is found of gathered entries, over some channels."""

    products: np.ndarray  # [n] f32 at least, ``e_m . r`` of each
    squares: np.ndarray  # [n] f32 at least, ``|r|^2`` of each run, at its first entry


@kernel
def judge_share(share, entries, strips, judged):
    """Judge the entries of a share of a chunk over the channels of the strips.

    Args:
        share: (first, last) of the chunk's splats. entries: theirs. strips: Strips, of e. judged: written.
    """
    starts, last = entries.starts[: share[1] + 1], share[0]
    while last < share[1]:
        first, last = last, block_end(starts, last, BLOCK_ENTRIES)
        begin, end = starts[first], starts[last]
        rows = entries.rows[begin : end + AHEAD]
        runs, firsts = runs_of(starts[first : last + 1] - begin, rows, strips.bases)
        own = Entries(runs, rows, entries.shares[begin:end])
        sums, squares = np.empty((runs.shape[0] - 1, WIDE), np.float32), np.zeros(runs.shape[0] - 1)
        products = np.zeros(end - begin)
        for strip in range(strips.number):
            sum_strip(own, strips, strip, sums)
            leave_out_own(sums, firsts)
            add_products(own, strips, strip, sums, (products, squares))
        judged.products[begin:end] = products
        for run in range(squares.shape[0]):
            judged.squares[begin + runs[run]] = squares[run]


@kernel
def runs_of(starts, rows, bases):
    """Where runs begin among a block's entries [R + 1] i64, and the first run of each splat [B + 1] i64.

    Args:
        starts: [B + 1] i64, of the splats' entries, from 0. rows: i32, which of the strips' rows each entry reads.
        bases: [V] i64, where a view's columns begin among those rows.
    """
    firsts, runs = np.zeros(starts.shape[0], np.int64), np.empty(starts[-1] + 1, np.int64)
    number = 0
    for splat in range(starts.shape[0] - 1):
        firsts[splat], end = number, 0
        view = 0
        for k in range(starts[splat], starts[splat + 1]):
            if rows[k] >= end:
                while view < bases.shape[0] and bases[view] <= rows[k]:
                    view += 1
                end = bases[view] if view < bases.shape[0] else MOST_ROWS + 1
                runs[number] = k
                number += 1
    firsts[-1], runs[number] = number, starts[-1]
    return runs[: number + 1], firsts


@kernel
def leave_out_own(sums, firsts):
    """The sums [R, WIDE] f32 of a splat's runs become r: what all its others add up to, in float32, by parts of LONG.

    Args:
        firsts: [B + 1] i64, the first run of each splat.
    """
    values, minus = sums.reshape(-1), in_all_lanes(np.float32(-1))
    for splat in range(firsts.shape[0] - 1):
        first, last = firsts[splat], firsts[splat + 1]
        for channel in range(0, WIDE, LANES):
            total = no_lanes()
            for begin in range(first, last, LONG):
                part = no_lanes()
                for run in range(begin, min(begin + LONG, last)):
                    part = plus(part, lanes_at(values, run * WIDE + channel))
                total = plus(total, part)
            for run in range(first, last):
                others = plus_product(total, minus, lanes_at(values, run * WIDE + channel))
                keep_lanes(values, run * WIDE + channel, others)


@kernel
def add_products(entries, strips, strip, others, found):
    """Add ``e_m . r`` of a block's entries and ``|r|^2`` of its runs over the channels of a strip.

    Args:
        entries: Entries whose starts are those of the runs. others: [R, WIDE] f32, r of the runs.
        found: (products [n] f64, squares [R] f64).
    """
    products, squares = found
    values, span, sparse = others.reshape(-1), (WIDE, strip * strips.rows * WIDE), (entries.rows, products)
    for run in range(others.shape[0]):
        own = (entries.starts[run], entries.starts[run + 1])
        squares[run] += add_row_products(values, run * WIDE, strips.values, own, sparse, span)


@kernel
def scatter_judged(splats, cursors, tables, targets, judged):
    """Add what was found of the entries of the splats ``splats[0]..splats[1]`` to where each view keeps it.

    Args:
        cursors: [n] i64, where the entries of each of the splats begin; they move to their ends.
        tables: (addresses, rows) of WeightTables, of the views that the entries were gathered from; no row is empty.
        targets: [V, 2] i64, where products [nnz] f32 and squares [rows] f32 of each view lie.
    """
    addresses, rows = tables
    first = splats[0]
    for view in range(addresses.shape[0]):
        ids, indptr, _, weights = table_at(addresses[view], rows[view])
        products, squares = floats_at(targets[view, 0], weights.shape[0]), floats_at(targets[view, 1], ids.shape[0])
        begin, end = rows_between(ids, splats)
        for row in range(begin, end):
            at = cursors[ids[row] - first]
            squares[row] += judged.squares[at]
            for k in range(indptr[row], indptr[row + 1]):
                products[k] += judged.products[at]
                at += 1
            cursors[ids[row] - first] = at


@kernel
def to_cosines(indptr, squares, least, weights, products):
    """Products of a view become the cosines c; gives ``(W . c, sum of W)``.

    Args:
        indptr: [n + 1] i64. squares: [n] f32. least: of a length that has a direction.
        weights: [nnz] f32. products: [nnz] f32, changed.
    """
    agreeing, everything = 0.0, 0.0
    for row in range(squares.shape[0]):
        length = np.sqrt(np.float64(squares[row]))
        for k in range(indptr[row], indptr[row + 1]):
            cosine = min(max(products[k] / length, 0.0), 1.0) if length > least else 0.0
            products[k] = cosine
            agreeing += weights[k] * cosine
            everything += weights[k]
    return agreeing, everything


@kernel
def to_weights(indptr, shares, usual, weights, cosines):
    """Cosines of a view become ``W ((1 - p) c_m + p c)``; gives their row sums [n] f64.

    Args:
        indptr: [n + 1] i64. shares: [n] f64, p. usual: c.
        weights: [nnz] f32, W. cosines: [nnz] f32, changed.
    """
    totals = np.zeros(shares.shape[0])
    for row in range(shares.shape[0]):
        own = min(max(shares[row], 0.0), 1.0)
        for k in range(indptr[row], indptr[row + 1]):
            cosines[k] = weights[k] * ((1.0 - own) * cosines[k] + own * usual)
            totals[row] += cosines[k]
    return totals


@kernel
def to_old_sums(indptr, gains, first, weights):
    """Weights of a view times the gain [n] f64 of their row; where that is zero, the first ones again."""
    for row in range(gains.shape[0]):
        for k in range(indptr[row], indptr[row + 1]):
            weights[k] = weights[k] * gains[row] if gains[row] > 0 else first[k]
