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
from liftcore.runtime.jit import inlined, kernel

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
                heads[j] = region[k[j]] if k[j] < ends[j] else NO_REGION
            else:
                shares[place], entries[place] = 0.0, -1
        count += 1


# The same channels of the rows of a group are a tuple of vectors of lanes, each row ``stride`` after the one before.


@inlined
def rows_at(values, at, stride):
    """Load the lanes from ``values[at]`` on of each row."""
    return (
        lanes_at(values, at),
        lanes_at(values, at + stride),
        lanes_at(values, at + 2 * stride),
        lanes_at(values, at + 3 * stride),
    )


@inlined
def store_rows(values, at, stride, rows):
    """Store the lanes of each row from ``values[at]`` on."""
    store_lanes(values, at, rows[0])
    store_lanes(values, at + stride, rows[1])
    store_lanes(values, at + 2 * stride, rows[2])
    store_lanes(values, at + 3 * stride, rows[3])


@inlined
def plus_rows(a, b):
    """Add the lanes of each row."""
    return plus(a[0], b[0]), plus(a[1], b[1]), plus(a[2], b[2]), plus(a[3], b[3])


@inlined
def plus_products(a, vector, b):
    """Return ``a + vector b`` of each row."""
    return (
        plus_product(a[0], vector, b[0]),
        plus_product(a[1], vector, b[1]),
        plus_product(a[2], vector, b[2]),
        plus_product(a[3], vector, b[3]),
    )


@inlined
def first_lanes_of(rows, count):
    """Return the first lanes of each row, zero beyond."""
    return (
        first_lanes(rows[0], count),
        first_lanes(rows[1], count),
        first_lanes(rows[2], count),
        first_lanes(rows[3], count),
    )


@inlined
def sum_vectors(first, last, regions, shares, table, width, c):
    """Sum the lanes from channel c on of some regions of a group, each times the share of a row."""
    p = q = s = t = no_lanes()
    for n in range(first, last):
        vector = lanes_at(table, np.int64(regions[n]) * width + c)
        p = plus_times(p, shares[GROUP * n], vector)
        q = plus_times(q, shares[GROUP * n + 1], vector)
        s = plus_times(s, shares[GROUP * n + 2], vector)
        t = plus_times(t, shares[GROUP * n + 3], vector)
    return p, q, s, t


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
            arrays = indptr, region, weight, scales, regions, shares, entries
            count = unite_rows(rows, first, last, piece, LONG, *arrays)
            for c in range(0, width, LANES):
                store_rows(group_sums, c, stride, sum_vectors(0, count, regions, shares, table, width, c))
            if pieces > 1:
                for j in range(last - first):
                    for c in range(width):
                        piece_totals[j, c] += group_sums[j * stride + c]
        for j in range(last - first):
            for c in range(width):
                sums[first + j, c] = piece_totals[j, c] if pieces > 1 else group_sums[j * stride + c]
        first = last


@kernel
def compare_rows(rows, table, width, indptr, region, weight, view, products, squares):
    """Add ``e_m . r_jv`` and ``|r_jv|^2`` of the entries of some rows, over the channels of a table of e.

    r_jv is the sum of all views minus that of view v, except for a view of over half of the weight: there the
    difference of two float32 sums would be mostly rounding error, and the other views are summed directly.

    Args:
        rows: [n] i64, of W. table: `flat_table` [M, width].
        view: [M] i64, of each region. products, squares: [nnz] f32.
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
    view_shares, scales = np.empty(view_limit * GROUP), np.zeros(GROUP)
    heavy, square, product = np.empty(GROUP, np.int64), np.empty(GROUP, np.float32), np.empty(GROUP, np.float32)
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
                    view_sums = sum_vectors(begin, end, regions, shares, table, width, c)
                    if c + LANES > width:  # the next row of the table
                        view_sums = first_lanes_of(view_sums, width - c)
                    at = number * size + c
                    if not new:
                        view_sums = plus_rows(view_sums, rows_at(sums, at, stride))
                    store_rows(sums, at, stride, view_sums)
                    if pieces == 1:  # the sums are complete, and in registers
                        at = total_at + c
                        store_rows(sums, at, stride, plus_rows(rows_at(sums, at, stride), view_sums))
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
                if view[regions[n]] != v:
                    v, number = view[regions[n]], number + 1
                    for j in range(GROUP):
                        is_heavy = heavy[j] == number
                        minuend = (others_at if is_heavy else total_at) + j * stride
                        subtrahend = (zeros_at if is_heavy else number * size) + j * stride
                        p = no_lanes()
                        for c in range(0, width, LANES):
                            others = minus(lanes_at(sums, minuend + c), lanes_at(sums, subtrahend + c))
                            p = plus_product(p, others, others)
                            store_lanes(other_views, j * stride + c, others)
                        square[j] = sum_of_lanes(p)
                dots = no_lanes(), no_lanes(), no_lanes(), no_lanes()
                for c in range(0, width, LANES):
                    vector = lanes_at(table, np.int64(regions[n]) * width + c)
                    dots = plus_products(dots, vector, rows_at(other_views, c, stride))
                product[0], product[1] = sum_of_lanes(dots[0]), sum_of_lanes(dots[1])
                product[2], product[3] = sum_of_lanes(dots[2]), sum_of_lanes(dots[3])
                for j in range(GROUP):
                    entry = entries[GROUP * n + j]
                    if entry >= 0:
                        products[entry] += product[j]
                        squares[entry] += square[j]
        first = last
