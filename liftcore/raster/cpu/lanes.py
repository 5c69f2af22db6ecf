"""Eight float32 lanes at a time: the vector instructions of the pixel loop and of the solution.

numba's automatic vectorisation stops at aliasing and wrap-around checks inside the blending loop. These
intrinsics build the same arithmetic as LLVM vectors of eight lanes, which LLVM lowers to AVX2, SSE or NEON.
A tile row of 16 pixels is two such half rows; half row ``16 side + row`` lies left (side 0) or right (1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.extending import intrinsic, register_model

if TYPE_CHECKING:
    from collections.abc import Callable

LANES = 8
ROWS = 16  # of a tile
HALVES = 2 * ROWS  # half rows of a tile

Builder = Any  # llvmlite's IRBuilder; what it infers of its own decorated methods is wrong

FLOAT = ir.FloatType()
INT = ir.IntType(32)
FLOATS = ir.VectorType(FLOAT, LANES)
INTS = ir.VectorType(INT, LANES)
_SHORTS = ir.VectorType(ir.IntType(16), LANES)
_HALVES = ir.VectorType(ir.HalfType(), LANES)
FUSE = ("contract",)  # a*b + c may become one fused instruction
FLOAT_ARRAY = types.Array(types.float32, 1, "C")

# Where a tile's state lies in its one flat float32 array. One array keeps one pointer in a register. The 256 rays
# come half row by half row, those of the left side first.
PIXELS = 256
TRANSMITTANCE = 0  # [256], 0 = the ray is done
WEIGHTS = PIXELS  # [256], of the splat at hand, for who wants them one by one
PLAIN_TRANSMITTANCE = 2 * PIXELS  # [256], of the rays without opacity gain
STARTS = 3 * PIXELS  # [32], of the splat at hand: from its middle in a half row to the first lane, times a root
BASES = STARTS + HALVES  # [16], of the splat at hand: its quadratic form in the middle of a row
TABLE = BASES + ROWS  # constants from here on, as liftcore.raster.cpu.lanes_blend has them


class _Lanes(types.Type):
    """Eight float32 values that compiled code hands about in one register."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


EIGHT = _Lanes()


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    """What numba makes of it: an LLVM vector."""

    def __init__(self, manager: Any, kind: _Lanes) -> None:
        super().__init__(manager, kind, FLOATS)


def compiled(function: Callable) -> Any:
    """An intrinsic; callers leave out the typing context, which no static type can say."""
    return intrinsic(function)


def constant(value: float) -> ir.Constant:
    """``value``, rounded to float32, eight times."""
    return ir.Constant(FLOATS, [float(np.float32(value))] * LANES)


def broadcast(builder: Builder, scalar: ir.Value, kind: ir.VectorType = FLOATS) -> ir.Value:
    """The scalar in every lane of a vector of that kind."""
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(INT, 0))
    mask = ir.Constant(ir.VectorType(INT, kind.count), [0] * kind.count)
    return builder.shuffle_vector(first, undefined, mask)


def pointer_to(context: Any, builder: Builder, kind: types.Array, array: ir.Value, offset: ir.Value) -> ir.Value:
    """Where eight lanes begin, so many elements into an array."""
    data = context.make_array(kind)(context, builder, value=array).data
    return builder.bitcast(builder.gep(data, [offset]), FLOATS.as_pointer())


def load_lanes(builder: Builder, pointer: ir.Value) -> ir.Value:
    """The eight values there, which need not be aligned to more than one of them."""
    return builder.load(pointer, align=4)


def minimum(builder: Builder, left: ir.Value, right: ir.Value) -> ir.Value:
    """The smaller of each pair of lanes, the right one where either is NaN."""
    return builder.select(builder.fcmp_ordered("<", left, right), left, right)


def maximum(builder: Builder, left: ir.Value, right: ir.Value) -> ir.Value:
    """The larger of each pair of lanes, the right one where either is NaN."""
    return builder.select(builder.fcmp_ordered(">", left, right), left, right)


def fused(builder: Builder, left: ir.Value, right: ir.Value, term: ir.Value) -> ir.Value:
    """``left * right + term``, one instruction where the machine has it."""
    return builder.fadd(builder.fmul(left, right, flags=FUSE), term, flags=FUSE)


@compiled
def no_lanes(typingctx):
    """Eight zeros."""

    def codegen(context, builder, signature, args):
        return constant(0.0)

    return EIGHT(), codegen


@compiled
def lanes_at(typingctx, values, offset):
    """``values[offset + i]``."""

    def codegen(context, builder, signature, args):
        return load_lanes(builder, pointer_to(context, builder, signature.args[0], *args))

    return EIGHT(FLOAT_ARRAY, types.intp), codegen


@compiled
def keep_lanes(typingctx, values, offset, lanes):
    """``values[offset + i] = lanes[i]``."""

    def codegen(context, builder, signature, args):
        values, offset, lanes = args
        builder.store(lanes, pointer_to(context, builder, signature.args[0], values, offset), align=4)
        return context.get_dummy_value()

    return types.void(FLOAT_ARRAY, types.intp, EIGHT), codegen


@compiled
def plus(typingctx, left, right):
    """``left[i] + right[i]``."""

    def codegen(context, builder, signature, args):
        return builder.fadd(*args)

    return EIGHT(EIGHT, EIGHT), codegen


@compiled
def times(typingctx, left, right):
    """``left[i] * right[i]``."""

    def codegen(context, builder, signature, args):
        return builder.fmul(*args)

    return EIGHT(EIGHT, EIGHT), codegen


@compiled
def plus_product(typingctx, total, left, right):
    """``total[i] + left[i] * right[i]``."""

    def codegen(context, builder, signature, args):
        total, left, right = args
        return fused(builder, left, right, total)

    return EIGHT(EIGHT, EIGHT, EIGHT), codegen


@compiled
def in_all_lanes(typingctx, value):
    """``value`` eight times."""

    def codegen(context, builder, signature, args):
        return broadcast(builder, args[0])

    return EIGHT(types.float32), codegen


@compiled
def sum_of_lanes(typingctx, lanes):
    """The sum of the eight, in a fixed tree."""

    def codegen(context, builder, signature, args):
        parts = [builder.extract_element(args[0], ir.Constant(INT, lane)) for lane in range(LANES)]
        while len(parts) > 1:
            half = len(parts) // 2
            parts = [builder.fadd(parts[k], parts[k + half]) for k in range(half)]
        return parts[0]

    return types.float32(EIGHT), codegen


def converts(context) -> bool:
    """Whether the processor that is compiled for is an x86 that turns float16 into float32 and back by itself."""
    return "+f16c" in context.codegen().magic_tuple()[2]


_HALF_LIMIT = 0x477FF000  # bits of 65520, from where on float16 is infinite
_HALF_NORMAL = 113 << 23  # bits of the smallest normal float16
_HALF_SHIFT = 126 << 23  # bits of 0.5: a float32 near it has a step of 2^-24, as small float16 values have


@compiled
def keep_halves(typingctx, values, offset, lanes):
    """``values[offset + i] = lanes[i]`` as float16, rounded to nearest, in the bits of u16; no value may be NaN."""

    def codegen(context, builder, signature, args):
        values, offset, lanes = args
        if converts(context):
            rounded = builder.bitcast(builder.fptrunc(lanes, _HALVES), _SHORTS)
        else:
            rounded = _rounded_halves(builder, lanes)
        data = context.make_array(signature.args[0])(context, builder, value=values).data
        place = builder.bitcast(builder.gep(data, [offset]), _SHORTS.as_pointer())
        builder.store(rounded, place, align=2)
        return context.get_dummy_value()

    return types.void(types.Array(types.uint16, 1, "C"), types.intp, EIGHT), codegen


def _rounded_halves(builder: Builder, lanes: ir.Value) -> ir.Value:
    """The bits of float16, in whole numbers: where no processor converts, a missing function would be called."""

    def whole(value: int) -> ir.Constant:
        return ir.Constant(INTS, [value] * LANES)

    bits = builder.bitcast(lanes, INTS)
    size = builder.and_(bits, whole(0x7FFFFFFF))
    odd = builder.and_(builder.lshr(size, whole(13)), whole(1))  # ties go to even
    normal = builder.lshr(builder.add(builder.add(size, whole(((15 - 127) << 23) + 0xFFF)), odd), whole(13))
    shifted = builder.fadd(builder.bitcast(size, FLOATS), constant(0.5))
    small = builder.sub(builder.bitcast(shifted, INTS), whole(_HALF_SHIFT))
    half = builder.select(builder.icmp_signed("<", size, whole(_HALF_NORMAL)), small, normal)
    half = builder.select(builder.icmp_signed(">=", size, whole(_HALF_LIMIT)), whole(0x7C00), half)
    signed = builder.or_(half, builder.lshr(builder.and_(bits, whole(-(1 << 31))), whole(16)))
    return builder.trunc(signed, _SHORTS)


@compiled
def copy_values(typingctx, target, place, source, offset, count):
    """``target[place : place + count] = source[offset : offset + count]`` of two arrays that share no memory."""

    def codegen(context, builder, signature, args):
        target, place, source, offset, count = args
        ends = ((signature.args[0], target, place), (signature.args[2], source, offset))
        to, of = (
            builder.gep(context.make_array(kind)(context, builder, value=array).data, [first])
            for kind, array, first in ends
        )
        cgutils.raw_memcpy(builder, to, of, count, signature.args[0].dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(target, types.intp, target, types.intp, types.intp), codegen


_LINE = 64  # bytes of the processor's cache


def fetch(builder: Builder, pointer: ir.Value, size: int) -> None:
    """Ask for the bytes from a pointer on before they are needed."""
    byte = ir.IntType(8).as_pointer()
    kinds = ir.FunctionType(ir.VoidType(), [byte, INT, INT, INT])
    ask = cgutils.get_or_insert_function(builder.module, kinds, "llvm.prefetch.p0")
    first = builder.bitcast(pointer, byte)
    for ahead in range(0, size, _LINE):
        place = builder.gep(first, [ir.Constant(INT, ahead)])
        builder.call(ask, [place, *(ir.Constant(INT, number) for number in (0, 3, 1))])  # to read, to keep, data


@compiled
def fetch_ahead(typingctx, table, row):
    """Ask for the first 128 bytes of a row of ``table`` [n, m] f64 before they are needed."""
    kind = types.Array(types.float64, 2, "C")

    def codegen(context, builder, signature, args):
        values = context.make_array(signature.args[0])(context, builder, value=args[0])
        width = builder.extract_value(values.strides, 0)
        first = builder.bitcast(values.data, ir.IntType(8).as_pointer())
        fetch(builder, builder.gep(first, [builder.mul(args[1], width)]), 2 * _LINE)
        return context.get_dummy_value()

    return types.void(kind, types.intp), codegen


@compiled
def fetch_place(typingctx, array, place):
    """Ask for the line of the cache where an element of ``array`` [n] lies before it is needed."""

    def codegen(context, builder, signature, args):
        values = context.make_array(signature.args[0])(context, builder, value=args[0])
        fetch(builder, builder.gep(values.data, [args[1]]), 1)
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen
