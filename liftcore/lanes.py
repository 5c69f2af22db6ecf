"""Eight float32 lanes at a time: the vector instructions of the pixel loop and of the solution.

numba's automatic vectorisation stops at aliasing and wrap-around checks inside the blending loop. These
intrinsics build the same arithmetic as LLVM vectors of eight lanes, which LLVM lowers to AVX2, SSE or NEON.
A tile row of 16 pixels is two such half rows.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_FLOATS = ir.VectorType(_FLOAT, LANES)
_INTS = ir.VectorType(_INT, LANES)
_FUSE = ("contract",)  # a*b + c may become one fused instruction
_FLOAT_ARRAY = types.Array(types.float32, 1, "C")

# 2^-f on [0, 1) as a polynomial with p(0) = 1, relative error below 6e-9 (Chebyshev nodes, degree 6).
_EXP2_DEGREE = 6
_MAX_EXPONENT = 120.0  # larger exponents are far below the alpha floor


def _exp2_coefficients() -> list[float]:
    nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(64) + 0.5) / 64)
    powers = nodes[:, None] ** np.arange(1, _EXP2_DEGREE + 1)
    target = np.exp2(-nodes) - 1.0
    scale = np.exp2(nodes)[:, None]  # weight rows for relative error
    solution = np.linalg.lstsq(powers * scale, target * scale[:, 0], rcond=None)[0]
    return [1.0, *solution.tolist()]


_EXP2 = _exp2_coefficients()


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [float(np.float32(value))] * LANES)


def _splat(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    undefined = ir.Constant(_FLOATS, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_INT, 0))
    mask = ir.Constant(ir.VectorType(_INT, LANES), [0] * LANES)
    return builder.shuffle_vector(first, undefined, mask)


def _pointer(context, builder, array_type, array, offset) -> ir.Value:
    data = context.make_array(array_type)(context, builder, value=array).data
    return builder.bitcast(builder.gep(data, [offset]), _FLOATS.as_pointer())


def _load(builder: ir.IRBuilder, pointer: ir.Value) -> ir.Value:
    return builder.load(pointer, align=4)


def _minimum(builder: ir.IRBuilder, left: ir.Value, right: ir.Value) -> ir.Value:
    return builder.select(builder.fcmp_ordered("<", left, right), left, right)


def _exp2_negative(builder: ir.IRBuilder, exponent: ir.Value) -> ir.Value:
    """``2^-e`` for e >= 0: integer part through the exponent bits, the rest by polynomial."""
    clamped = _minimum(builder, exponent, _constant(_MAX_EXPONENT))
    whole = builder.fptosi(clamped, _INTS)
    rest = builder.fsub(clamped, builder.sitofp(whole, _FLOATS))
    value = _constant(_EXP2[-1])
    for coefficient in reversed(_EXP2[:-1]):
        value = builder.fadd(builder.fmul(value, rest, flags=_FUSE), _constant(coefficient), flags=_FUSE)
    bias = ir.Constant(_INTS, [127] * LANES)
    shift = ir.Constant(_INTS, [23] * LANES)
    power = builder.bitcast(builder.shl(builder.sub(bias, whole), shift), _FLOATS)
    return builder.fmul(value, power)


@intrinsic
def gaussian_lanes(typingctx, falloff, offset, start, curvature, base):
    """``falloff[offset + i] = 2^-(base + curvature (start + i)^2)`` for eight lanes."""
    signature = types.void(_FLOAT_ARRAY, types.intp, types.float32, types.float32, types.float32)

    def codegen(context, builder, signature, args):
        array, offset, start, curvature, base = args
        lane = ir.Constant(_FLOATS, [float(i) for i in range(LANES)])
        u = builder.fadd(_splat(builder, start), lane)
        scaled = builder.fmul(_splat(builder, curvature), u)
        exponent = builder.fadd(builder.fmul(scaled, u, flags=_FUSE), _splat(builder, base), flags=_FUSE)
        value = _exp2_negative(builder, exponent)
        builder.store(value, _pointer(context, builder, signature.args[0], array, offset), align=4)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def blend_lanes(typingctx, weights, offset, falloff, transmittance, row, alpha):
    """Composite one splat over eight pixels, front to back (paper Eq. 1).

    ``alpha = (opacity, cap, floor, stop)``: ``a = min(cap, opacity falloff)``, nothing below the floor;
    ``w = a T``; a ray whose next T would be at or below the stop takes nothing and is done (T = 0).
    """
    scalars = types.UniTuple(types.float32, 4)
    signature = types.void(_FLOAT_ARRAY, types.intp, _FLOAT_ARRAY, _FLOAT_ARRAY, types.intp, scalars)

    def codegen(context, builder, signature, args):
        weights, offset, falloff, transmittance, row, alpha = args
        opacity, cap, floor, stop = (_splat(builder, part) for part in cgutils.unpack_tuple(builder, alpha))
        zero = _constant(0.0)
        shape = _load(builder, _pointer(context, builder, signature.args[2], falloff, offset))
        raw = _minimum(builder, builder.fmul(opacity, shape), cap)
        value = builder.select(builder.fcmp_ordered(">=", raw, floor), raw, zero)
        place = _pointer(context, builder, signature.args[3], transmittance, row)
        before = _load(builder, place)
        weight = builder.fmul(value, before)
        after = builder.fmul(before, builder.fsub(_constant(1.0), value))
        alive = builder.fcmp_ordered(">", after, stop)
        builder.store(builder.select(alive, after, zero), place, align=4)
        target = _pointer(context, builder, signature.args[0], weights, offset)
        builder.store(builder.select(alive, weight, zero), target, align=4)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def add_lanes(typingctx, total, offset, weights, row):
    """``total[offset + i] += weights[row + i]``."""
    signature = types.void(_FLOAT_ARRAY, types.intp, _FLOAT_ARRAY, types.intp)

    def codegen(context, builder, signature, args):
        total, offset, weights, row = args
        place = _pointer(context, builder, signature.args[0], total, offset)
        term = _load(builder, _pointer(context, builder, signature.args[2], weights, row))
        builder.store(builder.fadd(_load(builder, place), term), place, align=4)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def square_lanes(typingctx, weights, row):
    """``weights[row + i] *= weights[row + i]``."""
    signature = types.void(_FLOAT_ARRAY, types.intp)

    def codegen(context, builder, signature, args):
        weights, row = args
        place = _pointer(context, builder, signature.args[0], weights, row)
        value = _load(builder, place)
        builder.store(builder.fmul(value, value), place, align=4)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def add_product_lanes(typingctx, total, offset, weights, row, factors, tap):
    """``total[offset + i] += weights[row + i] * factors[tap + i]``."""
    signature = types.void(_FLOAT_ARRAY, types.intp, _FLOAT_ARRAY, types.intp, _FLOAT_ARRAY, types.intp)

    def codegen(context, builder, signature, args):
        total, offset, weights, row, factors, tap = args
        place = _pointer(context, builder, signature.args[0], total, offset)
        weight = _load(builder, _pointer(context, builder, signature.args[2], weights, row))
        factor = _load(builder, _pointer(context, builder, signature.args[4], factors, tap))
        product = builder.fmul(weight, factor, flags=_FUSE)
        builder.store(builder.fadd(_load(builder, place), product, flags=_FUSE), place, align=4)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def add_scaled_lanes(typingctx, total, offset, weights, row, scale):
    """``total[offset + i] += weights[row + i] * scale``."""
    signature = types.void(_FLOAT_ARRAY, types.intp, _FLOAT_ARRAY, types.intp, types.float32)

    def codegen(context, builder, signature, args):
        total, offset, weights, row, scale = args
        place = _pointer(context, builder, signature.args[0], total, offset)
        weight = _load(builder, _pointer(context, builder, signature.args[2], weights, row))
        product = builder.fmul(weight, _splat(builder, scale), flags=_FUSE)
        builder.store(builder.fadd(_load(builder, place), product, flags=_FUSE), place, align=4)
        return context.get_dummy_value()

    return signature, codegen


WIDE = 4 * LANES  # channels that add_weighted_row keeps in registers


@intrinsic
def add_weighted_row(typingctx, target, place, source, entries, sparse, span):
    """``target[place + i] += sum_k weights[k] source[columns[k] * stride + channel + i]`` for 32 channels.

    ``sparse = (columns i32, weights f32)``, ``entries = (first, last)`` of them, ``span = (stride, channel)`` of the
    flat source. The sums stay in registers.
    """
    integers = types.UniTuple(types.intp, 2)
    pair = types.Tuple([types.Array(types.int32, 1, "C"), _FLOAT_ARRAY])
    signature = types.void(_FLOAT_ARRAY, types.intp, _FLOAT_ARRAY, integers, pair, integers)

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
        places = [_pointer(context, builder, array[0], target, builder.add(place, step)) for step in steps]
        sums = [cgutils.alloca_once_value(builder, _load(builder, pointer)) for pointer in places]
        with cgutils.for_range_slice(builder, first, last, ir.Constant(place.type, 1)) as (k, _):
            column = builder.sext(builder.load(builder.gep(column_data, [k])), place.type)
            weight = _splat(builder, builder.load(builder.gep(weight_data, [k])))
            base = builder.add(builder.mul(column, stride), channel)
            for step, total in zip(steps, sums, strict=True):
                row = _load(builder, _pointer(context, builder, array[2], source, builder.add(base, step)))
                product = builder.fmul(row, weight, flags=_FUSE)
                builder.store(builder.fadd(builder.load(total), product, flags=_FUSE), total)
        for pointer, total in zip(places, sums, strict=True):
            builder.store(builder.load(total), pointer, align=4)
        return context.get_dummy_value()

    return signature, codegen
