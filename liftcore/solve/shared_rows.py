"""Sums over rows of W, of four neighbours at a time: they belong to the same regions, whose vectors are read once.

Four splats that follow one another along a curve through the scene name nearly the same regions. So the regions of a
**group** of GROUP rows are united, each with a share a splat, zero where the splat has no such entry, and a vector
that is read from a table is added to the sums of all four: to read it takes longer than to add it. A zero share adds
a zero, so what a splat gets depends on no other one, bit for bit.

float32 adds up LONG terms one by one. A row of more entries is a group of its own, which comes in pieces.
"""

from collections.abc import Sequence

import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.core.datamodel import models
from numba.extending import register_model
from torch import Tensor

from liftcore.raster.cpu.simd import compiled
from liftcore.runtime.jit import kernel

GROUP = 4  # rows; the code below names each
LONG = 256  # terms of a sum that float32 adds up one by one
LANES = 32  # channels that one instruction of LLVM's takes, whatever the machine's vectors hold
NO_REGION = np.int32(2**31 - 1)


def new_table(rows: int, columns: int, place: torch.device) -> Tensor:
    """A table [rows, columns] f32 of anything, whose storage goes on for LANES zeros more (`flat_table`)."""
    size = rows * columns
    flat = torch.empty(size + LANES, dtype=torch.float32, device=place)
    flat[size:] = 0.0
    return flat[:size].view(rows, columns)


def flat_table(table: Tensor) -> np.ndarray:
    """The rows of a table [M, C] f32 on the CPU, one after the other, and LANES finite numbers more.

    A copy, unless `new_table` made its storage: vectors are read LANES at a time, beyond the last row too.
    """
    size, storage = table.numel() + LANES, table.untyped_storage()
    if table.is_contiguous() and table.storage_offset() == 0 and storage.nbytes() == 4 * size:
        return table.as_strided((size,), (1,)).numpy()
    return torch.cat([table.reshape(-1), table.new_zeros(LANES)]).numpy()


# ---- LANES numbers at a time


class _Lanes(types.Type):
    """LANES float32 values, which LLVM cuts into the registers of the machine."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes{LANES}")


ALL = _Lanes()
FLOATS = ir.VectorType(ir.FloatType(), LANES)
FLOAT_ARRAY = types.Array(types.float32, 1, "C")
_FUSE = ("contract",)  # a*b + c may become one fused instruction


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    """What numba makes of them: an LLVM vector."""

    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, FLOATS)


def _pointer(context, builder, kind, array, offset):
    data = context.make_array(kind)(context, builder, value=array).data
    return builder.bitcast(builder.gep(data, [offset]), FLOATS.as_pointer())


def _numbers(values) -> ir.Constant:
    return ir.Constant(ir.VectorType(ir.IntType(32), len(values)), list(values))


def _fused(builder, left, right, total):
    return builder.fadd(builder.fmul(left, right, flags=_FUSE), total, flags=_FUSE)


@compiled
def no_lanes(typingctx):
    """Zeros."""
    return ALL(), lambda context, builder, signature, args: ir.Constant(FLOATS, [0.0] * LANES)


@compiled
def lanes_at(typingctx, values, offset):
    """``values[offset + i]``."""

    def codegen(context, builder, signature, args):
        return builder.load(_pointer(context, builder, signature.args[0], *args), align=4)

    return ALL(FLOAT_ARRAY, types.intp), codegen


@compiled
def keep_lanes(typingctx, values, offset, lanes):
    """``values[offset + i] = lanes[i]``."""

    def codegen(context, builder, signature, args):
        builder.store(args[2], _pointer(context, builder, signature.args[0], *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(FLOAT_ARRAY, types.intp, ALL), codegen


@compiled
def plus_times(typingctx, total, factor, lanes):
    """``total[i] + factor lanes[i]``, for one factor."""

    def codegen(context, builder, signature, args):
        nothing = ir.Constant(FLOATS, ir.Undefined)
        first = builder.insert_element(nothing, args[1], ir.Constant(ir.IntType(32), 0))
        return _fused(builder, builder.shuffle_vector(first, nothing, _numbers([0] * LANES)), args[2], args[0])

    return ALL(ALL, types.float32, ALL), codegen


@compiled
def plus_product(typingctx, total, left, right):
    """``total[i] + left[i] right[i]``."""
    return ALL(ALL, ALL, ALL), lambda context, builder, signature, args: _fused(builder, args[1], args[2], args[0])


@compiled
def plus(typingctx, left, right):
    """``left[i] + right[i]``."""
    return ALL(ALL, ALL), lambda context, builder, signature, args: builder.fadd(*args)


@compiled
def minus(typingctx, left, right):
    """``left[i] - right[i]``."""
    return ALL(ALL, ALL), lambda context, builder, signature, args: builder.fsub(*args)


@compiled
def first_lanes(typingctx, lanes, count):
    """``lanes[i]`` below that number, and zeros."""

    def codegen(context, builder, signature, args):
        numbers = ir.VectorType(ir.IntType(32), LANES)
        nothing = ir.Constant(numbers, ir.Undefined)
        count = builder.trunc(args[1], ir.IntType(32))
        first = builder.insert_element(nothing, count, ir.Constant(ir.IntType(32), 0))
        counts = builder.shuffle_vector(first, nothing, _numbers([0] * LANES))
        return builder.select(
            builder.icmp_signed("<", _numbers(range(LANES)), counts), args[0], ir.Constant(FLOATS, [0.0] * LANES)
        )

    return ALL(ALL, types.intp), codegen


@compiled
def sum_of_lanes(typingctx, lanes):
    """The sum of all, in a fixed tree."""

    def codegen(context, builder, signature, args):
        found, size = args[0], LANES
        while size > 1:
            size //= 2
            nothing = ir.Constant(found.type, ir.Undefined)
            halves = [builder.shuffle_vector(found, nothing, _numbers(range(at, at + size))) for at in (0, size)]
            found = builder.fadd(*halves)
        return builder.extract_element(found, ir.Constant(ir.IntType(32), 0))

    return types.float32(ALL), codegen


# ---- groups of rows


@kernel
def group_end(rows, first, indptr):
    """The number after the last row of the group that begins at row number ``first``."""
    last = first + 1
    if indptr[rows[first] + 1] - indptr[rows[first]] > LONG:
        return last
    while last < min(first + GROUP, rows.size) and indptr[rows[last] + 1] - indptr[rows[last]] <= LONG:
        last += 1
    return last


@kernel
def unite_rows(
    rows, first, last, piece, indptr, region, weight, factors, level, inverse, regions, shares, entries
):  # fmt: skip
    """Write the regions of a group, ascending, with the share and the entry of each row, and give their number.

    Args:
        rows: of W, of which those numbered ``first..last`` are the group. piece: its entries of LONG, of a row alone.
        factors: [nnz] f32 of entries, or [0] for none. level: [M] i32 of regions, or [0] for one level.
        inverse: [levels GROUP] f64, what makes shares of a row's weights of a level.
        regions: [GROUP LONG] i32. shares: [GROUP GROUP LONG] f32, zero for none. entries: i64 likewise, -1 for none.
    """
    k, ends, heads = np.zeros(GROUP, np.int64), np.zeros(GROUP, np.int64), np.full(GROUP, NO_REGION, np.int32)
    for j in range(last - first):
        row = rows[first + j]
        k[j] = indptr[row] + piece * LONG
        ends[j] = min(indptr[row + 1], k[j] + LONG)
        if k[j] < ends[j]:
            heads[j] = region[k[j]]
    count = 0
    while True:
        least = min(heads[0], heads[1], heads[2], heads[3])
        if least == NO_REGION:
            return count
        regions[count] = least
        own = GROUP * level[least] if level.size > 0 else 0
        for j in range(GROUP):
            place = GROUP * count + j
            if heads[j] == least:
                n = k[j]
                factor = factors[n] if factors.size > 0 else np.float32(1.0)
                shares[place], entries[place] = weight[n] * factor * inverse[own + j], n
                k[j] = n + 1
                heads[j] = region[n + 1] if n + 1 < ends[j] else NO_REGION
            else:
                shares[place], entries[place] = 0.0, -1
        count += 1


@kernel
def order_by_level(regions, count, level, levels, starts, order):
    """The united regions of each level, ascending: ``order[starts[a]..starts[a + 1]]`` are their numbers."""
    starts[:] = 0
    for n in range(count):
        starts[level[regions[n]] + 1] += 1
    for a in range(levels):
        starts[a + 1] += starts[a]
    at = starts[:levels].copy()
    for n in range(count):
        a = level[regions[n]]
        order[at[a]] = n
        at[a] += 1


@kernel
def sum_rows(rows, indptr, region, weight, inverse, lengths, table, width, sums):
    """``sum_k W_jk inverse_j table[region_k]`` of some rows.

    Args:
        rows: [n] i64, of W. inverse: [P] f64. lengths: [M] f32, what the vector of a region is multiplied with too;
            [0] for none.
        table: `flat_table` [M, width]. sums: [n, width] f32.
    """
    regions, shares = np.empty(GROUP * LONG, np.int32), np.empty(GROUP * GROUP * LONG, np.float32)
    entries, none = np.empty(GROUP * GROUP * LONG, np.int64), np.empty(0, np.float32)
    scales, no_level = np.zeros(GROUP), np.empty(0, np.int32)
    stride = width + LANES
    found, several = np.empty(GROUP * stride, np.float32), np.empty(width)
    first = 0
    while first < rows.size:
        last = group_end(rows, first, indptr)
        pieces = (
            max((indptr[rows[first] + 1] - indptr[rows[first]] + LONG - 1) // LONG, 1) if last == first + 1 else 1
        )
        several[:] = 0.0
        for j in range(last - first):
            scales[j] = inverse[rows[first + j]]
        for piece in range(pieces):
            arrays = indptr, region, weight, none, no_level, scales
            count = unite_rows(rows, first, last, piece, *arrays, regions, shares, entries)
            if lengths.size > 0:
                for place in range(GROUP * count):
                    shares[place] *= lengths[regions[place // GROUP]]
            for c in range(0, width, LANES):
                a = b = d = e = no_lanes()
                for n in range(count):
                    vector = lanes_at(table, np.int64(regions[n]) * width + c)
                    a = plus_times(a, shares[GROUP * n], vector)
                    b = plus_times(b, shares[GROUP * n + 1], vector)
                    d = plus_times(d, shares[GROUP * n + 2], vector)
                    e = plus_times(e, shares[GROUP * n + 3], vector)
                keep_lanes(found, c, a)
                keep_lanes(found, stride + c, b)
                keep_lanes(found, 2 * stride + c, d)
                keep_lanes(found, 3 * stride + c, e)
            if pieces > 1:
                for c in range(width):
                    several[c] += found[c]
        if pieces > 1:
            for c in range(width):
                sums[first, c] = several[c]
        else:
            for j in range(last - first):
                for c in range(width):
                    sums[first + j, c] = found[j * stride + c]
        first = last


def compare_rows(
    rows: np.ndarray,
    W: Sequence[np.ndarray],
    table: np.ndarray,
    width: int,
    products: np.ndarray,
    squares: np.ndarray,
) -> None:
    """Add ``e_m . r_jv`` and ``|r_jv|^2`` of the entries of some rows, over the channels of a table of e.

    Each level is compared by itself, by shares of what it weighs at a splat. r_jv is the sum of all views less that
    of view v, but for a view of over half of that weight: there a difference of two float32 sums would be mostly
    rounding, and the sums of the others are added up.

    Args:
        rows: [n] i64, of W.
        W: its indptr, region and weight; factors [nnz] f32 of entries, or [0] for none; the view [M] i64 and the
            level [M] i32 of each region.
        table: `flat_table` [M, width]. products, squares: [nnz] f32.
    """
    add_products(*[rows, *W, table, width, products, squares])


@kernel
def add_products(rows, indptr, region, weight, factors, view, level, table, width, products, squares):
    """`compare_rows`."""
    regions, shares = np.empty(GROUP * LONG, np.int32), np.empty(GROUP * GROUP * LONG, np.float32)
    entries = np.empty(GROUP * GROUP * LONG, np.int64)
    most, levels = np.int64(GROUP * LONG), np.int64(0)
    for row in rows:
        most = max(most, indptr[row + 1] - indptr[row])
        for k in range(indptr[row], indptr[row + 1]):
            levels = max(levels, level[region[k]] + 1)
    most = min(most, np.int64(view[-1]) + 1)
    stride = (width + LANES - 1) // LANES * LANES
    size = GROUP * stride
    said, whole, others = np.empty(most * size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    rest, own = np.empty(size, np.float32), np.empty(most * GROUP)
    heavy, square = np.empty(GROUP, np.int64), np.empty(GROUP, np.float32)
    inverse, starts, order = (
        np.empty(levels * GROUP),
        np.empty(levels + 1, np.int64),
        np.empty(GROUP * LONG, np.int64),
    )
    first = 0
    while first < rows.size:
        last = group_end(rows, first, indptr)
        pieces = max(-(-(indptr[rows[first] + 1] - indptr[rows[first]]) // LONG), 1)  # more than one of a row alone
        inverse[:] = 0.0
        for j in range(last - first):
            for k in range(indptr[rows[first + j]], indptr[rows[first + j] + 1]):
                inverse[GROUP * level[region[k]] + j] += weight[k]
        for n in range(inverse.size):
            inverse[n] = 1.0 / inverse[n] if inverse[n] > 0.0 else 0.0
        arrays = indptr, region, weight, factors, level, inverse, regions, shares, entries
        if pieces == 1:
            order_by_level(regions, unite_rows(rows, first, last, 0, *arrays), level, levels, starts, order)
        for a in range(levels):
            number, v = np.int64(-1), -1
            for piece in range(pieces):  # what each view says, and all
                if pieces > 1:
                    count = unite_rows(rows, first, last, piece, *arrays)
                    order_by_level(regions, count, level, levels, starts, order)
                begin = starts[a]
                while begin < starts[a + 1]:
                    new, end = view[regions[order[begin]]] != v, begin
                    if new:
                        v, number = view[regions[order[begin]]], number + 1
                        own[GROUP * number : GROUP * (number + 1)] = 0.0
                    while end < starts[a + 1] and view[regions[order[end]]] == v:
                        for j in range(GROUP):
                            own[GROUP * number + j] += shares[GROUP * order[end] + j]
                        end += 1
                    for c in range(0, width, LANES):
                        p = q = s = t = no_lanes()
                        for i in range(begin, end):
                            n = order[i]
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
                            p, q = plus(p, lanes_at(said, at)), plus(q, lanes_at(said, at + stride))
                            s, t = plus(s, lanes_at(said, at + 2 * stride)), plus(t, lanes_at(said, at + 3 * stride))
                        keep_lanes(said, at, p)
                        keep_lanes(said, at + stride, q)
                        keep_lanes(said, at + 2 * stride, s)
                        keep_lanes(said, at + 3 * stride, t)
                    begin = end
            for c in range(0, size, LANES):
                p = no_lanes()
                for n in range(number + 1):
                    p = plus(p, lanes_at(said, n * size + c))
                keep_lanes(whole, c, p)
            for j in range(GROUP):
                heavy[j] = -1
                for n in range(number + 1):
                    if own[GROUP * n + j] > 0.5:
                        heavy[j] = n
                if heavy[j] >= 0:
                    for c in range(j * stride, (j + 1) * stride, LANES):
                        p = no_lanes()
                        for n in range(number + 1):
                            if n != heavy[j]:
                                p = plus(p, lanes_at(said, n * size + c))
                        keep_lanes(rest, c, p)
            number, v = np.int64(-1), -1
            for piece in range(pieces):  # what the others say, against each region
                if pieces > 1:
                    count = unite_rows(rows, first, last, piece, *arrays)
                    order_by_level(regions, count, level, levels, starts, order)
                for i in range(starts[a], starts[a + 1]):
                    n = order[i]
                    if view[regions[n]] != v:
                        v, number = view[regions[n]], number + 1
                        for j in range(GROUP):
                            p = no_lanes()
                            for c in range(j * stride, (j + 1) * stride, LANES):
                                if number == heavy[j]:
                                    q = lanes_at(rest, c)
                                else:
                                    q = minus(lanes_at(whole, c), lanes_at(said, number * size + c))
                                keep_lanes(others, c, q)
                                p = plus_product(p, q, q)
                            square[j] = sum_of_lanes(p)
                    p = q = s = t = no_lanes()
                    for c in range(0, width, LANES):
                        vector = lanes_at(table, np.int64(regions[n]) * width + c)
                        p = plus_product(p, vector, lanes_at(others, c))
                        q = plus_product(q, vector, lanes_at(others, stride + c))
                        s = plus_product(s, vector, lanes_at(others, 2 * stride + c))
                        t = plus_product(t, vector, lanes_at(others, 3 * stride + c))
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
