"""``W E`` of a block of splats over all views, strip by strip of channels.

Entries are gathered from W of every view first, splat by splat, so that a splat's sum over all its views stays in
registers. The channels of all codebooks lie in strips: a strip's piece of a row is a line of the processor's cache or
a few, and the pieces that a block of splats reads stay in a core's own cache while it is summed.

Sums are float32 over a few hundred terms at most. Longer ones, of a splat behind a million regions or of thousands of
views, are sums of such parts in float64: added one by one, ten million equal terms would be wrong in their first
digit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from liftcore.errors import Unavailable
from liftcore.jit import kernel
from liftcore.raster.cpu.lanes import fetch_place
from liftcore.raster.cpu.lanes_rows import WIDE, add_weighted_row, add_weighted_row_twice
from liftcore.solve.weight_tables import rows_between, table_at

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from torch import Tensor

LONG = 256  # entries of a splat that float32 adds up one by one
PLACES = 12  # rows of W between asking for their places among the gathered entries and writing there
LEAST_SHARE, SHARE = 128, 2048  # splats a call of compiled code
SHARES = 8  # of each thread, so that none waits long for another
STRIP_BYTES = 1 << 28  # of the strips of all codebooks at a time, unless a single one has more
MOST_ROWS = 2**31 - 1  # of all codebooks: an entry of a block names its row in four bytes
_LINE = 64  # bytes of the processor's cache


class Strips(NamedTuple):
    """Some channels of what all columns of W stand for (`solve.columns`), a row each, WIDE channels a strip."""

    values: np.ndarray  # [strips * rows * WIDE] f32, or the bits of f16 as u16; zeros beyond the last channel
    bases: np.ndarray  # [V] i64, where a view's columns begin among those of all
    rows: int  # columns of W of all views together
    number: int  # of strips


class Entries(NamedTuple):
    """W of a block, splat by splat, each in the order of the views."""

    starts: np.ndarray  # [B + 1] i64
    rows: np.ndarray  # [n + AHEAD] i32 at least, of the strips; beyond n some that are asked for and not read
    shares: np.ndarray  # [n] f32 at least, weights times the splat's scale


def strips_of(parts: Iterable[Tensor], counts: Sequence[int], channels: int, dtype: torch.dtype) -> Strips:
    """Strips of the same channels of what the columns of all views stand for.

    Args:
        parts: [T, channels] of every view, taken one after the other.
        counts: T of every view.
        dtype: f16 or f32.

    Raises:
        Unavailable: all codebooks together have more rows than an entry can name.
    """
    bases, rows, count = first_columns(counts), sum(counts), -(-channels // WIDE)
    if rows > MOST_ROWS:
        raise Unavailable(
            "features",
            expected=f"at most {MOST_ROWS} rows of codebooks",
            got=f"{rows} in {len(counts)} views",
            hint="lift fewer views, or smaller maps",
        )
    values = _in_lines(count * rows * WIDE, dtype)
    strips = values.view(count, rows, WIDE)
    for base, part in zip(bases.tolist(), parts, strict=True):
        for strip in range(count):
            own = part[:, strip * WIDE : (strip + 1) * WIDE]
            strips[strip, base : base + own.shape[0], : own.shape[1]] = own
    bits = values.view(torch.uint16) if dtype == torch.float16 else values
    return Strips(bits.numpy(), bases, rows, count)


def first_columns(counts: Sequence[int]) -> np.ndarray:
    """[V] i64: where the columns of each view begin among those of all."""
    return np.concatenate([[0], np.cumsum(counts)])[:-1].astype(np.int64)


def _in_lines(count: int, dtype: torch.dtype) -> Tensor:
    """Zeros [count] that begin with a line of the cache: numpy's, which asks for large pages."""
    spare = _LINE // dtype.itemsize
    room = torch.from_numpy(np.zeros(count + spare, np.float16 if dtype == torch.float16 else np.float32))
    first = -room.data_ptr() % _LINE // dtype.itemsize
    return room[first : first + count]


def channel_slices(rows: int, channels: int, size: int) -> list[tuple[int, int]]:
    """Channels whose strips lie in memory at a time, of so many rows in all and ``size`` bytes a number."""
    step = max(WIDE, STRIP_BYTES // (size * max(rows, 1)) // WIDE * WIDE)
    return [(begin, min(begin + step, channels)) for begin in range(0, channels, step)]


def strip_bytes(rows: int, channels: int, size: int) -> int:
    """Of the strips that lie in memory at a time."""
    begin, end = channel_slices(rows, channels, size)[0]
    return rows * size * (-(-(end - begin) // WIDE) * WIDE)


def splat_shares(first: int, last: int, threads: int) -> list[tuple[int, int]]:
    """The splats of each call of compiled code."""
    step = max(LEAST_SHARE, min(SHARE, -(-(last - first) // (SHARES * threads))))
    return [(begin, min(begin + step, last)) for begin in range(first, last, step)]


@kernel
def entries_before(splats, tables):
    """[n + 1] i64: how many entries the first splats of a share have, over all views.

    Args:
        splats: (first, last). tables: (addresses, rows) of WeightTables.
    """
    addresses, rows = tables
    first, last = splats
    starts = np.zeros(last - first + 1, np.int64)
    for view in range(addresses.shape[0]):
        ids, indptr, _, _ = table_at(addresses[view], rows[view])
        row = np.searchsorted(ids, first)
        while row < ids.shape[0] and ids[row] < last:
            starts[ids[row] - first + 1] += indptr[row + 1] - indptr[row]
            row += 1
    return np.cumsum(starts)


@kernel
def block_end(starts, begin, most):
    """The end of the block that begins at splat ``begin``: at most so many entries, or one splat."""
    end = begin + 1
    while end < starts.shape[0] - 1 and starts[end + 1] - starts[begin] <= most:
        end += 1
    return end


@kernel
def gather_entries(splats, cursors, tables, columns, entries):
    """Put the entries of the splats ``splats[0]..splats[1]`` of all views to their places.

    Args:
        cursors: [n] i64, where the entries of each of the splats begin; they move to their ends.
        columns: (bases [V] i64, where a view's columns begin among those of all; scale [P] f64).
        entries: Entries whose rows and shares are written.
    """
    addresses, rows = tables
    bases, scale = columns
    first = splats[0]
    for view in range(addresses.shape[0]):
        ids, indptr, own, weights = table_at(addresses[view], rows[view])
        begin, end = rows_between(ids, splats)
        for row in range(begin, end):
            splat = ids[row]
            if row + PLACES < end:
                soon = cursors[ids[row + PLACES] - first]
                fetch_place(entries.rows, soon)
                fetch_place(entries.shares, soon)
            at = cursors[splat - first]
            for k in range(indptr[row], indptr[row + 1]):
                entries.rows[at] = bases[view] + own[k]
                entries.shares[at] = weights[k] * scale[splat]
                at += 1
            cursors[splat - first] = at


@kernel
def sum_strip(entries, strips, strip, sums):
    """``sums[b] = sum_k shares[k] E[rows[k]]`` over the channels of a strip, of every splat of a block.

    Args:
        sums: [B, WIDE] f32, written.
    """
    values, target, sparse = strips.values, sums.reshape(-1), (entries.rows, entries.shares)
    span = (WIDE, strip * strips.rows * WIDE)
    sums[:] = 0
    for splat in range(sums.shape[0]):
        first, last = entries.starts[splat], entries.starts[splat + 1]
        if last - first > LONG:
            _sum_parts(target[splat * WIDE : splat * WIDE + WIDE], values, (first, last), sparse, span)
        elif first < last:
            add_weighted_row(target, splat * WIDE, values, (first, last), sparse, span)


@kernel
def sum_strip_twice(entries, strips, strip, factors, sums):
    """``sum_strip``, and ``others[b] = sum_k shares[k] factors[rows[k]] E[rows[k]]``, of which each row is read once.

    Args:
        factors: [rows] f32. sums: (sums, others), [B, WIDE] f32, written.
    """
    values, targets = strips.values, (sums[0].reshape(-1), sums[1].reshape(-1))
    span, sparse = (WIDE, strip * strips.rows * WIDE), (entries.rows, entries.shares, factors)
    sums[0][:], sums[1][:] = 0, 0
    for splat in range(sums[0].shape[0]):
        first, last, place = entries.starts[splat], entries.starts[splat + 1], splat * WIDE
        if last - first > LONG:
            own = (targets[0][place : place + WIDE], targets[1][place : place + WIDE])
            _sum_parts_twice(own, values, (first, last), sparse, span)
        elif first < last:
            add_weighted_row_twice(targets, place, values, (first, last), sparse, span)


@kernel
def _sum_parts(target, values, entries, sparse, span):
    """One splat's sum, of many entries: the sums of LONG of them at a time are added in float64."""
    part, total = np.empty(WIDE, np.float32), np.zeros(WIDE)
    for first in range(entries[0], entries[1], LONG):
        part[:] = 0
        add_weighted_row(part, 0, values, (first, min(first + LONG, entries[1])), sparse, span)
        total += part
    target[:] = total


@kernel
def _sum_parts_twice(targets, values, entries, sparse, span):
    """``_sum_parts`` of both sums."""
    parts = (np.empty(WIDE, np.float32), np.empty(WIDE, np.float32))
    totals = (np.zeros(WIDE), np.zeros(WIDE))
    for first in range(entries[0], entries[1], LONG):
        parts[0][:], parts[1][:] = 0, 0
        add_weighted_row_twice(parts, 0, values, (first, min(first + LONG, entries[1])), sparse, span)
        totals[0][:] += parts[0]
        totals[1][:] += parts[1]
    targets[0][:], targets[1][:] = totals[0], totals[1]
