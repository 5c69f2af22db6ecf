"""Eight float32 lanes at a time: the vector instructions of the pixel loop, as LLVM's vectors.

numba's automatic vectorisation stops at aliasing and wrap-around checks inside the blending loop. These intrinsics
build the same arithmetic as LLVM vectors, which become AVX2, SSE or NEON. They lean on numba's data models and on
``codegen().magic_tuple()``: pyproject.toml caps numba at the versions that were tested.

A tile has 16 rows of 16 pixels, each cut into two row segments of eight; segment ``16 side + row`` lies left (side 0)
or right (1). A set of segments is a uint64 with a bit each.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.extending import intrinsic, register_model

from liftcore.scene.compositing import LARGEST_EXPONENT, TILE

if TYPE_CHECKING:
    from collections.abc import Callable

LANES = 8
ROWS = TILE
SIDES = TILE // LANES
SEGMENTS = SIDES * ROWS  # of a tile
PIXELS = TILE * TILE

# Where a tile's state lies in its one flat float32 array: one array keeps one pointer in a register. The 256 rays
# come segment by segment, those of the left side first.
TRANSMITTANCE = 0  # [256], 0 = the ray is done
PLAIN_TRANSMITTANCE = PIXELS  # [256], of the rays whose opacity logits are not scaled
STARTS = 2 * PIXELS  # [32], of the splat at hand: from its middle in a segment to the first lane, times a root
BASES = STARTS + SEGMENTS  # [16], of the splat at hand: its quadratic form in the middle of a row
TABLE = BASES + ROWS  # rows of eight equal constants: operands in memory cost no instruction of their own

Builder = Any  # llvmlite's IRBuilder; what is inferred of its decorated methods is wrong

FLOAT, DOUBLE, INT, LONG = ir.FloatType(), ir.DoubleType(), ir.IntType(32), ir.IntType(64)
FLOATS, INTS = ir.VectorType(FLOAT, LANES), ir.VectorType(INT, LANES)
_DOUBLES = ir.VectorType(DOUBLE, LANES)
_BITS = ir.IntType(LANES)
_FUSE = ("contract",)  # a*b + c may become one fused instruction
FLOAT_ARRAY = types.Array(types.float32, 1, "C")


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


# ---------------------------------------------------------------------------------------------- LLVM by short names


def _constant(value: float) -> ir.Constant:
    """``value``, rounded to float32, eight times."""
    return ir.Constant(FLOATS, [float(np.float32(value))] * LANES)


def _integers(value: int) -> ir.Constant:
    return ir.Constant(INTS, [value] * LANES)


def _broadcast(builder: Builder, scalar: ir.Value, kind: ir.VectorType = FLOATS) -> ir.Value:
    """The scalar in every lane of a vector of that kind."""
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(INT, 0))
    mask = ir.Constant(ir.VectorType(INT, kind.count), [0] * kind.count)
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), mask)


def _pointer(context: Any, builder: Builder, kind: types.Array, array: ir.Value, offset: ir.Value) -> ir.Value:
    """The address of an element of a flat array."""
    return builder.gep(context.make_array(kind)(context, builder, value=array).data, [offset])


def _lanes_pointer(context: Any, builder: Builder, kind: types.Array, array: ir.Value, offset: ir.Value) -> ir.Value:
    return builder.bitcast(_pointer(context, builder, kind, array, offset), FLOATS.as_pointer())


def _load(builder: Builder, pointer: ir.Value) -> ir.Value:
    """The eight values there, which need not be aligned to more than one of them."""
    return builder.load(pointer, align=4)


def _minimum(builder: Builder, left: ir.Value, right: ir.Value) -> ir.Value:
    """The smaller of each pair of lanes, the right one where either is NaN."""
    return builder.select(builder.fcmp_ordered("<", left, right), left, right)


def _maximum(builder: Builder, left: ir.Value, right: ir.Value) -> ir.Value:
    """The larger of each pair of lanes, the right one where either is NaN."""
    return builder.select(builder.fcmp_ordered(">", left, right), left, right)


def _fused(builder: Builder, left: ir.Value, right: ir.Value, term: ir.Value) -> ir.Value:
    """``left * right + term``, one instruction where the machine has it."""
    return builder.fadd(builder.fmul(left, right, flags=_FUSE), term, flags=_FUSE)


def _where(comparison: str) -> Callable[..., ir.Value]:
    """The values where the first two vectors compare so, else 0."""

    def build(builder: Builder, left: ir.Value, right: ir.Value, values: ir.Value) -> ir.Value:
        return builder.select(builder.fcmp_ordered(comparison, left, right), values, _constant(0.0))

    return build


# ------------------------------------------------------------------------------------------------------------- Lanes


def _of_two(build: Callable[..., ir.Value]) -> Any:
    """An intrinsic that makes eight lanes of two times eight."""

    def operation(typingctx, left, right):
        return EIGHT(EIGHT, EIGHT), lambda context, builder, signature, args: build(builder, *args)

    return intrinsic(operation)


def _of_three(build: Callable[..., ir.Value]) -> Any:
    """An intrinsic that makes eight lanes of three times eight."""

    def operation(typingctx, first, second, third):
        return EIGHT(EIGHT, EIGHT, EIGHT), lambda context, builder, signature, args: build(builder, *args)

    return intrinsic(operation)


plus = _of_two(lambda builder, left, right: builder.fadd(left, right))
times = _of_two(lambda builder, left, right: builder.fmul(left, right))
larger = _of_two(_maximum)
smaller = _of_two(_minimum)
plus_product = _of_three(lambda builder, total, left, right: _fused(builder, left, right, total))
where_above = _of_three(_where(">"))  # (left, right, values): values[i] where left[i] > right[i], else 0
where_reached = _of_three(_where(">="))
where_equal = _of_three(_where("=="))


@compiled
def no_lanes(typingctx):
    """Eight zeros."""
    return EIGHT(), lambda context, builder, signature, args: _constant(0.0)


@compiled
def in_all_lanes(typingctx, value):
    """``value`` eight times."""
    return EIGHT(types.float32), lambda context, builder, signature, args: _broadcast(builder, args[0])


@compiled
def lanes_at(typingctx, values, offset):
    """``values[offset + i]``."""

    def codegen(context, builder, signature, args):
        return _load(builder, _lanes_pointer(context, builder, signature.args[0], *args))

    return EIGHT(FLOAT_ARRAY, types.intp), codegen


@compiled
def keep_lanes(typingctx, values, offset, lanes):
    """``values[offset + i] = lanes[i]``."""

    def codegen(context, builder, signature, args):
        builder.store(args[2], _lanes_pointer(context, builder, signature.args[0], *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(FLOAT_ARRAY, types.intp, EIGHT), codegen


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


@compiled
def only_lane(typingctx, values, lane):
    """``values[i]`` of that lane and 0 in all others; eight zeros for a number that is no lane's."""

    def codegen(context, builder, signature, args):
        number = _broadcast(builder, builder.trunc(args[1], INT), INTS)
        own = builder.icmp_signed("==", ir.Constant(INTS, list(range(LANES))), number)
        return builder.select(own, args[0], _constant(0.0))

    return EIGHT(EIGHT, types.intp), codegen


@compiled
def any_above(typingctx, left, right):
    """Whether ``left[i] > right[i]`` for any of the eight."""

    def codegen(context, builder, signature, args):
        above = builder.bitcast(builder.fcmp_ordered(">", *args), _BITS)
        return builder.icmp_unsigned("!=", above, ir.Constant(_BITS, 0))

    return types.boolean(EIGHT, EIGHT), codegen


@compiled
def all_are(typingctx, values, offset, value):
    """Whether the eight i32 from ``values[offset]`` on are all ``value``."""

    def codegen(context, builder, signature, args):
        whole = ir.IntType(32 * LANES)
        place = builder.bitcast(_pointer(context, builder, signature.args[0], *args[:2]), INTS.as_pointer())
        different = builder.xor(builder.load(place, align=4), _broadcast(builder, args[2], INTS))
        return builder.icmp_unsigned("==", builder.bitcast(different, whole), ir.Constant(whole, 0))

    return types.boolean(types.Array(types.int32, 1, "C"), types.intp, types.int32), codegen


# ---------------------------------------------------------------------------------------------- Sets of row segments

_SLACK = 1.0 + 2.0**-19  # of the cutoff: a set lacks no segment for the rounding of float32


@compiled
def lowest(typingctx, bits):
    """The number of the first member of a set that is not empty."""

    def codegen(context, builder, signature, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.intp(types.uint64), codegen


@compiled
def without_lowest(typingctx, bits):
    """The set without its first member."""

    def codegen(context, builder, signature, args):
        return builder.and_(args[0], builder.sub(args[0], ir.Constant(LONG, 1)))

    return types.uint64(types.uint64), codegen


@compiled
def ellipse_segments(typingctx, state, centre, slope, form, cutoff):
    """The segments with a lane where ``(root (x - mx - slope dy))^2 + ky dy^2 <= cutoff``, ``dy = row - my``.

    The splat's ``centre = (mx, my)`` counts from the tile's first pixel centre, ``form = (root, ky)``. Lanes are met
    between their centres too: a set may hold a segment that has no weight, and lacks none that has. Left in
    ``state``: how far right of the splat's middle each segment begins, times root, and ``ky dy^2`` of each row.

    The middles are made in float64: along a needle they are small differences of large numbers.
    """
    pair = types.UniTuple(types.float64, 2)

    def codegen(context, builder, signature, args):
        state, centre, slope, form, cutoff = args
        mx, my = (builder.extract_value(centre, k) for k in range(2))
        slack = builder.fmul(cutoff, ir.Constant(DOUBLE, _SLACK))
        root, ky, top, room = (
            _broadcast(builder, builder.fptrunc(value, FLOAT))
            for value in (*(builder.extract_value(form, k) for k in range(2)), my, slack)
        )
        width, zero = builder.fmul(root, _constant(LANES - 1.0)), _constant(0.0)

        def keep(first: int, values: ir.Value) -> None:
            place = _lanes_pointer(context, builder, signature.args[0], state, ir.Constant(LONG, first))
            builder.store(values, place, align=4)

        segments = ir.Constant(INT, 0)
        for first in range(0, ROWS, LANES):
            numbers = [float(row) for row in range(first, first + LANES)]
            below = builder.fsub(_broadcast(builder, my, _DOUBLES), ir.Constant(_DOUBLES, numbers))
            across = builder.fmul(_broadcast(builder, slope, _DOUBLES), below)
            left = builder.fptrunc(builder.fsub(across, _broadcast(builder, mx, _DOUBLES)), FLOATS)
            dy = builder.fsub(ir.Constant(FLOATS, numbers), top)
            base = builder.fmul(builder.fmul(ky, dy), dy)
            keep(BASES + first, base)
            rest = builder.fsub(room, base)
            for side in range(SIDES):
                start = builder.fmul(builder.fadd(left, _constant(LANES)) if side else left, root)
                keep(STARTS + side * ROWS + first, start)
                # Right of the middle counts the first lane, left of it the last, and around it the middle itself.
                right_of = _maximum(builder, start, zero)
                left_of = _minimum(builder, builder.fadd(start, width), zero)
                away = builder.fadd(right_of, left_of)
                met = builder.fcmp_ordered("<=", builder.fmul(away, away), rest)
                bits = builder.zext(builder.bitcast(met, _BITS), INT)
                segments = builder.or_(segments, builder.shl(bits, ir.Constant(INT, side * ROWS + first)))
        return builder.zext(segments, LONG)

    return types.uint64(FLOAT_ARRAY, pair, types.float64, pair, types.float64), codegen


@compiled
def active_segments(typingctx, state, first):
    """The segments with a lane above zero among the 256 values ``state[first:]``."""

    def codegen(context, builder, signature, args):
        state, first = args
        word, zero, none = ir.Constant(INT, 0), _constant(0.0), ir.Constant(_BITS, 0)
        for segment in range(SEGMENTS):
            place = builder.add(first, ir.Constant(first.type, segment * LANES))
            values = _load(builder, _lanes_pointer(context, builder, signature.args[0], state, place))
            lanes = builder.bitcast(builder.fcmp_ordered(">", values, zero), _BITS)
            bit = builder.zext(builder.icmp_unsigned("!=", lanes, none), INT)
            word = builder.or_(word, builder.shl(bit, ir.Constant(INT, segment)))
        return builder.zext(word, LONG)

    return types.uint64(FLOAT_ARRAY, types.intp), codegen


# ------------------------------------------------------------------------------------------- Blending (paper Eq. 1)
#
# The falloff of each kernel is an exponent e of two, 2^-e, for the lanes i of a segment. What the splat is there
# comes as one of these tuples of float32, and its class says at compile time which arithmetic is made.


class GaussianSegment(NamedTuple):
    """``e = base + (start + root i)^2``."""

    start: np.float32
    root: np.float32
    base: np.float32


class BetaSegment(NamedTuple):
    """``sigma = base + (start + root i)^2``, ``2^-e = (1 - sigma)^beta``, zero from ``sigma = 1`` on.

    Start and root have their rests, as values and steps of ``DiscSegment``: at the rim of a narrow splat
    sigma is steep, and a start rounded at its own size would show in the last three digits of a weight.
    """

    start: np.float32
    start_rest: np.float32
    root: np.float32
    root_rest: np.float32
    base: np.float32
    beta: np.float32


class DiscSegment(NamedTuple):
    """``e = min((s^2 + t^2) / d^2, base + (start + root i)^2)``, the first where ``d > 0`` only.

    s, t and d are affine in the lane: each has its value at lane 0 and its step, both as a float32 and the rest that
    the float32 leaves out. So a disc that is seen nearly edge-on or is a hair, whose s changes by thousands a pixel,
    keeps its digits where s is small. The step's float32 has 21 bits: its product with a lane is exact then, fused
    with the sum or not, and it is not where a compiler makes it once for all segments.
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


_EXP2_DEGREE = 6  # 2^-f on [0, 1) as a polynomial with p(0) = 1, relative error below 6e-9 (Chebyshev nodes)
_LOG2_DEGREE = 9  # log2(1 + f) / f on [sqrt(1/2) - 1, sqrt(2) - 1], relative error below 5e-9
_LOG2_E = 1.0 / math.log(2.0)
_ROOT_HALF_BITS = int(np.float32(math.sqrt(0.5)).view(np.int32))
_MANTISSA_BITS = 23
_LANE_NUMBERS = ir.Constant(FLOATS, [float(lane) for lane in range(LANES)])
_LARGEST_FADED = LARGEST_EXPONENT + 6.0  # where no alpha is too small: float32 has 2^-126
_SMALLEST_REST = 2.0**-100  # of 1 - sigma, where its logarithm is taken


def _nodes(low: float, high: float) -> np.ndarray:
    """64 Chebyshev nodes of an interval."""
    return low + (high - low) * (0.5 - 0.5 * np.cos(np.pi * (np.arange(64) + 0.5) / 64))


def _fitted(nodes: np.ndarray, target: np.ndarray, degree: int, scale: np.ndarray) -> list[float]:
    """Coefficients of ``sum_k c_k f^k ~ target``, errors weighted by ``scale``."""
    powers = nodes[:, None] ** np.arange(degree + 1)
    return np.linalg.lstsq(powers * scale[:, None], target * scale, rcond=None)[0].tolist()


def _exp2_coefficients() -> list[float]:
    nodes = _nodes(0.0, 1.0)
    return [1.0, *_fitted(nodes, (np.exp2(-nodes) - 1.0) / nodes, _EXP2_DEGREE - 1, nodes * np.exp2(nodes))]


def _log2_coefficients() -> list[float]:
    nodes = _nodes(math.sqrt(0.5) - 1.0, math.sqrt(2.0) - 1.0)
    target = np.log2(1.0 + nodes) / nodes
    return _fitted(nodes, target, _LOG2_DEGREE, 1.0 / target)


_POLYNOMIALS = np.array([*_exp2_coefficients(), *_log2_coefficients()], np.float32)
_CUT_ROW, _LARGEST_ROW, _FADED_ROW, _FLOOR_ROW, _CAP_ROW, _STOP_ROW, _EXP2_ROW = range(7)  # then a row a coefficient
_LOG2_ROW = _EXP2_ROW + _EXP2_DEGREE + 1
STATE = TABLE + (_LOG2_ROW + _LOG2_DEGREE + 1) * LANES  # length of a tile's array


def new_state(floor: float, alpha_cap: float, transmittance_stop: float) -> np.ndarray:
    """A tile's state [STATE] f32: all rays done, the constants of compositing in place."""
    state = np.zeros(STATE, np.float32)
    cut = -math.log2(floor) if floor > 0 else _LARGEST_FADED
    rows = [cut, LARGEST_EXPONENT, _LARGEST_FADED, floor, alpha_cap, transmittance_stop, *_POLYNOMIALS]
    state[TABLE:] = np.repeat(np.array(rows, np.float32), LANES)
    return state


def _row(builder: Builder, state: ir.Value, row: int) -> ir.Value:
    """A row of the constant table."""
    place = builder.gep(state, [ir.Constant(LONG, TABLE + row * LANES)])
    return _load(builder, builder.bitcast(place, FLOATS.as_pointer()))


def _exp2(builder: Builder, state: ir.Value, exponent: ir.Value) -> ir.Value:
    """``2^-e`` for e >= 0: the fraction by polynomial, the whole part subtracted from the exponent bits.

    Finite for any e, infinity and no number too, so that it may be multiplied by zero; but e may not be below zero by
    even a rounding.
    """
    floor = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(FLOATS, [FLOATS]), f"llvm.floor.v{LANES}f32"
    )
    rest = builder.fsub(exponent, builder.call(floor, [exponent]))
    whole = builder.fptosi(_minimum(builder, exponent, _row(builder, state, _FADED_ROW)), INTS)
    square = builder.fmul(rest, rest)
    pairs = [  # Estrin's scheme: three short chains instead of one long one
        _fused(builder, _row(builder, state, _EXP2_ROW + k + 1), rest, _row(builder, state, _EXP2_ROW + k))
        for k in (0, 2, 4)
    ]
    high = _fused(builder, _row(builder, state, _EXP2_ROW + 6), square, pairs[2])
    low = _fused(builder, pairs[1], square, pairs[0])
    value = _fused(builder, high, builder.fmul(square, square), low)
    shifted = builder.shl(whole, _integers(_MANTISSA_BITS))
    return builder.bitcast(builder.sub(builder.bitcast(value, INTS), shifted), FLOATS)


def _log2(builder: Builder, state: ir.Value, value: ir.Value) -> ir.Value:
    """``log2 v`` for normal v > 0: ``v = 2^n (1 + f)`` with 1 + f in [sqrt(1/2), sqrt(2)), log2(1 + f) = f p(f).

    The relative error stays small where v comes near one from below, because n is zero there.
    """
    bits = builder.bitcast(value, INTS)
    whole = builder.ashr(builder.sub(bits, _integers(_ROOT_HALF_BITS)), _integers(_MANTISSA_BITS))
    mantissa = builder.sub(bits, builder.shl(whole, _integers(_MANTISSA_BITS)))
    f = builder.fsub(builder.bitcast(mantissa, FLOATS), _row(builder, state, _EXP2_ROW))  # its first coefficient is 1
    total = _row(builder, state, _LOG2_ROW + _LOG2_DEGREE)
    for k in reversed(range(_LOG2_DEGREE)):
        total = _fused(builder, total, f, _row(builder, state, _LOG2_ROW + k))
    return _fused(builder, total, f, builder.sitofp(whole, FLOATS))


def _plus_fade(builder: Builder, exponent: ir.Value, fade: ir.Value | None) -> ir.Value:
    return exponent if fade is None else builder.fadd(exponent, fade)


def _affine(builder: Builder, parts: list[ir.Value]) -> ir.Value:
    """``value + step i``, with the rests of both added last."""
    value, value_rest, step, step_rest = parts
    return builder.fadd(
        _fused(builder, step, _LANE_NUMBERS, value), _fused(builder, step_rest, _LANE_NUMBERS, value_rest)
    )


def _gaussian_exponent(builder: Builder, state: Any, parts: list[ir.Value], fade: ir.Value | None) -> ir.Value:
    start, root, base = parts
    u = builder.fadd(start, builder.fmul(root, _LANE_NUMBERS))
    return _fused(builder, u, u, _plus_fade(builder, base, fade))


def _beta_exponent(builder: Builder, state: ir.Value, parts: list[ir.Value], fade: ir.Value | None) -> ir.Value:
    """Of ``(1 - sigma)^beta``: ``1 - sigma`` is rounded for the logarithm, and what that lost is put back."""
    one, zero = _row(builder, state, _EXP2_ROW), _constant(0.0)
    u = _affine(builder, parts[:4])
    sigma = _fused(builder, u, u, parts[4])
    inside = builder.fcmp_ordered("<", sigma, one)
    rest = builder.select(inside, builder.fsub(one, sigma), one)
    rest = _maximum(builder, rest, _constant(_SMALLEST_REST))
    lost = builder.fsub(builder.fsub(one, rest), sigma)
    logarithm = _fused(builder, lost, _constant(_LOG2_E), _log2(builder, state, rest))
    exponent = builder.fmul(parts[5], builder.fsub(zero, logarithm))
    met = builder.and_(inside, builder.fcmp_ordered("<", exponent, _row(builder, state, _LARGEST_ROW)))
    return builder.select(met, _plus_fade(builder, exponent, fade), _constant(math.inf))


def _disc_exponent(builder: Builder, state: ir.Value, parts: list[ir.Value], fade: ir.Value | None) -> ir.Value:
    nearby = _gaussian_exponent(builder, state, parts[:3], None)
    s, t, d = (_affine(builder, parts[at : at + 4]) for at in (3, 7, 11))
    square = _fused(builder, s, s, builder.fmul(t, t))
    crossing = builder.fdiv(square, builder.fmul(d, d))
    # Ordered comparisons: where the ray misses the plane, the quotient is no number and the low-pass counts.
    before = builder.fcmp_ordered(">", d, _constant(0.0))
    met = builder.and_(before, builder.fcmp_ordered("<", crossing, nearby))
    return _plus_fade(builder, builder.select(met, crossing, nearby), fade)


_EXPONENTS: dict[type, Callable[..., ir.Value]] = {
    GaussianSegment: _gaussian_exponent,
    BetaSegment: _beta_exponent,
    DiscSegment: _disc_exponent,
}


def _composite(builder: Builder, state: ir.Value, alpha: ir.Value, met: ir.Value, place: ir.Value) -> ir.Value:
    """Weights of one splat on eight rays whose T lies at ``place`` (paper Eq. 1); T moves on.

    ``w = a T`` where the splat is met, a at most the cap. A ray whose next T would be at or below the stop takes
    nothing and is done, T = 0. The loop waits for the chain from the exponent to T: what needs no alpha, T of the
    rays that are met and how much of it may go, is made beside it.
    """
    zero = _constant(0.0)
    before = _load(builder, place)
    room = builder.fsub(before, _row(builder, state, _STOP_ROW))
    reaching = builder.select(met, before, zero)
    weight = builder.fmul(_minimum(builder, alpha, _row(builder, state, _CAP_ROW)), reaching)
    after = builder.fsub(before, weight)  # 1 - a would be rounded first, and a million faint splats be lost
    alive = builder.fcmp_ordered("<", weight, room)
    builder.store(builder.select(alive, after, zero), place, align=4)
    return builder.select(alive, weight, zero)


def _blend_signature(result: Any, shape: Any, strength: Any) -> Any:
    """The types of a blend, None for arguments that it does not take."""
    if not isinstance(shape, types.NamedUniTuple) or shape.dtype != types.float32:
        return None
    return result(FLOAT_ARRAY, types.intp, shape, strength)


def _prepared(context, builder, signature, args) -> tuple[ir.Value, Callable, Callable[[int], ir.Value]]:
    """The state's address, the exponent on the lanes for a fade, and where the lanes' rays of a part lie."""
    array, offset, shape, _ = args
    state = context.make_array(signature.args[0])(context, builder, value=array).data
    parts = [_broadcast(builder, part) for part in cgutils.unpack_tuple(builder, shape)]

    def at(part: int) -> ir.Value:
        place = builder.gep(state, [builder.add(offset, ir.Constant(offset.type, part))])
        return builder.bitcast(place, FLOATS.as_pointer())

    def exponent(fade: ir.Value | None) -> ir.Value:
        return _EXPONENTS[signature.args[2].instance_class](builder, state, parts, fade)

    return state, exponent, at


@compiled
def blend_lanes(typingctx, state, offset, shape, fade):
    """Composite one splat over the eight pixels from ``offset`` on, and give its weights there.

    ``shape`` is one of the tuples above; ``a = 2^-(e + fade)``, zero below the floor; fade = -log2(opacity).
    """

    def codegen(context, builder, signature, args):
        data, exponent, at = _prepared(context, builder, signature, args)
        faded = exponent(_broadcast(builder, args[3]))
        met = builder.fcmp_ordered("<=", faded, _row(builder, data, _CUT_ROW))
        return _composite(builder, data, _exp2(builder, data, faded), met, at(TRANSMITTANCE))

    signature = _blend_signature(EIGHT, shape, types.float32)
    return None if signature is None else (signature, codegen)


@compiled
def blend_twice(typingctx, state, offset, shape, opacities):
    """``blend_lanes`` for two opacities, each with rays of its own: the weights, and those of the plain rays.

    ``a = opacity 2^-e``: one power for both.
    """

    def codegen(context, builder, signature, args):
        data, exponent, at = _prepared(context, builder, signature, args)
        alone = exponent(None)
        within = builder.fcmp_ordered("<=", alone, _row(builder, data, _LARGEST_ROW))
        falloff = builder.select(within, _exp2(builder, data, alone), _constant(0.0))
        weights = []
        parts = (TRANSMITTANCE, PLAIN_TRANSMITTANCE)
        for opacity, part in zip(cgutils.unpack_tuple(builder, args[3]), parts, strict=True):
            alpha = builder.fmul(_broadcast(builder, opacity), falloff)
            met = builder.fcmp_ordered(">=", alpha, _row(builder, data, _FLOOR_ROW))
            weights.append(_composite(builder, data, alpha, met, at(part)))
        return context.make_tuple(builder, signature.return_type, weights)

    signature = _blend_signature(types.UniTuple(EIGHT, 2), shape, types.UniTuple(types.float32, 2))
    return None if signature is None else (signature, codegen)


# ----------------------------------------------------------------------------------------------------------- Memory

_LINE = 64  # bytes of the processor's cache


def _fetch(builder: Builder, pointer: ir.Value, size: int) -> None:
    """Ask for the bytes from a pointer on before they are needed."""
    byte = ir.IntType(8).as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [byte, INT, INT, INT])
    ask = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    first = builder.bitcast(pointer, byte)
    for ahead in range(0, size, _LINE):
        place = builder.gep(first, [ir.Constant(INT, ahead)])
        builder.call(ask, [place, *(ir.Constant(INT, number) for number in (0, 3, 1))])  # to read, to keep, data


@compiled
def fetch_row(typingctx, table, row):
    """Ask for the first 128 bytes of a row of ``table`` [n, m] f64 before they are needed."""
    kind = types.Array(types.float64, 2, "C")

    def codegen(context, builder, signature, args):
        values = context.make_array(signature.args[0])(context, builder, value=args[0])
        width = builder.extract_value(values.strides, 0)
        first = builder.bitcast(values.data, ir.IntType(8).as_pointer())
        _fetch(builder, builder.gep(first, [builder.mul(args[1], width)]), 2 * _LINE)
        return context.get_dummy_value()

    return types.void(kind, types.intp), codegen


@compiled
def fetch_place(typingctx, array, place):
    """Ask for the line of the cache where an element of ``array`` [n] lies before it is needed."""

    def codegen(context, builder, signature, args):
        _fetch(builder, _pointer(context, builder, signature.args[0], *args), 1)
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen
