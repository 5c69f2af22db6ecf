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

from liftcore.jit import kernel

if TYPE_CHECKING:
    from collections.abc import Callable

LANES = 8

Builder = Any  # llvmlite's IRBuilder; what it infers of its own decorated methods is wrong

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_FLOATS = ir.VectorType(_FLOAT, LANES)
_INTS = ir.VectorType(_INT, LANES)
_FUSE = ("contract",)  # a*b + c may become one fused instruction
_FLOAT_ARRAY = types.Array(types.float32, 1, "C")

# Where a tile's state lies in its one flat float32 array. One array keeps one pointer in a register.
PIXELS = 256
TRANSMITTANCE = 0  # [256], 0 = the ray is done
WEIGHTS = PIXELS  # [256], of the splat at hand
PLAIN_TRANSMITTANCE = 2 * PIXELS  # [256], of the rays without opacity gain
EVIDENCE = 3 * PIXELS  # [8], sums of plain weights of the splat at hand, lane by lane
_TABLE = EVIDENCE + LANES  # rows of eight equal constants: operands in memory cost no instruction of their own

# 2^-f on [0, 1) as a polynomial with p(0) = 1, relative error below 6e-9 (Chebyshev nodes, degree 6).
_EXP2_DEGREE = 6
_MAX_EXPONENT = 120.0  # larger exponents are far below the alpha floor
_LANE_ROW, _CLAMP_ROW, _FLOOR_ROW, _CAP_ROW, _STOP_ROW, _EXP2_ROW = range(6)  # then one row a coefficient
STATE = _TABLE + (_EXP2_ROW + _EXP2_DEGREE + 1) * LANES  # length of the array


def _exp2_coefficients() -> list[float]:
    nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(64) + 0.5) / 64)
    powers = nodes[:, None] ** np.arange(1, _EXP2_DEGREE + 1)
    target = np.exp2(-nodes) - 1.0
    scale = np.exp2(nodes)[:, None]  # weight rows for relative error
    solution = np.linalg.lstsq(powers * scale, target * scale[:, 0], rcond=None)[0]
    return [1.0, *solution.tolist()]


_EXP2 = np.array(_exp2_coefficients(), np.float32)


@kernel
def new_state(floor, cap, stop):
    """A tile's state [STATE] f32: all rays done, the constants of the walk in place."""
    state = np.zeros(STATE, np.float32)
    for lane in range(LANES):
        state[_TABLE + _LANE_ROW * LANES + lane] = lane
        state[_TABLE + _CLAMP_ROW * LANES + lane] = _MAX_EXPONENT
        state[_TABLE + _FLOOR_ROW * LANES + lane] = floor
        state[_TABLE + _CAP_ROW * LANES + lane] = cap
        state[_TABLE + _STOP_ROW * LANES + lane] = stop
        for k in range(_EXP2_DEGREE + 1):
            state[_TABLE + (_EXP2_ROW + k) * LANES + lane] = _EXP2[k]
    return state


def _compiled(function: Callable) -> Any:
    """An intrinsic; callers leave out the typing context, which no static type can say."""
    return intrinsic(function)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [float(np.float32(value))] * LANES)


def _splat(builder: Builder, scalar: ir.Value) -> ir.Value:
    undefined = ir.Constant(_FLOATS, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_INT, 0))
    mask = ir.Constant(ir.VectorType(_INT, LANES), [0] * LANES)
    return builder.shuffle_vector(first, undefined, mask)


def _pointer(context, builder, array_type, array, offset) -> ir.Value:
    data = context.make_array(array_type)(context, builder, value=array).data
    return builder.bitcast(builder.gep(data, [offset]), _FLOATS.as_pointer())


def _load(builder: Builder, pointer: ir.Value) -> ir.Value:
    return builder.load(pointer, align=4)


def _minimum(builder: Builder, left: ir.Value, right: ir.Value) -> ir.Value:
    return builder.select(builder.fcmp_ordered("<", left, right), left, right)


def _row(builder: Builder, state: ir.Value, row: int) -> ir.Value:
    """A row of the constant table."""
    place = builder.gep(state, [ir.Constant(ir.IntType(64), _TABLE + row * LANES)])
    return _load(builder, builder.bitcast(place, _FLOATS.as_pointer()))


def _fused(builder: Builder, left: ir.Value, right: ir.Value, term: ir.Value) -> ir.Value:
    """``left * right + term``, one instruction where the machine has it."""
    return builder.fadd(builder.fmul(left, right, flags=_FUSE), term, flags=_FUSE)


def _exp2_negative(builder: Builder, state: ir.Value, exponent: ir.Value) -> ir.Value:
    """``2^-e`` for e >= 0: the fraction by polynomial, the whole part subtracted from the exponent bits."""
    clamped = _minimum(builder, exponent, _row(builder, state, _CLAMP_ROW))
    whole = builder.fptosi(clamped, _INTS)
    rest = builder.fsub(clamped, builder.sitofp(whole, _FLOATS))
    square = builder.fmul(rest, rest)
    pairs = [  # Estrin's scheme: three short chains instead of one long one
        _fused(builder, _row(builder, state, _EXP2_ROW + k + 1), rest, _row(builder, state, _EXP2_ROW + k))
        for k in (0, 2, 4)
    ]
    high = _fused(builder, _row(builder, state, _EXP2_ROW + 6), square, pairs[2])
    low = _fused(builder, pairs[1], square, pairs[0])
    value = _fused(builder, high, builder.fmul(square, square), low)
    shifted = builder.shl(whole, ir.Constant(_INTS, [23] * LANES))
    return builder.bitcast(builder.sub(builder.bitcast(value, _INTS), shifted), _FLOATS)


def _composite(builder: Builder, state: ir.Value, falloff: ir.Value, opacity: ir.Value, place: ir.Value) -> ir.Value:
    """Weights of one splat on eight rays whose T lies at ``place`` (paper Eq. 1); T moves on.

    ``a = min(cap, opacity falloff)``, nothing below the floor; ``w = a T``; a ray whose next T would be at or below
    the stop takes nothing and is done (T = 0).
    """
    zero = _constant(0.0)
    raw = _minimum(builder, builder.fmul(opacity, falloff), _row(builder, state, _CAP_ROW))
    alpha = builder.select(builder.fcmp_ordered(">=", raw, _row(builder, state, _FLOOR_ROW)), raw, zero)
    before = _load(builder, place)
    after = builder.fmul(before, builder.fsub(_row(builder, state, _EXP2_ROW), alpha))  # the first coefficient is 1
    alive = builder.fcmp_ordered(">", after, _row(builder, state, _STOP_ROW))
    builder.store(builder.select(alive, after, zero), place, align=4)
    return builder.select(alive, builder.fmul(alpha, before), zero)


def _blend_code(plain: bool, power: int) -> Callable:
    """Code of the four blends: with evidence from plain rays of their own or not, weights or their squares."""

    def codegen(context, builder, signature, args):
        array, offset, splat = args
        state = context.make_array(signature.args[0])(context, builder, value=array).data
        parts = [_splat(builder, part) for part in cgutils.unpack_tuple(builder, splat)]
        start, curvature, base, opacity = parts[:4]

        def at(part: int) -> ir.Value:
            place = builder.gep(state, [builder.add(offset, ir.Constant(offset.type, part))])
            return builder.bitcast(place, _FLOATS.as_pointer())

        u = builder.fadd(start, _row(builder, state, _LANE_ROW))
        exponent = _fused(builder, builder.fmul(curvature, u), u, base)
        falloff = _exp2_negative(builder, state, exponent)
        weight = _composite(builder, state, falloff, opacity, at(TRANSMITTANCE))
        builder.store(weight if power == 1 else builder.fmul(weight, weight), at(WEIGHTS), align=4)
        if plain:
            weight = _composite(builder, state, falloff, parts[4], at(PLAIN_TRANSMITTANCE))
        sums = builder.bitcast(builder.gep(state, [ir.Constant(offset.type, EVIDENCE)]), _FLOATS.as_pointer())
        builder.store(builder.fadd(_load(builder, sums), weight), sums, align=4)
        return context.get_dummy_value()

    return codegen


_BLEND = types.void(_FLOAT_ARRAY, types.intp, types.UniTuple(types.float32, 4))
_BLEND_BOTH = types.void(_FLOAT_ARRAY, types.intp, types.UniTuple(types.float32, 5))


@_compiled
def blend_lanes(typingctx, state, offset, splat):
    """Composite one splat over the eight pixels from ``offset`` on.

    ``splat = (start, curvature, base, opacity)``: lane i has the falloff ``2^-(base + curvature (start + i)^2)``.
    The weights lie in ``state[WEIGHTS + offset:]`` afterwards and are added to the evidence lanes.
    """
    return _BLEND, _blend_code(plain=False, power=1)


@_compiled
def blend_squared_lanes(typingctx, state, offset, splat):
    """``blend_lanes`` that leaves the squares of the weights; the evidence is of the weights themselves."""
    return _BLEND, _blend_code(plain=False, power=2)


@_compiled
def blend_both_lanes(typingctx, state, offset, splat):
    """``blend_lanes`` for the rays with opacity gain, and the evidence from rays of their own without it.

    ``splat = (start, curvature, base, opacity, plain opacity)``.
    """
    return _BLEND_BOTH, _blend_code(plain=True, power=1)


@_compiled
def blend_both_squared_lanes(typingctx, state, offset, splat):
    """``blend_both_lanes`` that leaves the squares of the weights."""
    return _BLEND_BOTH, _blend_code(plain=True, power=2)


@_compiled
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


@_compiled
def add_product_lanes(typingctx, total, offset, weights, row, factors, tap):
    """``total[offset + i] += weights[row + i] * factors[tap + i]``."""
    signature = types.void(_FLOAT_ARRAY, types.intp, _FLOAT_ARRAY, types.intp, _FLOAT_ARRAY, types.intp)

    def codegen(context, builder, signature, args):
        total, offset, weights, row, factors, tap = args
        place = _pointer(context, builder, signature.args[0], total, offset)
        weight = _load(builder, _pointer(context, builder, signature.args[2], weights, row))
        factor = _load(builder, _pointer(context, builder, signature.args[4], factors, tap))
        builder.store(_fused(builder, weight, factor, _load(builder, place)), place, align=4)
        return context.get_dummy_value()

    return signature, codegen


@_compiled
def add_scaled_lanes(typingctx, total, offset, weights, row, scale):
    """``total[offset + i] += weights[row + i] * scale``."""
    signature = types.void(_FLOAT_ARRAY, types.intp, _FLOAT_ARRAY, types.intp, types.float32)

    def codegen(context, builder, signature, args):
        total, offset, weights, row, scale = args
        place = _pointer(context, builder, signature.args[0], total, offset)
        weight = _load(builder, _pointer(context, builder, signature.args[2], weights, row))
        builder.store(_fused(builder, weight, _splat(builder, scale), _load(builder, place)), place, align=4)
        return context.get_dummy_value()

    return signature, codegen


WIDE = 4 * LANES  # channels that add_weighted_row keeps in registers


@_compiled
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
                builder.store(_fused(builder, row, weight, builder.load(total)), total)
        for pointer, total in zip(places, sums, strict=True):
            builder.store(builder.load(total), pointer, align=4)
        return context.get_dummy_value()

    return signature, codegen
