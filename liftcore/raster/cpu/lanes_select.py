"""Choosing among eight float32 lanes: where one value is above or equal to another, and whether it is anywhere."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from llvmlite import ir
from numba import types

from liftcore.raster.cpu.lanes import EIGHT, FLOATS, INT, INTS, LANES, broadcast, compiled, maximum, minimum

if TYPE_CHECKING:
    from collections.abc import Callable

    from liftcore.raster.cpu.lanes import Builder

_BITS = ir.IntType(LANES)


def _select(builder: Builder, condition: ir.Value, values: ir.Value) -> ir.Value:
    return builder.select(condition, values, ir.Constant(FLOATS, [0.0] * LANES))


def _where(comparison: str) -> tuple[Any, Callable]:
    """What an intrinsic of (left, right, values) gives: the values where the first two compare so, else 0."""

    def codegen(context, builder, signature, args):
        left, right, values = args
        return _select(builder, builder.fcmp_ordered(comparison, left, right), values)

    return EIGHT(EIGHT, EIGHT, EIGHT), codegen


@compiled
def larger(typingctx, left, right):
    """The larger of ``left[i]`` and ``right[i]``."""

    def codegen(context, builder, signature, args):
        return maximum(builder, *args)

    return EIGHT(EIGHT, EIGHT), codegen


@compiled
def smaller(typingctx, left, right):
    """The smaller of ``left[i]`` and ``right[i]``."""

    def codegen(context, builder, signature, args):
        return minimum(builder, *args)

    return EIGHT(EIGHT, EIGHT), codegen


@compiled
def where_above(typingctx, left, right, values):
    """``values[i]`` where ``left[i] > right[i]``, else 0."""
    return _where(">")


@compiled
def where_reached(typingctx, left, right, values):
    """``values[i]`` where ``left[i] >= right[i]``, else 0."""
    return _where(">=")


@compiled
def where_equal(typingctx, left, right, values):
    """``values[i]`` where ``left[i] == right[i]``, else 0."""
    return _where("==")


@compiled
def only_lane(typingctx, values, lane):
    """``values[i]`` of that lane and 0 in all others; eight zeros for a number that is no lane's."""

    def codegen(context, builder, signature, args):
        values, lane = args
        own = ir.Constant(INTS, list(range(LANES)))
        number = broadcast(builder, builder.trunc(lane, INT), INTS)
        return _select(builder, builder.icmp_signed("==", own, number), values)

    return EIGHT(EIGHT, types.intp), codegen


@compiled
def any_above(typingctx, left, right):
    """Whether ``left[i] > right[i]`` for any of the eight."""

    def codegen(context, builder, signature, args):
        above = builder.bitcast(builder.fcmp_ordered(">", *args), _BITS)
        return builder.icmp_unsigned("!=", above, ir.Constant(_BITS, 0))

    return types.boolean(EIGHT, EIGHT), codegen
