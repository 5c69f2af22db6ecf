"""Eight float32 lanes at a time: the vector instructions of the pixel loop and of the solution.

numba's automatic vectorisation stops at aliasing and wrap-around checks inside the blending loop. These
intrinsics build the same arithmetic as LLVM vectors of eight lanes, which LLVM lowers to AVX2, SSE or NEON.
A tile row of 16 pixels is two such half rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

if TYPE_CHECKING:
    from collections.abc import Callable

LANES = 8

Builder = Any  # llvmlite's IRBuilder; what it infers of its own decorated methods is wrong

FLOAT = ir.FloatType()
INT = ir.IntType(32)
FLOATS = ir.VectorType(FLOAT, LANES)
INTS = ir.VectorType(INT, LANES)
FUSE = ("contract",)  # a*b + c may become one fused instruction
FLOAT_ARRAY = types.Array(types.float32, 1, "C")

# Where a tile's state lies in its one flat float32 array. One array keeps one pointer in a register.
PIXELS = 256
TRANSMITTANCE = 0  # [256], 0 = the ray is done
WEIGHTS = PIXELS  # [256], of the splat at hand
PLAIN_TRANSMITTANCE = 2 * PIXELS  # [256], of the rays without opacity gain
EVIDENCE = 3 * PIXELS  # [8], sums of plain weights of the splat at hand, lane by lane


def compiled(function: Callable) -> Any:
    """An intrinsic; callers leave out the typing context, which no static type can say."""
    return intrinsic(function)


def constant(value: float) -> ir.Constant:
    return ir.Constant(FLOATS, [float(np.float32(value))] * LANES)


def broadcast(builder: Builder, scalar: ir.Value) -> ir.Value:
    undefined = ir.Constant(FLOATS, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(INT, 0))
    mask = ir.Constant(ir.VectorType(INT, LANES), [0] * LANES)
    return builder.shuffle_vector(first, undefined, mask)


def pointer_to(context, builder, array_type, array, offset) -> ir.Value:
    data = context.make_array(array_type)(context, builder, value=array).data
    return builder.bitcast(builder.gep(data, [offset]), FLOATS.as_pointer())


def load_lanes(builder: Builder, pointer: ir.Value) -> ir.Value:
    return builder.load(pointer, align=4)


def minimum(builder: Builder, left: ir.Value, right: ir.Value) -> ir.Value:
    return builder.select(builder.fcmp_ordered("<", left, right), left, right)


def fused(builder: Builder, left: ir.Value, right: ir.Value, term: ir.Value) -> ir.Value:
    """``left * right + term``, one instruction where the machine has it."""
    return builder.fadd(builder.fmul(left, right, flags=FUSE), term, flags=FUSE)


@compiled
def add_lanes(typingctx, total, offset, weights, row):
    """``total[offset + i] += weights[row + i]``."""
    signature = types.void(FLOAT_ARRAY, types.intp, FLOAT_ARRAY, types.intp)

    def codegen(context, builder, signature, args):
        total, offset, weights, row = args
        place = pointer_to(context, builder, signature.args[0], total, offset)
        term = load_lanes(builder, pointer_to(context, builder, signature.args[2], weights, row))
        builder.store(builder.fadd(load_lanes(builder, place), term), place, align=4)
        return context.get_dummy_value()

    return signature, codegen


@compiled
def add_product_lanes(typingctx, total, offset, weights, row, factors, tap):
    """``total[offset + i] += weights[row + i] * factors[tap + i]``."""
    signature = types.void(FLOAT_ARRAY, types.intp, FLOAT_ARRAY, types.intp, FLOAT_ARRAY, types.intp)

    def codegen(context, builder, signature, args):
        total, offset, weights, row, factors, tap = args
        place = pointer_to(context, builder, signature.args[0], total, offset)
        weight = load_lanes(builder, pointer_to(context, builder, signature.args[2], weights, row))
        factor = load_lanes(builder, pointer_to(context, builder, signature.args[4], factors, tap))
        builder.store(fused(builder, weight, factor, load_lanes(builder, place)), place, align=4)
        return context.get_dummy_value()

    return signature, codegen


@compiled
def add_scaled_lanes(typingctx, total, offset, weights, row, scale):
    """``total[offset + i] += weights[row + i] * scale``."""
    signature = types.void(FLOAT_ARRAY, types.intp, FLOAT_ARRAY, types.intp, types.float32)

    def codegen(context, builder, signature, args):
        total, offset, weights, row, scale = args
        place = pointer_to(context, builder, signature.args[0], total, offset)
        weight = load_lanes(builder, pointer_to(context, builder, signature.args[2], weights, row))
        builder.store(fused(builder, weight, broadcast(builder, scale), load_lanes(builder, place)), place, align=4)
        return context.get_dummy_value()

    return signature, codegen


WIDE = 4 * LANES  # channels that add_weighted_row keeps in registers


@compiled
def add_weighted_row(typingctx, target, place, source, entries, sparse, span):
    """``target[place + i] += sum_k weights[k] source[columns[k] * stride + channel + i]`` for 32 channels.

    ``sparse = (columns i32, weights f32)``, ``entries = (first, last)`` of them, ``span = (stride, channel)`` of the
    flat source. The sums stay in registers.
    """
    integers = types.UniTuple(types.intp, 2)
    pair = types.Tuple([types.Array(types.int32, 1, "C"), FLOAT_ARRAY])
    signature = types.void(FLOAT_ARRAY, types.intp, FLOAT_ARRAY, integers, pair, integers)

    def codegen(context, builder, signature, args):
        target, place, source, entries, sparse, span = args
        array = signature.args
        first, last = cgutils.unpack_tuple(builder, entries)
        stride, channel = cgutils.unpack_tuple(builder, span)
        column_data, weight_data = (
            context.make_array(kind)(context, builder, value=part).data
            for kind, part in zip(pair.types, cgutils.unpack_tuple(builder, sparse), strict=True)
        )
        steps = [ir.Constant(place.type, LANES * part) for part in range(WIDE // LANES)]
        places = [pointer_to(context, builder, array[0], target, builder.add(place, step)) for step in steps]
        sums = [cgutils.alloca_once_value(builder, load_lanes(builder, pointer)) for pointer in places]
        with cgutils.for_range_slice(builder, first, last, ir.Constant(place.type, 1)) as (k, _):
            column = builder.sext(builder.load(builder.gep(column_data, [k])), place.type)
            weight = broadcast(builder, builder.load(builder.gep(weight_data, [k])))
            base = builder.add(builder.mul(column, stride), channel)
            for step, total in zip(steps, sums, strict=True):
                row = load_lanes(builder, pointer_to(context, builder, array[2], source, builder.add(base, step)))
                builder.store(fused(builder, row, weight, builder.load(total)), total)
        for pointer, total in zip(places, sums, strict=True):
            builder.store(builder.load(total), pointer, align=4)
        return context.get_dummy_value()

    return signature, codegen
