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
from liftcore.raster.constants import LARGEST_EXPONENT
from liftcore.raster.cpu.lanes import (
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

if TYPE_CHECKING:
    from collections.abc import Callable

    from liftcore.raster.cpu.lanes import Builder


class GaussianLanes(NamedTuple):
    """``e = base + (start + root i)^2``."""

    start: np.float32
    root: np.float32
    base: np.float32


class BetaLanes(NamedTuple):
    """``sigma = base + (start + root i)^2``, ``2^-e = (1 - sigma)^beta``, zero from ``sigma = 1`` on.

    Start and root have their rests, as values and steps of ``DiscLanes``: at the rim of a narrow splat
    sigma is steep, and a start rounded at its own size would show in the last three digits of a weight.
    """

    start: np.float32
    start_rest: np.float32
    root: np.float32
    root_rest: np.float32
    base: np.float32
    beta: np.float32


class DiscLanes(NamedTuple):
    """``e = min((s^2 + t^2) / d^2, base + (start + root i)^2)``, the first where ``d > 0`` only.

    s, t and d are affine in the lane: each has its value at lane 0 and its step, both as a float32 and the rest that
    the float32 leaves out. So a disc that is seen nearly edge-on or is a hair, whose s changes by thousands a pixel,
    keeps its digits where s is small. The step's float32 has 21 bits: its product with a lane is exact then, fused
    with the sum or not, and it is not where a compiler makes it once for all half rows.
    """

    start: np.float32
    root: np.float32
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
_ROUND_DOWN = f"llvm.floor.v{LANES}f32"
_LANE_NUMBERS = ir.Constant(FLOATS, [float(lane) for lane in range(LANES)])
_OWN_AND_PLAIN = (TRANSMITTANCE, PLAIN_TRANSMITTANCE)
_LARGEST_FADED = LARGEST_EXPONENT + 6.0  # where no alpha is too small: float32 has 2^-126
_SMALLEST_REST = 2.0**-100  # of 1 - sigma, where its logarithm is taken

# The table's rows are eight equal constants: operands in memory cost no instruction of their own.
_CUT_ROW, _LARGEST_ROW, _FADED_ROW, _FLOOR_ROW, _CAP_ROW, _STOP_ROW, _EXP2_ROW = range(7)  # then a row a coefficient
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
    cut = -math.log2(floor) if floor > 0 else _LARGEST_FADED
    for lane in range(LANES):
        state[TABLE + _CUT_ROW * LANES + lane] = cut
        state[TABLE + _LARGEST_ROW * LANES + lane] = LARGEST_EXPONENT
        state[TABLE + _FADED_ROW * LANES + lane] = _LARGEST_FADED
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


def _falloff(builder: Builder, state: ir.Value, exponent: ir.Value) -> ir.Value:
    """``2^-e`` for e >= 0: the fraction by polynomial, the whole part subtracted from the exponent bits.

    Finite for any e, infinity and no number too, so that it may be multiplied by zero; but e may not be below zero by
    even a rounding.
    """
    kind = ir.FunctionType(FLOATS, [FLOATS])
    below = builder.call(cgutils.get_or_insert_function(builder.module, kind, _ROUND_DOWN), [exponent])
    rest = builder.fsub(exponent, below)
    whole = builder.fptosi(minimum(builder, exponent, _row(builder, state, _FADED_ROW)), INTS)
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


def _faded(builder: Builder, exponent: ir.Value, fade: ir.Value | None) -> ir.Value:
    return exponent if fade is None else builder.fadd(exponent, fade)


def _quadratic(builder: Builder, parts: list[ir.Value], fade: ir.Value | None = None) -> ir.Value:
    """``base + (start + root i)^2`` of ``parts = (start, root, base)``, and the fade."""
    start, root, base = parts
    u = builder.fadd(start, builder.fmul(root, _LANE_NUMBERS))
    return fused(builder, u, u, _faded(builder, base, fade))


def _gaussian_exponent(builder: Builder, state: ir.Value, parts: list[ir.Value], fade: ir.Value | None) -> ir.Value:
    return _quadratic(builder, parts, fade)


def _beta_exponent(builder: Builder, state: ir.Value, parts: list[ir.Value], fade: ir.Value | None) -> ir.Value:
    """Of ``(1 - sigma)^beta``: ``1 - sigma`` is rounded for the logarithm, and what that lost is put back."""
    one, zero = _row(builder, state, _EXP2_ROW), constant(0.0)
    u = _affine(builder, parts[:4])
    sigma = fused(builder, u, u, parts[4])
    inside = builder.fcmp_ordered("<", sigma, one)
    rest = builder.select(inside, builder.fsub(one, sigma), one)
    smallest = constant(_SMALLEST_REST)
    rest = builder.select(builder.fcmp_ordered(">", rest, smallest), rest, smallest)
    lost = builder.fsub(builder.fsub(one, rest), sigma)
    logarithm = fused(builder, lost, constant(_LOG2_E), _log2(builder, state, rest))
    exponent = builder.fmul(parts[5], builder.fsub(zero, logarithm))
    met = builder.and_(inside, builder.fcmp_ordered("<", exponent, _row(builder, state, _LARGEST_ROW)))
    return builder.select(met, _faded(builder, exponent, fade), constant(math.inf))


def _disc_exponent(builder: Builder, state: ir.Value, parts: list[ir.Value], fade: ir.Value | None) -> ir.Value:
    zero = constant(0.0)
    nearby = _quadratic(builder, parts[:3])
    s, t, d = (_affine(builder, parts[at : at + 4]) for at in (3, 7, 11))
    square = fused(builder, s, s, builder.fmul(t, t))
    crossing = builder.fdiv(square, builder.fmul(d, d))
    # Ordered comparisons: where the ray misses the plane, the quotient is no number and the low-pass counts.
    met = builder.and_(builder.fcmp_ordered(">", d, zero), builder.fcmp_ordered("<", crossing, nearby))
    return _faded(builder, builder.select(met, crossing, nearby), fade)


def _affine(builder: Builder, parts: list[ir.Value]) -> ir.Value:
    """``value + step i``, with the rests of both added last."""
    value, value_rest, step, step_rest = parts
    return builder.fadd(
        fused(builder, step, _LANE_NUMBERS, value), fused(builder, step_rest, _LANE_NUMBERS, value_rest)
    )


_EXPONENTS: dict[type, Callable[[Builder, ir.Value, list[ir.Value], ir.Value | None], ir.Value]] = {
    GaussianLanes: _gaussian_exponent,
    BetaLanes: _beta_exponent,
    DiscLanes: _disc_exponent,
}


def _composite(builder: Builder, state: ir.Value, alpha: ir.Value, met: ir.Value, place: ir.Value) -> ir.Value:
    """Weights of one splat on eight rays whose T lies at ``place`` (paper Eq. 1); T moves on.

    ``w = a T`` where the splat is met, a at most the cap. A ray whose next T would be at or below the stop takes
    nothing and is done, T = 0. The walk waits for the chain from the exponent to T: what needs no alpha, T of the
    rays that are met and how much of it may go, is made beside it.
    """
    zero = constant(0.0)
    before = load_lanes(builder, place)
    room = builder.fsub(before, _row(builder, state, _STOP_ROW))
    lit = builder.select(met, before, zero)
    weight = builder.fmul(minimum(builder, alpha, _row(builder, state, _CAP_ROW)), lit)
    after = builder.fsub(before, weight)  # 1 - a would be rounded first, and a million faint splats be lost
    alive = builder.fcmp_ordered("<", weight, room)
    builder.store(builder.select(alive, after, zero), place, align=4)
    return builder.select(alive, weight, zero)


def _signature(result: Any, shape: Any, strength: Any) -> Any:
    """The types of a blend, None for arguments that it does not take."""
    if not isinstance(shape, types.NamedUniTuple) or shape.dtype != types.float32:
        return None
    return result(FLOAT_ARRAY, types.intp, shape, strength)


def _prepared(context, builder, signature, args) -> tuple[ir.Value, Callable, Callable[[int], ir.Value]]:
    """The state's address, the exponent on the lanes for a fade, and where the lanes' rays of a part lie."""
    array, offset, shape, _ = args
    state = context.make_array(signature.args[0])(context, builder, value=array).data
    parts = [broadcast(builder, part) for part in cgutils.unpack_tuple(builder, shape)]

    def at(part: int) -> ir.Value:
        place = builder.gep(state, [builder.add(offset, ir.Constant(offset.type, part))])
        return builder.bitcast(place, FLOATS.as_pointer())

    def exponent(fade: ir.Value | None) -> ir.Value:
        return _EXPONENTS[signature.args[2].instance_class](builder, state, parts, fade)

    return state, exponent, at


@compiled
def blend_lanes(typingctx, state, offset, shape, fade):
    """Composite one splat over the eight pixels from ``offset`` on, and give its weights there.

    ``shape`` is one of the tuples above, in float32; ``a = 2^-(e + fade)``, zero below the floor.
    """

    def codegen(context, builder, signature, args):
        data, exponent, at = _prepared(context, builder, signature, args)
        faded = exponent(broadcast(builder, args[3]))
        met = builder.fcmp_ordered("<=", faded, _row(builder, data, _CUT_ROW))
        return _composite(builder, data, _falloff(builder, data, faded), met, at(TRANSMITTANCE))

    signature = _signature(EIGHT, shape, types.float32)
    return None if signature is None else (signature, codegen)


@compiled
def blend_twice(typingctx, state, offset, shape, opacities):
    """``blend_lanes`` for two opacities, each with rays of its own: the weights, and those of the plain rays.

    ``a = opacity 2^-e``: one power for both.
    """

    def codegen(context, builder, signature, args):
        data, exponent, at = _prepared(context, builder, signature, args)
        alone, zero = exponent(None), constant(0.0)
        within = builder.fcmp_ordered("<=", alone, _row(builder, data, _LARGEST_ROW))
        falloff = builder.select(within, _falloff(builder, data, alone), zero)
        weights = []
        for opacity, part in zip(cgutils.unpack_tuple(builder, args[3]), _OWN_AND_PLAIN, strict=True):
            alpha = builder.fmul(broadcast(builder, opacity), falloff)
            met = builder.fcmp_ordered(">=", alpha, _row(builder, data, _FLOOR_ROW))
            weights.append(_composite(builder, data, alpha, met, at(part)))
        return context.make_tuple(builder, signature.return_type, weights)

    signature = _signature(types.UniTuple(EIGHT, 2), shape, types.UniTuple(types.float32, 2))
    return None if signature is None else (signature, codegen)
