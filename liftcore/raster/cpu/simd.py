"""Intrinsics of the pixel loop: eight float32 lanes at a time, as LLVM vectors.

numba's automatic vectorisation stops at aliasing and wrap-around checks inside the blending loop. These intrinsics
build the same arithmetic as LLVM vectors, which become AVX2, SSE or NEON. They depend on numba's data models and on
``codegen().magic_tuple()``: pyproject.toml caps numba at the versions that were tested.

A tile has 16 rows of 16 pixels, each split into two row segments of eight; segment ``16 side + row`` lies left
(side 0) or right (1). A set of segments is a uint64 with one bit each.
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
WIDE_LANES = 32  # where sums of several splats share a load; LLVM splits them into the machine's registers
ROWS = TILE
SIDES = TILE // LANES
SEGMENTS = SIDES * ROWS  # of a tile
PIXELS = TILE * TILE

# Offsets of a tile's state in one flat float32 array: a single array needs a single pointer register. The 256 rays
# are ordered segment by segment, those of the left side first.
TRANSMITTANCE = 0  # [256], 0 = the ray has terminated
UNSCALED_TRANSMITTANCE = PIXELS  # [256], of the rays whose opacity logits are not scaled
STARTS = 2 * PIXELS  # [32], of the current splat: sqrt_a times the distance from its middle to a segment's first lane
BASES = STARTS + SEGMENTS  # [16], of the current splat: c dy^2 of each row
TABLE = BASES + ROWS  # rows of eight equal constants: operands in memory need no load instruction

Builder = Any  # llvmlite's IRBuilder; the inferred types of its decorated methods are wrong

FLOAT, DOUBLE, INT, LONG = ir.FloatType(), ir.DoubleType(), ir.IntType(32), ir.IntType(64)
FLOATS, INTS = ir.VectorType(FLOAT, LANES), ir.VectorType(INT, LANES)
_DOUBLES = ir.VectorType(DOUBLE, LANES)
_BITS = ir.IntType(LANES)
_FUSE = ("contract",)  # a*b + c may become one fused instruction
FLOAT_ARRAY = types.Array(types.float32, 1, "C")


class _Lanes(types.Type):
    """Float32 values in vector registers, as a numba type."""

    def __init__(self, count: int) -> None:
        super().__init__(name=f"Lanes{count}")
        self.vector = ir.VectorType(FLOAT, count)


EIGHT, WIDE = _Lanes(LANES), _Lanes(WIDE_LANES)


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    """The data model of ``_Lanes``: an LLVM vector."""

    def __init__(self, manager: Any, kind: _Lanes) -> None:
        super().__init__(manager, kind, kind.vector)


def compiled(function: Callable) -> Any:
    """Return the function as a numba intrinsic, typed Any: callers omit its typing context."""
    return intrinsic(function)


# ---------------------------------------------------------------------------------------------- LLVM by short names


def _constant(value: float) -> ir.Constant:
    """Return ``value``, rounded to float32, in all lanes."""
    return ir.Constant(FLOATS, [float(np.float32(value))] * LANES)


def _integers(value: int) -> ir.Constant:
    return ir.Constant(INTS, [value] * LANES)


def _broadcast(builder: Builder, scalar: ir.Value, kind: ir.VectorType = FLOATS) -> ir.Value:
    """Return the scalar in every lane of a vector of that kind."""
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(INT, 0))
    mask = ir.Constant(ir.VectorType(INT, kind.count), [0] * kind.count)
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), mask)


def _pointer(context: Any, builder: Builder, kind: types.Array, array: ir.Value, offset: ir.Value) -> ir.Value:
    """Return the address of an element of a flat array."""
    return builder.gep(context.make_array(kind)(context, builder, value=array).data, [offset])


def _lanes_pointer(context: Any, builder: Builder, kind: types.Array, array: ir.Value, offset: ir.Value) -> ir.Value:
    return builder.bitcast(_pointer(context, builder, kind, array, offset), FLOATS.as_pointer())


def _load(builder: Builder, pointer: ir.Value) -> ir.Value:
    """Load eight values, aligned to one of them."""
    return builder.load(pointer, align=4)


def _minimum(builder: Builder, left: ir.Value, right: ir.Value) -> ir.Value:
    """Return the smaller of each pair of lanes, the right one where either is NaN."""
    return builder.select(builder.fcmp_ordered("<", left, right), left, right)


def _maximum(builder: Builder, left: ir.Value, right: ir.Value) -> ir.Value:
    """Return the larger of each pair of lanes, the right one where either is NaN."""
    return builder.select(builder.fcmp_ordered(">", left, right), left, right)


def _fused(builder: Builder, left: ir.Value, right: ir.Value, term: ir.Value) -> ir.Value:
    """Return ``left * right + term``, fused where the machine has the instruction."""
    return builder.fadd(builder.fmul(left, right, flags=_FUSE), term, flags=_FUSE)


def _where(comparison: str) -> Callable[..., ir.Value]:
    """Return a builder of: the values where the first two vectors compare so, else 0."""

    def build(builder: Builder, left: ir.Value, right: ir.Value, values: ir.Value) -> ir.Value:
        return builder.select(builder.fcmp_ordered(comparison, left, right), values, _constant(0.0))

    return build


# ------------------------------------------------------------------------------------------------------------- Lanes


def _of_two(build: Callable[..., ir.Value]) -> Any:
    """Return an intrinsic of two vectors of lanes."""

    def operation(typingctx, left, right):
        return left(left, right), lambda context, builder, signature, args: build(builder, *args)

    return intrinsic(operation)


def _of_three(build: Callable[..., ir.Value]) -> Any:
    """Return an intrinsic of three vectors of lanes."""

    def operation(typingctx, first, second, third):
        return first(first, second, third), lambda context, builder, signature, args: build(builder, *args)

    return intrinsic(operation)


plus = _of_two(lambda builder, left, right: builder.fadd(left, right))
minus = _of_two(lambda builder, left, right: builder.fsub(left, right))
times = _of_two(lambda builder, left, right: builder.fmul(left, right))
larger = _of_two(_maximum)
smaller = _of_two(_minimum)
plus_product = _of_three(lambda builder, total, left, right: _fused(builder, left, right, total))
where_above = _of_three(_where(">"))  # (left, right, values): values[i] where left[i] > right[i], else 0
where_equal = _of_three(_where("=="))


def zeros_of(lanes: _Lanes) -> Any:
    """Return an intrinsic that returns zeros."""

    def zeros(typingctx):
        constant = ir.Constant(lanes.vector, [0.0] * lanes.vector.count)
        return lanes(), lambda context, builder, signature, args: constant

    return intrinsic(zeros)


def loader_of(lanes: _Lanes) -> Any:
    """Return an intrinsic that loads ``values[offset + i]``."""

    def load(typingctx, values, offset):
        def codegen(context, builder, signature, args):
            place = _pointer(context, builder, signature.args[0], *args)
            return _load(builder, builder.bitcast(place, lanes.vector.as_pointer()))

        return lanes(FLOAT_ARRAY, types.intp), codegen

    return intrinsic(load)


no_lanes, lanes_at = zeros_of(EIGHT), loader_of(EIGHT)


@compiled
def in_all_lanes(typingctx, value):
    """Return ``value`` in all lanes."""
    return EIGHT(types.float32), lambda context, builder, signature, args: _broadcast(builder, args[0])


@compiled
def store_lanes(typingctx, values, offset, lanes):
    """Store ``values[offset + i] = lanes[i]``."""

    def codegen(context, builder, signature, args):
        place = _pointer(context, builder, signature.args[0], *args[:2])
        builder.store(args[2], builder.bitcast(place, args[2].type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(FLOAT_ARRAY, types.intp, lanes), codegen


@compiled
def plus_times(typingctx, total, factor, lanes):
    """Return ``total[i] + factor lanes[i]``, for one factor."""

    def codegen(context, builder, signature, args):
        return _fused(builder, _broadcast(builder, args[1], args[2].type), args[2], args[0])

    return total(total, types.float32, lanes), codegen


@compiled
def first_lanes(typingctx, lanes, count):
    """Return ``lanes[i]`` for i < count, else zero."""

    def codegen(context, builder, signature, args):
        kind = ir.VectorType(INT, args[0].type.count)
        numbers, counts = ir.Constant(kind, list(range(kind.count))), builder.trunc(args[1], INT)
        is_first = builder.icmp_signed("<", numbers, _broadcast(builder, counts, kind))
        return builder.select(is_first, args[0], ir.Constant(args[0].type, [0.0] * kind.count))

    return lanes(lanes, types.intp), codegen


@compiled
def sum_of_lanes(typingctx, lanes):
    """Return the sum of the lanes, in a fixed tree."""

    def codegen(context, builder, signature, args):
        total = args[0]
        while total.type.count > 1:
            size, undefined = total.type.count // 2, ir.Constant(total.type, ir.Undefined)
            places = (ir.Constant(ir.VectorType(INT, size), list(range(at, at + size))) for at in (0, size))
            total = builder.fadd(*(builder.shuffle_vector(total, undefined, half) for half in places))
        return builder.extract_element(total, ir.Constant(INT, 0))

    return types.float32(lanes), codegen


@compiled
def any_above(typingctx, left, right):
    """Return True if ``left[i] > right[i]`` in any lane."""

    def codegen(context, builder, signature, args):
        above = builder.bitcast(builder.fcmp_ordered(">", *args), _BITS)
        return builder.icmp_unsigned("!=", above, ir.Constant(_BITS, 0))

    return types.boolean(EIGHT, EIGHT), codegen


@compiled
def all_are(typingctx, values, offset, value):
    """Return True if the eight i32 from ``values[offset]`` on all equal ``value``."""

    def codegen(context, builder, signature, args):
        wide = ir.IntType(32 * LANES)
        place = builder.bitcast(_pointer(context, builder, signature.args[0], *args[:2]), INTS.as_pointer())
        different = builder.xor(builder.load(place, align=4), _broadcast(builder, args[2], INTS))
        return builder.icmp_unsigned("==", builder.bitcast(different, wide), ir.Constant(wide, 0))

    return types.boolean(types.Array(types.int32, 1, "C"), types.intp, types.int32), codegen


# ---------------------------------------------------------------------------------------------- Sets of row segments

_SLACK = 1.0 + 2.0**-19  # on the cut-off, so that rounding to float32 drops no segment


@compiled
def lowest(typingctx, bits):
    """Return the smallest member of a non-empty set."""

    def codegen(context, builder, signature, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.intp(types.uint64), codegen


@compiled
def without_lowest(typingctx, bits):
    """Return the set without its smallest member."""

    def codegen(context, builder, signature, args):
        return builder.and_(args[0], builder.sub(args[0], ir.Constant(LONG, 1)))

    return types.uint64(types.uint64), codegen


@compiled
def ellipse_segments(typingctx, state, centre, slope, form, cutoff):
    """Return the segments with a lane where ``(sqrt_a (x - mx - slope dy))^2 + c dy^2 <= cutoff``, ``dy = row - my``.

    ``centre = (mx, my)`` is relative to the tile's first pixel centre, ``form = (sqrt_a, c)``. The test covers the
    whole interval of a segment, not pixel centres alone: the set may have a segment without weights, but misses none
    with weights. Writes to ``state``: the distance of each segment's start from the splat's middle, times sqrt_a, and
    ``c dy^2`` of each row.

    The middles are computed in float64: along a needle they are small differences of large numbers.
    """
    pair = types.UniTuple(types.float64, 2)

    def codegen(context, builder, signature, args):
        state, centre, slope, form, cutoff = args
        mx, my = (builder.extract_value(centre, k) for k in range(2))
        slack = builder.fmul(cutoff, ir.Constant(DOUBLE, _SLACK))
        sqrt_a, c, top, limit = (
            _broadcast(builder, builder.fptrunc(value, FLOAT))
            for value in (*(builder.extract_value(form, k) for k in range(2)), my, slack)
        )
        width, zero = builder.fmul(sqrt_a, _constant(LANES - 1.0)), _constant(0.0)

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
            base = builder.fmul(builder.fmul(c, dy), dy)
            keep(BASES + first, base)
            rest = builder.fsub(limit, base)
            for side in range(SIDES):
                start = builder.fmul(builder.fadd(left, _constant(LANES)) if side else left, sqrt_a)
                keep(STARTS + side * ROWS + first, start)
                # Nearest point: the first lane right of the middle, the last lane left of it, else the middle itself.
                right_of = _maximum(builder, start, zero)
                left_of = _minimum(builder, builder.fadd(start, width), zero)
                away = builder.fadd(right_of, left_of)
                hit = builder.fcmp_ordered("<=", builder.fmul(away, away), rest)
                bits = builder.zext(builder.bitcast(hit, _BITS), INT)
                segments = builder.or_(segments, builder.shl(bits, ir.Constant(INT, side * ROWS + first)))
        return builder.zext(segments, LONG)

    return types.uint64(FLOAT_ARRAY, pair, types.float64, pair, types.float64), codegen


@compiled
def active_segments(typingctx, state, first):
    """Return the segments with a lane above zero among the 256 values ``state[first:]``."""

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
# The falloff of each kernel is 2^-e in the lanes i of a segment. The splat's coefficients there come as one of these
# tuples of float32, whose class selects the arithmetic at compile time.


class GaussianSegment(NamedTuple):
    """Coefficients of ``e = base + (start + root i)^2``."""

    start: np.float32
    root: np.float32
    base: np.float32


class BetaSegment(NamedTuple):
    """Coefficients of ``sigma = base + (start + root i)^2``, ``2^-e = (1 - sigma)^beta``, zero from ``sigma = 1`` on.

    Start and root come with their rounding errors, as in ``DiscSegment``: at the rim of a narrow splat sigma is
    steep, and a rounded start would change the last three digits of a weight.
    """

    start: np.float32
    start_rest: np.float32
    root: np.float32
    root_rest: np.float32
    base: np.float32
    beta: np.float32


class DiscSegment(NamedTuple):
    """Coefficients of ``e = min((s^2 + t^2) / d^2, base + (start + root i)^2)``, the first only where ``d > 0``.

    s, t and d are affine in the lane: each has a value at lane 0 and a step, both as a float32 and its rounding
    error. So a disc that is nearly edge-on or as thin as a hair, whose s changes by thousands per pixel, keeps its
    precision where s is small. The step's float32 has 21 bits, so that its product with a lane is exact, fused or
    not.
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


_LOG2_E = 1.0 / math.log(2.0)
_ROOT_HALF_BITS = int(np.float32(math.sqrt(0.5)).view(np.int32))
_MANTISSA_BITS = 23
_LANE_NUMBERS = ir.Constant(FLOATS, [float(lane) for lane in range(LANES)])
_LARGEST_ALPHA_EXPONENT = LARGEST_EXPONENT + 6.0  # without an alpha floor: float32 has 2^-126
_SMALLEST_REST = 2.0**-100  # lower bound of 1 - sigma before its logarithm

# Least squares over 64 Chebyshev nodes, errors relative, rounded to float32.
_EXP2 = (  # 2^-f on [0, 1), with p(0) = 1; the error is below 6e-9
    1.0, -0.69314706, 0.2402243, -0.05549051, 0.0095787225, -0.0012743612, 0.000108899236,
)  # fmt: skip
_LOG2 = (  # log2(1 + f) / f on [sqrt(1/2) - 1, sqrt(2) - 1]; the error is below 5e-9
    1.442695, -0.72134733, 0.48089856, -0.36069652, 0.28855106, -0.23960708, 0.20488332, -0.19142178, 0.1846195,
    -0.10725165,
)  # fmt: skip
# Then a row a coefficient.
_CUT_ROW, _LARGEST_ROW, _ALPHA_EXPONENT_ROW, _FLOOR_ROW, _CAP_ROW, _STOP_ROW, _EXP2_ROW = range(7)
_LOG2_ROW = _EXP2_ROW + len(_EXP2)
STATE = TABLE + (_LOG2_ROW + len(_LOG2)) * LANES  # length of a tile's array


def new_state(floor: float, alpha_cap: float, transmittance_stop: float) -> np.ndarray:
    """Return a tile's state [STATE] f32: all rays terminated, the constants of compositing set."""
    state = np.zeros(STATE, np.float32)
    cut = -math.log2(floor) if floor > 0 else _LARGEST_ALPHA_EXPONENT
    rows = [cut, LARGEST_EXPONENT, _LARGEST_ALPHA_EXPONENT, floor, alpha_cap, transmittance_stop, *_EXP2, *_LOG2]
    state[TABLE:] = np.repeat(np.array(rows, np.float32), LANES)
    return state


def _row(builder: Builder, state: ir.Value, row: int) -> ir.Value:
    """Load a row of the constant table."""
    place = builder.gep(state, [ir.Constant(LONG, TABLE + row * LANES)])
    return _load(builder, builder.bitcast(place, FLOATS.as_pointer()))


def _exp2(builder: Builder, state: ir.Value, exponent: ir.Value) -> ir.Value:
    """Return ``2^-e`` for e >= 0: the fraction by a polynomial, the integer subtracted from the exponent bits.

    Finite for any e, infinity and NaN included, so that it may be multiplied by zero; but e must not be negative, not
    even by rounding.
    """
    floor = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(FLOATS, [FLOATS]), f"llvm.floor.v{LANES}f32"
    )
    rest = builder.fsub(exponent, builder.call(floor, [exponent]))
    integer = builder.fptosi(_minimum(builder, exponent, _row(builder, state, _ALPHA_EXPONENT_ROW)), INTS)
    square = builder.fmul(rest, rest)
    pairs = [  # Estrin's scheme: three short chains instead of one long one
        _fused(builder, _row(builder, state, _EXP2_ROW + k + 1), rest, _row(builder, state, _EXP2_ROW + k))
        for k in (0, 2, 4)
    ]
    high = _fused(builder, _row(builder, state, _EXP2_ROW + 6), square, pairs[2])
    low = _fused(builder, pairs[1], square, pairs[0])
    value = _fused(builder, high, builder.fmul(square, square), low)
    shifted = builder.shl(integer, _integers(_MANTISSA_BITS))
    return builder.bitcast(builder.sub(builder.bitcast(value, INTS), shifted), FLOATS)


def _log2(builder: Builder, state: ir.Value, value: ir.Value) -> ir.Value:
    """Return ``log2 v`` for normal v > 0: ``v = 2^n (1 + f)``, 1 + f in [sqrt(1/2), sqrt(2)), log2(1 + f) = f p(f).

    The relative error stays small where v approaches one from below, because n is zero there.
    """
    bits = builder.bitcast(value, INTS)
    integer = builder.ashr(builder.sub(bits, _integers(_ROOT_HALF_BITS)), _integers(_MANTISSA_BITS))
    mantissa = builder.sub(bits, builder.shl(integer, _integers(_MANTISSA_BITS)))
    f = builder.fsub(builder.bitcast(mantissa, FLOATS), _row(builder, state, _EXP2_ROW))  # its first coefficient is 1
    total = _row(builder, state, _LOG2_ROW + len(_LOG2) - 1)
    for k in reversed(range(len(_LOG2) - 1)):
        total = _fused(builder, total, f, _row(builder, state, _LOG2_ROW + k))
    return _fused(builder, total, f, builder.sitofp(integer, FLOATS))


def _add_opacity(builder: Builder, exponent: ir.Value, neg_log2_opacity: ir.Value | None) -> ir.Value:
    return exponent if neg_log2_opacity is None else builder.fadd(exponent, neg_log2_opacity)


def _affine(builder: Builder, parts: list[ir.Value]) -> ir.Value:
    """Return ``value + step i``, with the rounding errors of both added last."""
    value, value_rest, step, step_rest = parts
    return builder.fadd(
        _fused(builder, step, _LANE_NUMBERS, value), _fused(builder, step_rest, _LANE_NUMBERS, value_rest)
    )


def _gaussian_exponent(
    builder: Builder, state: Any, parts: list[ir.Value], neg_log2_opacity: ir.Value | None
) -> ir.Value:
    start, root, base = parts
    u = builder.fadd(start, builder.fmul(root, _LANE_NUMBERS))
    return _fused(builder, u, u, _add_opacity(builder, base, neg_log2_opacity))


def _beta_exponent(
    builder: Builder, state: ir.Value, parts: list[ir.Value], neg_log2_opacity: ir.Value | None
) -> ir.Value:
    """Return the exponent of ``(1 - sigma)^beta``; the rounding of ``1 - sigma`` is corrected after the logarithm."""
    ones, zeros = _row(builder, state, _EXP2_ROW), _constant(0.0)
    u = _affine(builder, parts[:4])
    sigma = _fused(builder, u, u, parts[4])
    inside = builder.fcmp_ordered("<", sigma, ones)
    rest = builder.select(inside, builder.fsub(ones, sigma), ones)
    rest = _maximum(builder, rest, _constant(_SMALLEST_REST))
    rounding = builder.fsub(builder.fsub(ones, rest), sigma)
    logarithm = _fused(builder, rounding, _constant(_LOG2_E), _log2(builder, state, rest))
    exponent = builder.fmul(parts[5], builder.fsub(zeros, logarithm))
    hit = builder.and_(inside, builder.fcmp_ordered("<", exponent, _row(builder, state, _LARGEST_ROW)))
    return builder.select(hit, _add_opacity(builder, exponent, neg_log2_opacity), _constant(math.inf))


def _disc_exponent(
    builder: Builder, state: ir.Value, parts: list[ir.Value], neg_log2_opacity: ir.Value | None
) -> ir.Value:
    nearby = _gaussian_exponent(builder, state, parts[:3], None)
    s, t, d = (_affine(builder, parts[at : at + 4]) for at in (3, 7, 11))
    square = _fused(builder, s, s, builder.fmul(t, t))
    crossing = builder.fdiv(square, builder.fmul(d, d))
    # Ordered comparisons: where the ray misses the plane, the quotient is NaN and the low-pass applies.
    before = builder.fcmp_ordered(">", d, _constant(0.0))
    uses_crossing = builder.and_(before, builder.fcmp_ordered("<", crossing, nearby))
    return _add_opacity(builder, builder.select(uses_crossing, crossing, nearby), neg_log2_opacity)


_EXPONENTS: dict[type, Callable[..., ir.Value]] = {
    GaussianSegment: _gaussian_exponent,
    BetaSegment: _beta_exponent,
    DiscSegment: _disc_exponent,
}


def _composite(builder: Builder, state: ir.Value, alpha: ir.Value, hit: ir.Value, place: ir.Value) -> ir.Value:
    """Return the weights of one splat on eight rays whose T is at ``place`` (paper Eq. 1), and update T.

    ``w = a T`` where the splat is hit, with a at most the cap. A ray whose next T would be at or below the stop gets
    no weight and terminates, T = 0. The loop's latency is the chain from the exponent to T, so values that need no
    alpha (T of the rays that are hit, and T - stop) are computed in parallel to it.
    """
    zero = _constant(0.0)
    before = _load(builder, place)
    headroom = builder.fsub(before, _row(builder, state, _STOP_ROW))
    reaching = builder.select(hit, before, zero)
    weight = builder.fmul(_minimum(builder, alpha, _row(builder, state, _CAP_ROW)), reaching)
    after = builder.fsub(before, weight)  # T (1 - a) would round 1 - a to 1 for faint splats
    alive = builder.fcmp_ordered("<", weight, headroom)
    builder.store(builder.select(alive, after, zero), place, align=4)
    return builder.select(alive, weight, zero)


def _blend_signature(result: Any, shape: Any, strength: Any) -> Any:
    """Return the signature of a blend; None for unsupported argument types."""
    if not isinstance(shape, types.NamedUniTuple) or shape.dtype != types.float32:
        return None
    return result(FLOAT_ARRAY, types.intp, shape, strength)


def _blend_operands(context, builder, signature, args) -> tuple[ir.Value, Callable, Callable[[int], ir.Value]]:
    """Return the state's address, a builder of the exponent, and one of the address of T of the lanes."""
    array, offset, shape, _ = args
    state = context.make_array(signature.args[0])(context, builder, value=array).data
    parts = [_broadcast(builder, part) for part in cgutils.unpack_tuple(builder, shape)]

    def at(part: int) -> ir.Value:
        place = builder.gep(state, [builder.add(offset, ir.Constant(offset.type, part))])
        return builder.bitcast(place, FLOATS.as_pointer())

    def exponent(neg_log2_opacity: ir.Value | None) -> ir.Value:
        return _EXPONENTS[signature.args[2].instance_class](builder, state, parts, neg_log2_opacity)

    return state, exponent, at


@compiled
def blend_lanes(typingctx, state, offset, shape, neg_log2_opacity):
    """Composite one splat over the eight pixels from ``offset`` on, and return its weights there.

    ``shape`` is one of the tuples above; ``a = 2^-(e + neg_log2_opacity)``, zero below the floor.
    """

    def codegen(context, builder, signature, args):
        data, exponent, at = _blend_operands(context, builder, signature, args)
        alpha_exponent = exponent(_broadcast(builder, args[3]))
        hit = builder.fcmp_ordered("<=", alpha_exponent, _row(builder, data, _CUT_ROW))
        return _composite(builder, data, _exp2(builder, data, alpha_exponent), hit, at(TRANSMITTANCE))

    signature = _blend_signature(EIGHT, shape, types.float32)
    return None if signature is None else (signature, codegen)


@compiled
def blend_twice(typingctx, state, offset, shape, opacities):
    """Composite as ``blend_lanes`` for two opacities, each with its own T: return the scaled and unscaled weights.

    ``a = opacity 2^-e``: the power is computed once.
    """

    def codegen(context, builder, signature, args):
        data, exponent, at = _blend_operands(context, builder, signature, args)
        falloff_exponent = exponent(None)
        within = builder.fcmp_ordered("<=", falloff_exponent, _row(builder, data, _LARGEST_ROW))
        falloff = builder.select(within, _exp2(builder, data, falloff_exponent), _constant(0.0))
        weights = []
        parts = (TRANSMITTANCE, UNSCALED_TRANSMITTANCE)
        for opacity, part in zip(cgutils.unpack_tuple(builder, args[3]), parts, strict=True):
            alpha = builder.fmul(_broadcast(builder, opacity), falloff)
            hit = builder.fcmp_ordered(">=", alpha, _row(builder, data, _FLOOR_ROW))
            weights.append(_composite(builder, data, alpha, hit, at(part)))
        return context.make_tuple(builder, signature.return_type, weights)

    signature = _blend_signature(types.UniTuple(EIGHT, 2), shape, types.UniTuple(types.float32, 2))
    return None if signature is None else (signature, codegen)


# ----------------------------------------------------------------------------------------------------------- Memory

_LINE = 64  # bytes of the processor's cache


def _fetch(builder: Builder, pointer: ir.Value, size: int) -> None:
    """Prefetch ``size`` bytes from a pointer on."""
    byte = ir.IntType(8).as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [byte, INT, INT, INT])
    prefetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    first = builder.bitcast(pointer, byte)
    for offset in range(0, size, _LINE):
        place = builder.gep(first, [ir.Constant(INT, offset)])
        builder.call(prefetch, [place, *(ir.Constant(INT, number) for number in (0, 3, 1))])  # read, locality, data


@compiled
def fetch_row(typingctx, table, row):
    """Prefetch the first 128 bytes of a row of ``table`` [n, m] f64."""
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
    """Prefetch the cache line of an element of ``array`` [n]."""

    def codegen(context, builder, signature, args):
        _fetch(builder, _pointer(context, builder, signature.args[0], *args), 1)
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen
