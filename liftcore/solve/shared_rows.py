"""Sums over rows of W, of four neighbouring splats at a time, so that vectors of shared regions are loaded once.

Four consecutive splats on a space-filling curve have nearly the same regions. So the regions of a **group** of GROUP
rows are united, each with a share per splat, zero if the splat has no such entry, and a vector loaded from a table is
added to the sums of all four, as loading takes longer than adding. A zero share adds zero, so the result of a splat
is bitwise independent of the others.

float32 adds LONG terms one by one, and rows of more entries are summed in pieces. A row of more than MOST_COMPARED
entries is compared as a group of its own, in pieces.
"""

import numpy as np
import torch
from torch import Tensor

from liftcore.raster.cpu.simd import (
    WIDE,
    WIDE_LANES,
    first_lanes,
    loader_of,
    minus,
    plus,
    plus_product,
    plus_times,
    store_lanes,
    sum_of_lanes,
    zeros_of,
)
from liftcore.runtime.jit import kernel

GROUP = 4  # rows; the code below is unrolled over them
LONG = 256  # terms of a sum that float32 adds one by one
MOST_COMPARED = 1024  # entries of a row that is compared at once: four levels of 256 views
LANES = WIDE_LANES  # channels of a vector
NO_REGION = np.int32(2**31 - 1)
no_lanes, lanes_at = zeros_of(WIDE), loader_of(WIDE)


def new_table(rows: int, columns: int) -> Tensor:
    """Return an uninitialised table [rows, columns] f32, whose storage has LANES zeros more (`flat_table`)."""
    size = rows * columns
    flat = torch.empty(size + LANES, dtype=torch.float32)
    flat[size:] = 0.0
    return flat[:size].view(rows, columns)


def flat_table(table: Tensor) -> np.ndarray:
    """Return the rows of a table [M, C] f32, flattened, with LANES finite numbers more.

    A copy, unless its storage is of `new_table`: vectors are loaded LANES at a time, also beyond the last row.
    """
    size, storage = table.numel() + LANES, table.untyped_storage()
    if table.is_contiguous() and table.storage_offset() == 0 and storage.nbytes() == 4 * size:
        return table.as_strided((size,), (1,)).numpy()
    return torch.cat([table.reshape(-1), table.new_zeros(LANES)]).numpy()


@kernel
def group_end(rows, first, indptr):
    """Return the end of the group to compare that begins at row number ``first``."""
    last = first + 1
    if indptr[rows[first] + 1] - indptr[rows[first]] > MOST_COMPARED:
        return last
    while last < min(first + GROUP, rows.size) and indptr[rows[last] + 1] - indptr[rows[last]] <= MOST_COMPARED:
        last += 1
    return last


@kernel
def count_pieces(rows, indptr, length):
    """Return the number of pieces of so many entries that the longest of some rows has, at least one."""
    pieces = np.int64(1)
    for row in rows:
        pieces = max(pieces, (indptr[row + 1] - indptr[row] + length - 1) // length)
    return pieces


@kernel
def unite_rows(rows, first, last, piece, length, indptr, region, weight, scales, regions, shares, entries):
    """Write the regions of a group, ascending, with the share and the entry of each row; return their number.

    Args:
        rows: of W; those numbered ``first..last`` are the group.
        piece: number of a piece of ``length`` entries of each row.
        scales: [GROUP] f64, 1 / the row's sum of weights.
        regions: [GROUP length] i32. shares: [GROUP GROUP length] f32, zero for none.
        entries: i64 likewise, -1 for none.
    """
    k, ends, heads = np.zeros(GROUP, np.int64), np.zeros(GROUP, np.int64), np.full(GROUP, NO_REGION, np.int32)
    for j in range(last - first):
        row = rows[first + j]
        k[j] = indptr[row] + piece * length
        ends[j] = min(indptr[row + 1], k[j] + length)
        if k[j] < ends[j]:
            heads[j] = region[k[j]]
    count = 0
    while True:
        least = min(heads[0], heads[1], heads[2], heads[3])
        if least == NO_REGION:
            return count
        regions[count] = least
        for j in range(GROUP):
            place = GROUP * count + j
            if heads[j] == least:
                n = k[j]
                shares[place], entries[place] = weight[n] * scales[j], n
                k[j] = n + 1
                heads[j] = region[n + 1] if n + 1 < ends[j] else NO_REGION
            else:
                shares[place], entries[place] = 0.0, -1
        count += 1


@kernel
def sum_rows(rows, indptr, region, weight, inverse, table, width, sums):
    """Compute ``sum_k W_jk inverse_j table[region_k]`` of some rows.

    Args:
        rows: [n] i64, of W. inverse: [P] f64.
        table: `flat_table` [M, width]. sums: [n, width] f32.
    """
    regions, shares = np.empty(GROUP * LONG, np.int32), np.empty(GROUP * GROUP * LONG, np.float32)
    entries = np.empty(GROUP * GROUP * LONG, np.int64)
    scales, stride = np.zeros(GROUP), width + LANES
    group_sums, piece_totals = np.empty(GROUP * stride, np.float32), np.empty((GROUP, width))
    first = 0
    while first < rows.size:
        last = min(first + GROUP, rows.size)
        pieces = count_pieces(rows[first:last], indptr, LONG)
        piece_totals[:] = 0.0
        for j in range(last - first):
            scales[j] = inverse[rows[first + j]]
        for piece in range(pieces):
            arrays = indptr, region, weight, scales
            count = unite_rows(rows, first, last, piece, LONG, *arrays, regions, shares, entries)
            for c in range(0, width, LANES):
                a = b = d = e = no_lanes()
                for n in range(count):
                    vector = lanes_at(table, np.int64(regions[n]) * width + c)
                    a = plus_times(a, shares[GROUP * n], vector)
                    b = plus_times(b, shares[GROUP * n + 1], vector)
                    d = plus_times(d, shares[GROUP * n + 2], vector)
                    e = plus_times(e, shares[GROUP * n + 3], vector)
                store_lanes(group_sums, c, a)
                store_lanes(group_sums, stride + c, b)
                store_lanes(group_sums, 2 * stride + c, d)
                store_lanes(group_sums, 3 * stride + c, e)
            if pieces > 1:
                for j in range(last - first):
                    for c in range(width):
                        piece_totals[j, c] += group_sums[j * stride + c]
        for j in range(last - first):
            for c in range(width):
                sums[first + j, c] = piece_totals[j, c] if pieces > 1 else group_sums[j * stride + c]
        first = last


@kernel
def compare_rows(rows, indptr, region, weight, view, table, width, products, squares):
    """Add ``e_m . r_jv`` and ``|r_jv|^2`` of the entries of some rows, over the channels of a table of e.

    r_jv is the sum of all views minus that of view v, except for a view of over half of the weight: there the
    difference of two float32 sums would be mostly rounding error, and the other views are summed directly.

    Args:
        rows: [n] i64, of W. view: [M] i64, of each region.
        table: `flat_table` [M, width]. products, squares: [nnz] f32.
    """
    regions, shares = np.empty(GROUP * MOST_COMPARED, np.int32), np.empty(GROUP * GROUP * MOST_COMPARED, np.float32)
    entries = np.empty(GROUP * GROUP * MOST_COMPARED, np.int64)
    view_limit = np.int64(GROUP * MOST_COMPARED)
    for row in rows:
        view_limit = max(view_limit, indptr[row + 1] - indptr[row])
    view_limit = min(view_limit, np.int64(view[-1]) + 1)
    stride = (width + LANES - 1) // LANES * LANES
    size = GROUP * stride
    # Sums of each view, of all views, of all but a heavy one, and zeros, each of the rows of a group.
    sums, other_views = np.zeros((view_limit + 3) * size, np.float32), np.empty(size, np.float32)
    total_at, others_at, zeros_at = view_limit * size, (view_limit + 1) * size, (view_limit + 2) * size
    minuends, subtrahends = np.empty(GROUP, np.int64), np.empty(GROUP, np.int64)
    view_shares, scales = np.empty(view_limit * GROUP), np.zeros(GROUP)
    heavy, square = np.empty(GROUP, np.int64), np.empty(GROUP, np.float32)
    first = 0
    while first < rows.size:
        last = group_end(rows, first, indptr)
        pieces = count_pieces(rows[first:last], indptr, MOST_COMPARED)  # several for a long row
        for j in range(last - first):
            total = 0.0
            for k in range(indptr[rows[first + j]], indptr[rows[first + j] + 1]):
                total += weight[k]
            scales[j] = 1.0 / total if total > 0.0 else 0.0
        arrays = indptr, region, weight, scales, regions, shares, entries
        count = unite_rows(rows, first, last, 0, MOST_COMPARED, *arrays)
        number, v = np.int64(-1), -1
        sums[total_at : total_at + size] = 0.0
        for piece in range(pieces):  # sums of each view
            if piece > 0:
                count = unite_rows(rows, first, last, piece, MOST_COMPARED, *arrays)
            begin = 0
            while begin < count:
                new, end = view[regions[begin]] != v, begin
                if new:
                    v, number = view[regions[begin]], number + 1
                    view_shares[GROUP * number : GROUP * (number + 1)] = 0.0
                while end < count and view[regions[end]] == v:
                    for j in range(GROUP):
                        view_shares[GROUP * number + j] += shares[GROUP * end + j]
                    end += 1
                for c in range(0, width, LANES):
                    p = q = s = t = no_lanes()
                    for n in range(begin, end):
                        vector = lanes_at(table, np.int64(regions[n]) * width + c)
                        p = plus_times(p, shares[GROUP * n], vector)
                        q = plus_times(q, shares[GROUP * n + 1], vector)
                        s = plus_times(s, shares[GROUP * n + 2], vector)
                        t = plus_times(t, shares[GROUP * n + 3], vector)
                    if c + LANES > width:  # the next row of the table
                        p, q = first_lanes(p, width - c), first_lanes(q, width - c)
                        s, t = first_lanes(s, width - c), first_lanes(t, width - c)
                    at = number * size + c
                    if not new:
                        p, q = plus(p, lanes_at(sums, at)), plus(q, lanes_at(sums, at + stride))
                        s, t = plus(s, lanes_at(sums, at + 2 * stride)), plus(t, lanes_at(sums, at + 3 * stride))
                    store_lanes(sums, at, p)
                    store_lanes(sums, at + stride, q)
                    store_lanes(sums, at + 2 * stride, s)
                    store_lanes(sums, at + 3 * stride, t)
                    if pieces == 1:  # the sums are complete, and in registers
                        store_lanes(sums, total_at + c, plus(lanes_at(sums, total_at + c), p))
                        at = total_at + stride + c
                        store_lanes(sums, at, plus(lanes_at(sums, at), q))
                        at += stride
                        store_lanes(sums, at, plus(lanes_at(sums, at), s))
                        at += stride
                        store_lanes(sums, at, plus(lanes_at(sums, at), t))
                begin = end
        for c in range(0, size if pieces > 1 else 0, LANES):
            p = no_lanes()
            for n in range(number + 1):
                p = plus(p, lanes_at(sums, n * size + c))
            store_lanes(sums, total_at + c, p)
        for j in range(GROUP):
            heavy[j] = -1
            for n in range(number + 1):
                if view_shares[GROUP * n + j] > 0.5:
                    heavy[j] = n
            if heavy[j] >= 0:
                for c in range(j * stride, (j + 1) * stride, LANES):
                    p = no_lanes()
                    for n in range(number + 1):
                        if n != heavy[j]:
                            p = plus(p, lanes_at(sums, n * size + c))
                    store_lanes(sums, others_at + c, p)
        number, v = np.int64(-1), -1
        for piece in range(pieces):  # each region against the other views
            if pieces > 1:
                count = unite_rows(rows, first, last, piece, MOST_COMPARED, *arrays)
            for n in range(count):
                p = q = s = t = no_lanes()
                if view[regions[n]] != v:
                    v, number = view[regions[n]], number + 1
                    for j in range(GROUP):
                        is_heavy = heavy[j] == number
                        minuends[j] = (others_at if is_heavy else total_at) + j * stride
                        subtrahends[j] = (zeros_at if is_heavy else number * size) + j * stride
                    b = d = e = f = no_lanes()
                    for c in range(0, width, LANES):
                        vector = lanes_at(table, np.int64(regions[n]) * width + c)
                        others = minus(lanes_at(sums, minuends[0] + c), lanes_at(sums, subtrahends[0] + c))
                        p, b = plus_product(p, vector, others), plus_product(b, others, others)
                        store_lanes(other_views, c, others)
                        others = minus(lanes_at(sums, minuends[1] + c), lanes_at(sums, subtrahends[1] + c))
                        q, d = plus_product(q, vector, others), plus_product(d, others, others)
                        store_lanes(other_views, stride + c, others)
                        others = minus(lanes_at(sums, minuends[2] + c), lanes_at(sums, subtrahends[2] + c))
                        s, e = plus_product(s, vector, others), plus_product(e, others, others)
                        store_lanes(other_views, 2 * stride + c, others)
                        others = minus(lanes_at(sums, minuends[3] + c), lanes_at(sums, subtrahends[3] + c))
                        t, f = plus_product(t, vector, others), plus_product(f, others, others)
                        store_lanes(other_views, 3 * stride + c, others)
                    square[0], square[1] = sum_of_lanes(b), sum_of_lanes(d)
                    square[2], square[3] = sum_of_lanes(e), sum_of_lanes(f)
                else:
                    for c in range(0, width, LANES):
                        vector = lanes_at(table, np.int64(regions[n]) * width + c)
                        p = plus_product(p, vector, lanes_at(other_views, c))
                        q = plus_product(q, vector, lanes_at(other_views, stride + c))
                        s = plus_product(s, vector, lanes_at(other_views, 2 * stride + c))
                        t = plus_product(t, vector, lanes_at(other_views, 3 * stride + c))
                at = GROUP * n
                if entries[at] >= 0:
                    products[entries[at]] += sum_of_lanes(p)
                    squares[entries[at]] += square[0]
                if entries[at + 1] >= 0:
                    products[entries[at + 1]] += sum_of_lanes(q)
                    squares[entries[at + 1]] += square[1]
                if entries[at + 2] >= 0:
                    products[entries[at + 2]] += sum_of_lanes(s)
                    squares[entries[at + 2]] += square[2]
                if entries[at + 3] >= 0:
                    products[entries[at + 3]] += sum_of_lanes(t)
                    squares[entries[at + 3]] += square[3]
        first = last
