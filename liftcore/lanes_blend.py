"""Blending a splat over eight rays at a time: its falloff, its alpha, its weights (paper Eq. 1).

The falloff of each kernel is an exponent ``e`` of two, ``2^-e``, written for the lanes ``i`` of a half row. What the
footprint is there comes as a named tuple, and its class says at compile time which arithmetic is made.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from liftcore.jit import kernel
from liftcore.lanes import (
    EIGHT,
    FLOAT_ARRAY,
    FLOATS,
    INTS,
    LANES,
    PLAIN_TRANSMITTANCE,
    TABLE,
    TRANSMITTANCE,
    broadcast,
    compiled,
    constant,
    fused,
    load_lanes,
    minimum,
)
from liftcore.raster.constants import LARGEST_EXPONENT

if TYPE_CHECKING:
    from collections.abc import Callable

    from liftcore.lanes import Builder


class GaussianLanes(NamedTuple):
    """``e = base + curvature (start + i)^2``."""

    start: np.float32
    curvature: np.float32
    base: np.float32


class BetaLanes(NamedTuple):
    """``sigma = base + curvature (start + i)^2``, ``2^-e = (1 - sigma)^beta``, zero from ``sigma = 1`` on."""

    start: np.float32
    curvature: np.float32
    base: np.float32
    beta: np.float32


class DiscLanes(NamedTuple):
    """``e = min((s^2 + t^2) / d^2, base + curvature (start + i)^2)``, the first where ``d > 0`` only.

    s, t and d are affine in the lane: each has its value at lane 0 and its step, both as a float32 and the rest that
    the float32 leaves out. So a disc that is seen nearly edge-on, whose s changes by thousands a pixel, keeps its
    digits where s is small.
    """

    start: np.float32
    curvature: np.float32
    base: np.float32
    s: np.float32
    s_rest: np.float32
    s_step: np.float32
    s_step_rest: np.float32
    t: np.float32
    t_rest: np.float32
    t_step: np.float32
    t_step_rest: np.float32
    d: np.float32
    d_rest: np.float32
    d_step: np.float32
    d_step_rest: np.float32


# 2^-f on [0, 1) as a polynomial with p(0) = 1, relative error below 6e-9 (Chebyshev nodes, degree 6).
_EXP2_DEGREE = 6
# log2(1 + f) / f on [sqrt(1/2) - 1, sqrt(2) - 1], relative error below 5e-9.
_LOG2_DEGREE = 9
_LOG2_E = 1.0 / math.log(2.0)
_ROOT_HALF_BITS = int(np.float32(math.sqrt(0.5)).view(np.int32))
_MANTISSA_BITS = 23
_SMALLEST_REST = 2.0**-100  # of 1 - sigma, where its logarithm is taken

# The table's rows are eight equal constants: operands in memory cost no instruction of their own.
_LANE_ROW, _CLAMP_ROW, _FLOOR_ROW, _CAP_ROW, _STOP_ROW, _EXP2_ROW = range(6)  # then one row a coefficient
_LOG2_ROW = _EXP2_ROW + _EXP2_DEGREE + 1
STATE = TABLE + (_LOG2_ROW + _LOG2_DEGREE + 1) * LANES  # length of a tile's array


def _nodes(low: float, high: float) -> np.ndarray:
    """64 Chebyshev nodes of an interval."""
    return low + (high - low) * (0.5 - 0.5 * np.cos(np.pi * (np.arange(64) + 0.5) / 64))


def _fitted(nodes: np.ndarray, target: np.ndarray, degree: int, scale: np.ndarray) -> list[float]:
    """Coefficients of ``sum_k c_k f^k ~ target``, errors weighted by ``scale``."""
    powers = nodes[:, None] ** np.arange(degree + 1)
    return np.linalg.lstsq(powers * scale[:, None], target * scale, rcond=None)[0].tolist()


def _exp2_coefficients() -> np.ndarray:
    nodes = _nodes(0.0, 1.0)
    target = (np.exp2(-nodes) - 1.0) / nodes
    return np.array([1.0, *_fitted(nodes, target, _EXP2_DEGREE - 1, nodes * np.exp2(nodes))], np.float32)


def _log2_coefficients() -> np.ndarray:
    nodes = _nodes(math.sqrt(0.5) - 1.0, math.sqrt(2.0) - 1.0)
    target = np.log2(1.0 + nodes) / nodes
    return np.array(_fitted(nodes, target, _LOG2_DEGREE, 1.0 / target), np.float32)


_EXP2 = _exp2_coefficients()
_LOG2 = _log2_coefficients()


@kernel
def new_state(floor, cap, stop):
    """A tile's state [STATE] f32: all rays done, the constants of the walk in place."""
    state = np.zeros(STATE, np.float32)
    for lane in range(LANES):
        state[TABLE + _LANE_ROW * LANES + lane] = lane
        state[TABLE + _CLAMP_ROW * LANES + lane] = LARGEST_EXPONENT
        state[TABLE + _FLOOR_ROW * LANES + lane] = floor
        state[TABLE + _CAP_ROW * LANES + lane] = cap
        state[TABLE + _STOP_ROW * LANES + lane] = stop
        for k in range(_EXP2_DEGREE + 1):
            state[TABLE + (_EXP2_ROW + k) * LANES + lane] = _EXP2[k]
        for k in range(_LOG2_DEGREE + 1):
            state[TABLE + (_LOG2_ROW + k) * LANES + lane] = _LOG2[k]
    return state


def _row(builder: Builder, state: ir.Value, row: int) -> ir.Value:
    """A row of the constant table."""
    place = builder.gep(state, [ir.Constant(ir.IntType(64), TABLE + row * LANES)])
    return load_lanes(builder, builder.bitcast(place, FLOATS.as_pointer()))


def _integers(value: int) -> ir.Constant:
    return ir.Constant(INTS, [value] * LANES)


def _exp2_negative(builder: Builder, state: ir.Value, exponent: ir.Value) -> ir.Value:
    """``2^-e`` for e >= 0: the fraction by polynomial, the whole part subtracted from the exponent bits."""
    clamped = minimum(builder, exponent, _row(builder, state, _CLAMP_ROW))
    whole = builder.fptosi(clamped, INTS)
    rest = builder.fsub(clamped, builder.sitofp(whole, FLOATS))
    square = builder.fmul(rest, rest)
    pairs = [  # Estrin's scheme: three short chains instead of one long one
        fused(builder, _row(builder, state, _EXP2_ROW + k + 1), rest, _row(builder, state, _EXP2_ROW + k))
        for k in (0, 2, 4)
    ]
    high = fused(builder, _row(builder, state, _EXP2_ROW + 6), square, pairs[2])
    low = fused(builder, pairs[1], square, pairs[0])
    value = fused(builder, high, builder.fmul(square, square), low)
    shifted = builder.shl(whole, _integers(_MANTISSA_BITS))
    return builder.bitcast(builder.sub(builder.bitcast(value, INTS), shifted), FLOATS)


def _log2(builder: Builder, state: ir.Value, value: ir.Value) -> ir.Value:
    """``log2 v`` for normal v > 0: ``v = 2^n (1 + f)`` with 1 + f in [sqrt(1/2), sqrt(2)), log2(1 + f) = f p(f).

    The relative error stays small where v comes near one from below, because n is zero there.
    """
    bits = builder.bitcast(value, INTS)
    above = builder.sub(bits, _integers(_ROOT_HALF_BITS))
    whole = builder.ashr(above, _integers(_MANTISSA_BITS))
    mantissa = builder.sub(bits, builder.shl(whole, _integers(_MANTISSA_BITS)))
    f = builder.fsub(builder.bitcast(mantissa, FLOATS), _row(builder, state, _EXP2_ROW))  # its first coefficient is 1
    total = _row(builder, state, _LOG2_ROW + _LOG2_DEGREE)
    for k in reversed(range(_LOG2_DEGREE)):
        total = fused(builder, total, f, _row(builder, state, _LOG2_ROW + k))
    return fused(builder, total, f, builder.sitofp(whole, FLOATS))


def _quadratic(builder: Builder, state: ir.Value, parts: list[ir.Value]) -> ir.Value:
    """``base + curvature (start + i)^2`` of ``parts = (start, curvature, base)``."""
    start, curvature, base = parts
    u = builder.fadd(start, _row(builder, state, _LANE_ROW))
    return fused(builder, builder.fmul(curvature, u), u, base)


def _gaussian_falloff(builder: Builder, state: ir.Value, parts: list[ir.Value]) -> ir.Value:
    return _exp2_negative(builder, state, _quadratic(builder, state, parts))


def _beta_falloff(builder: Builder, state: ir.Value, parts: list[ir.Value]) -> ir.Value:
    """``(1 - sigma)^beta``: ``1 - sigma`` is rounded for the logarithm, and what that lost is put back."""
    one, zero = _row(builder, state, _EXP2_ROW), constant(0.0)
    sigma = _quadratic(builder, state, parts[:3])
    inside = builder.fcmp_ordered("<", sigma, one)
    rest = builder.select(inside, builder.fsub(one, sigma), one)
    smallest = constant(_SMALLEST_REST)
    rest = builder.select(builder.fcmp_ordered(">", rest, smallest), rest, smallest)
    lost = builder.fsub(builder.fsub(one, rest), sigma)
    logarithm = fused(builder, lost, constant(_LOG2_E), _log2(builder, state, rest))
    exponent = builder.fmul(parts[3], builder.fsub(zero, logarithm))
    met = builder.and_(inside, builder.fcmp_ordered("<", exponent, _row(builder, state, _CLAMP_ROW)))
    kept = builder.select(met, exponent, zero)
    return builder.select(met, _exp2_negative(builder, state, kept), zero)


def _disc_falloff(builder: Builder, state: ir.Value, parts: list[ir.Value]) -> ir.Value:
    lane, zero = _row(builder, state, _LANE_ROW), constant(0.0)
    nearby = _quadratic(builder, state, parts[:3])
    s, t, d = (_affine(builder, lane, parts[at : at + 4]) for at in (3, 7, 11))
    square = fused(builder, s, s, builder.fmul(t, t))
    crossing = builder.fdiv(square, builder.fmul(d, d))
    # Ordered comparisons: where the ray misses the plane, the quotient is no number and the low-pass counts.
    met = builder.and_(builder.fcmp_ordered(">", d, zero), builder.fcmp_ordered("<", crossing, nearby))
    return _exp2_negative(builder, state, builder.select(met, crossing, nearby))


def _affine(builder: Builder, lane: ir.Value, parts: list[ir.Value]) -> ir.Value:
    """``value + step i``, with the rests of both added last."""
    value, value_rest, step, step_rest = parts
    return builder.fadd(fused(builder, step, lane, value), fused(builder, step_rest, lane, value_rest))


_FALLOFFS: dict[type, Callable[[Builder, ir.Value, list[ir.Value]], ir.Value]] = {
    GaussianLanes: _gaussian_falloff,
    BetaLanes: _beta_falloff,
    DiscLanes: _disc_falloff,
}


def _composite(builder: Builder, state: ir.Value, falloff: ir.Value, opacity: ir.Value, place: ir.Value) -> ir.Value:
    """Weights of one splat on eight rays whose T lies at ``place`` (paper Eq. 1); T moves on.

    ``a = min(cap, opacity falloff)``, nothing below the floor; ``w = a T``; a ray whose next T would be at or below
    the stop takes nothing and is done (T = 0).
    """
    zero = constant(0.0)
    raw = minimum(builder, builder.fmul(opacity, falloff), _row(builder, state, _CAP_ROW))
    alpha = builder.select(builder.fcmp_ordered(">=", raw, _row(builder, state, _FLOOR_ROW)), raw, zero)
    before = load_lanes(builder, place)
    weight = builder.fmul(alpha, before)
    after = builder.fsub(before, weight)  # 1 - a would be rounded first, and a million faint splats be lost
    alive = builder.fcmp_ordered(">", after, _row(builder, state, _STOP_ROW))
    builder.store(builder.select(alive, after, zero), place, align=4)
    return builder.select(alive, weight, zero)


def _signature(result: Any, shape: Any, opacity: Any) -> Any:
    """The types of a blend, None for arguments that it does not take."""
    if not isinstance(shape, types.NamedUniTuple) or shape.dtype != types.float32:
        return None
    return result(FLOAT_ARRAY, types.intp, shape, opacity)


def _prepared(context, builder, signature, args) -> tuple[ir.Value, ir.Value, Callable[[int], ir.Value]]:
    """The state's address, the falloff on the lanes, and where the lanes' rays of a part of the state lie."""
    array, offset, shape, _ = args
    state = context.make_array(signature.args[0])(context, builder, value=array).data
    parts = [broadcast(builder, part) for part in cgutils.unpack_tuple(builder, shape)]

    def at(part: int) -> ir.Value:
        place = builder.gep(state, [builder.add(offset, ir.Constant(offset.type, part))])
        return builder.bitcast(place, FLOATS.as_pointer())

    return state, _FALLOFFS[signature.args[2].instance_class](builder, state, parts), at


@compiled
def blend_lanes(typingctx, state, offset, shape, opacity):
    """Composite one splat over the eight pixels from ``offset`` on, and give its weights there.

    ``shape`` is one of the tuples above, in float32.
    """

    def codegen(context, builder, signature, args):
        data, falloff, at = _prepared(context, builder, signature, args)
        return _composite(builder, data, falloff, broadcast(builder, args[3]), at(TRANSMITTANCE))

    signature = _signature(EIGHT, shape, types.float32)
    return None if signature is None else (signature, codegen)


@compiled
def blend_twice(typingctx, state, offset, shape, opacities):
    """``blend_lanes`` for two opacities, each with rays of its own: the weights, and those of the plain rays."""

    def codegen(context, builder, signature, args):
        data, falloff, at = _prepared(context, builder, signature, args)
        own, plain = (broadcast(builder, opacity) for opacity in cgutils.unpack_tuple(builder, args[3]))
        weights = _composite(builder, data, falloff, own, at(TRANSMITTANCE))
        others = _composite(builder, data, falloff, plain, at(PLAIN_TRANSMITTANCE))
        return context.make_tuple(builder, signature.return_type, [weights, others])

    signature = _signature(types.UniTuple(EIGHT, 2), shape, types.UniTuple(types.float32, 2))
    return None if signature is None else (signature, codegen)
