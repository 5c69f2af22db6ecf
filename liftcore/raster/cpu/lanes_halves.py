"""Sets of a tile's half rows, a bit each in one word: which of them a footprint reaches, which still have light.

A tile is two columns of 16 half rows of eight pixels; half row ``16 side + row`` (side 0 left, 1 right) is that bit
of a set. Whole sets come from a few vector instructions, so the walk meets no branch but the end of its loop over the
bits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from llvmlite import ir
from numba import types

from liftcore.raster.cpu.lanes import (
    BASES,
    FLOAT,
    FLOAT_ARRAY,
    FLOATS,
    HALVES,
    INTS,
    LANES,
    ROWS,
    STARTS,
    broadcast,
    compiled,
    constant,
    load_lanes,
    maximum,
    minimum,
    pointer_to,
)

if TYPE_CHECKING:
    from liftcore.raster.cpu.lanes import Builder

_SET = ir.IntType(HALVES)
_WHOLE = ir.IntType(32 * LANES)
_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)  # a value for each of eight rows
_SLACK = 1.0 + 2.0**-19  # of the reach: a set lacks no half row for the rounding of float32


def _all(builder: Builder, value: ir.Value) -> ir.Value:
    return broadcast(builder, value, _DOUBLES)


@compiled
def ellipse_halves(typingctx, state, centre, slope, form, reach):
    """The half rows with a lane where ``(root (x - mx - slope dy))^2 + ky dy^2 <= reach``, ``dy = row - my``.

    The footprint's ``centre = (mx, my)`` counts from the tile's first pixel centre, ``form = (root, ky)``. Lanes
    are met between their centres too: a set may hold a half row that has no weight, and lacks none that has. Left in
    ``state``: how far right of the footprint's middle each half row begins, times root, and ``ky dy^2`` of each row.

    The middles are made in float64: along a needle they are small differences of large numbers.
    """
    pair = types.UniTuple(types.float64, 2)

    def codegen(context, builder, signature, args):
        state, centre, slope, form, reach = args
        mx, my = (builder.extract_value(centre, k) for k in range(2))
        slack = builder.fmul(reach, ir.Constant(ir.DoubleType(), _SLACK))
        root, ky, top, room = (
            broadcast(builder, builder.fptrunc(value, FLOAT))
            for value in (*(builder.extract_value(form, k) for k in range(2)), my, slack)
        )
        width, zero = builder.fmul(root, constant(LANES - 1.0)), constant(0.0)

        def keep(first: int, values: ir.Value) -> None:
            place = ir.Constant(ir.IntType(64), first)
            builder.store(values, pointer_to(context, builder, signature.args[0], state, place), align=4)

        halves = ir.Constant(_SET, 0)
        for first in range(0, ROWS, LANES):
            numbers = [float(row) for row in range(first, first + LANES)]
            below = builder.fsub(_all(builder, my), ir.Constant(_DOUBLES, numbers))
            across = builder.fsub(builder.fmul(_all(builder, slope), below), _all(builder, mx))
            left = builder.fptrunc(across, FLOATS)
            dy = builder.fsub(ir.Constant(FLOATS, numbers), top)
            base = builder.fmul(builder.fmul(ky, dy), dy)
            keep(BASES + first, base)
            rest = builder.fsub(room, base)
            for side in range(2):
                start = builder.fmul(builder.fadd(left, constant(LANES)) if side else left, root)
                keep(STARTS + side * ROWS + first, start)
                # Right of the middle counts the first lane, left of it the last, and around it the middle itself.
                right_of = maximum(builder, start, zero)
                left_of = minimum(builder, builder.fadd(start, width), zero)
                away = builder.fadd(right_of, left_of)
                met = builder.fcmp_ordered("<=", builder.fmul(away, away), rest)
                bits = builder.zext(builder.bitcast(met, ir.IntType(LANES)), _SET)
                halves = builder.or_(halves, builder.shl(bits, ir.Constant(_SET, side * ROWS + first)))
        return halves

    return types.uint32(FLOAT_ARRAY, pair, types.float64, pair, types.float64), codegen


@compiled
def lit_halves(typingctx, state, first):
    """The half rows with a lane above zero among the 256 values ``state[first:]``."""

    def codegen(context, builder, signature, args):
        state, first = args
        word = ir.Constant(_SET, 0)
        zero, none = constant(0.0), ir.Constant(ir.IntType(LANES), 0)
        for half in range(HALVES):
            place = builder.add(first, ir.Constant(first.type, half * LANES))
            values = load_lanes(builder, pointer_to(context, builder, signature.args[0], state, place))
            lanes = builder.bitcast(builder.fcmp_ordered(">", values, zero), none.type)
            bit = builder.zext(builder.icmp_unsigned("!=", lanes, none), _SET)
            word = builder.or_(word, builder.shl(bit, ir.Constant(_SET, half)))
        return word

    return types.uint32(FLOAT_ARRAY, types.intp), codegen


@compiled
def all_are(typingctx, values, offset, value):
    """Whether the eight i32 from ``values[offset]`` on are all ``value``."""

    def codegen(context, builder, signature, args):
        values, offset, value = args
        data = context.make_array(signature.args[0])(context, builder, value=values).data
        place = builder.bitcast(builder.gep(data, [offset]), INTS.as_pointer())
        different = builder.xor(builder.load(place, align=4), broadcast(builder, value, INTS))
        return builder.icmp_unsigned("==", builder.bitcast(different, _WHOLE), ir.Constant(_WHOLE, 0))

    return types.boolean(types.Array(types.int32, 1, "C"), types.intp, types.int32), codegen


@compiled
def lowest_half(typingctx, halves):
    """The number of the first half row of a set that is not empty."""

    def codegen(context, builder, signature, args):
        found = builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))
        return builder.zext(found, context.get_value_type(types.intp))

    return types.intp(types.uint32), codegen


@compiled
def without_lowest(typingctx, halves):
    """The set without its first half row."""

    def codegen(context, builder, signature, args):
        return builder.and_(args[0], builder.sub(args[0], ir.Constant(_SET, 1)))

    return types.uint32(types.uint32), codegen


@compiled
def both(typingctx, left, right):
    """The half rows of both sets."""

    def codegen(context, builder, signature, args):
        return builder.and_(*args)

    return types.uint32(types.uint32, types.uint32), codegen


@compiled
def either(typingctx, left, right):
    """The half rows of any of two sets."""

    def codegen(context, builder, signature, args):
        return builder.or_(*args)

    return types.uint32(types.uint32, types.uint32), codegen


_RANKS = ir.IntType(2 * HALVES)


@compiled
def ranked_halves(typingctx, halves, late):
    """The half rows of a set in two ranks: bit ``h`` for those outside ``late``, bit ``32 + h`` for those in it."""

    def codegen(context, builder, signature, args):
        halves, late = args
        first = builder.zext(builder.and_(halves, builder.not_(late)), _RANKS)
        last = builder.zext(builder.and_(halves, late), _RANKS)
        return builder.or_(first, builder.shl(last, ir.Constant(_RANKS, HALVES)))

    return types.uint64(types.uint32, types.uint32), codegen


@compiled
def lowest_rank(typingctx, ranked):
    """The number of the first bit of a ranked set that is not empty."""

    def codegen(context, builder, signature, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.intp(types.uint64), codegen


@compiled
def without_lowest_rank(typingctx, ranked):
    """The ranked set without its first bit."""

    def codegen(context, builder, signature, args):
        return builder.and_(args[0], builder.sub(args[0], ir.Constant(_RANKS, 1)))

    return types.uint64(types.uint64), codegen
