"""Sets of a tile's half rows, a bit each in one word: which of them a footprint reaches, which still have light.

A tile is two columns of 16 half rows of eight pixels; half row ``16 side + row`` (side 0 left, 1 right) is that bit
of a set. Whole sets come from a few vector instructions, so the walk meets no branch but the end of its loop over the
bits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from llvmlite import ir
from numba import types

from liftcore.lanes import (
    BASES,
    FLOAT_ARRAY,
    HALVES,
    INT,
    LANES,
    ROWS,
    STARTS,
    compiled,
    constant,
    load_lanes,
    pointer_to,
)

if TYPE_CHECKING:
    from liftcore.lanes import Builder

_SET = ir.IntType(HALVES)
_DOUBLES = ir.VectorType(ir.DoubleType(), ROWS)  # a value for each row
_SINGLES = ir.VectorType(ir.FloatType(), ROWS)


def _each(values: list[float]) -> ir.Constant:
    return ir.Constant(_DOUBLES, values)


def _all(builder: Builder, value: ir.Value) -> ir.Value:
    first = builder.insert_element(ir.Constant(_DOUBLES, ir.Undefined), value, ir.Constant(INT, 0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(INT, ROWS), [0] * ROWS))


@compiled
def ellipse_halves(typingctx, state, centre, slope, curvature, reach):
    """The half rows with a lane where ``kx (x - mx - slope dy)^2 + ky dy^2 <= reach``, ``dy = row - my``.

    The footprint's ``centre = (mx, my)`` counts from the tile's first pixel centre, ``curvature = (kx, ky)``. Lanes
    are met between their centres too: a set may hold a half row that has no weight, and lacks none that has. Left in
    ``state``: how far right of the footprint's middle each half row begins, and ``ky dy^2`` of each row.
    """
    pair = types.UniTuple(types.float64, 2)

    def codegen(context, builder, signature, args):
        state, centre, slope, curvature, reach = args
        mx, my = (_all(builder, builder.extract_value(centre, k)) for k in range(2))
        kx, ky = (_all(builder, builder.extract_value(curvature, k)) for k in range(2))

        def keep(first: int, values: ir.Value) -> None:
            place = ir.Constant(ir.IntType(64), first)
            pointer = pointer_to(context, builder, signature.args[0], state, place)
            rounded = builder.fptrunc(values, _SINGLES)
            builder.store(rounded, builder.bitcast(pointer, _SINGLES.as_pointer()), align=4)

        dy = builder.fsub(_each([float(row) for row in range(ROWS)]), my)
        middle = builder.fadd(mx, builder.fmul(_all(builder, slope), dy))
        base = builder.fmul(ky, builder.fmul(dy, dy))
        keep(BASES, base)
        room = builder.fsub(_all(builder, reach), base)
        halves = ir.Constant(_SET, 0)
        for side in range(2):
            first, last = (_each([side * LANES + lane] * ROWS) for lane in (0.0, LANES - 1.0))
            start = builder.fsub(first, middle)
            keep(STARTS + side * ROWS, start)
            before = builder.fcmp_ordered(">", start, _each([0.0] * ROWS))
            end = builder.fsub(last, middle)
            beyond = builder.fcmp_ordered("<", end, _each([0.0] * ROWS))
            away = builder.select(before, start, builder.select(beyond, end, _each([0.0] * ROWS)))
            met = builder.fcmp_ordered("<=", builder.fmul(kx, builder.fmul(away, away)), room)
            bits = builder.zext(builder.bitcast(met, ir.IntType(ROWS)), _SET)
            halves = builder.or_(halves, builder.shl(bits, ir.Constant(_SET, side * ROWS)))
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
