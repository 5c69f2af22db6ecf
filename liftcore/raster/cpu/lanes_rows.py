"""Rows of codebooks, sixteen channels at a time: their weighted sums and their products.

Sixteen are one register with AVX-512, two with AVX2, four with SSE and NEON.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from liftcore.raster.cpu.lanes import (
    FLOAT,
    FLOAT_ARRAY,
    INT,
    LANES,
    broadcast,
    compiled,
    converts,
    fetch,
    fused,
    pointer_to,
)

if TYPE_CHECKING:
    from liftcore.raster.cpu.lanes import Builder

_BROAD = 2 * LANES  # values of a row at a time
_BROAD_FLOATS, _BROAD_INTS, _BROAD_SHORTS, _BROAD_HALVES = (
    ir.VectorType(kind, _BROAD) for kind in (FLOAT, INT, ir.IntType(16), ir.HalfType())
)
WIDE = 4 * _BROAD  # channels that are kept in registers
AHEAD = 32  # entries between asking for a row and reading it; so many more columns have to be there to be read
_HALF_BITS = 0x0FFFE000 - (1 << 31)  # sign, exponent and mantissa of a float16 where a float32 has them
_HALF_UNIT = 2.0**112  # what float16 is larger by than its bits moved into a float32


def _load_small(builder: Builder, pointer: ir.Value) -> ir.Value:
    """Float16 as float32 that are 2^112 times smaller: their bits, moved, with room for the larger exponent."""
    signed = builder.sext(builder.load(builder.bitcast(pointer, _BROAD_SHORTS.as_pointer()), align=2), _BROAD_INTS)
    moved = builder.shl(signed, ir.Constant(_BROAD_INTS, [13] * _BROAD))
    return builder.bitcast(builder.and_(moved, ir.Constant(_BROAD_INTS, [_HALF_BITS] * _BROAD)), _BROAD_FLOATS)


def _load_halves(builder: Builder, pointer: ir.Value) -> ir.Value:
    """Float16 as float32, on a processor that converts."""
    return builder.fpext(builder.load(builder.bitcast(pointer, _BROAD_HALVES.as_pointer()), align=2), _BROAD_FLOATS)


def _load_singles(builder: Builder, pointer: ir.Value) -> ir.Value:
    return builder.load(builder.bitcast(pointer, _BROAD_FLOATS.as_pointer()), align=4)


@compiled
def add_weighted_row(typingctx, target, place, source, entries, sparse, span):
    """``target[place + i] += sum_k weights[k] source[columns[k] * stride + offset + i]`` for WIDE channels.

    ``sparse = (columns i32, weights f32)``, ``entries = (first, last)`` of them, ``span = (stride, offset)`` of the
    flat source: f32, or the bits of finite f16 (u16), which give the same sums to the bit. They stay in registers.
    """
    integers = types.UniTuple(types.intp, 2)
    pair = types.Tuple([types.Array(types.int32, 1, "C"), FLOAT_ARRAY])
    signature = types.void(FLOAT_ARRAY, types.intp, source, integers, pair, integers)

    def codegen(context, builder, signature, args):
        target, place, source, entries, sparse, span = args
        _add_rows(context, builder, signature.args[2], ([target], place, source, entries, span), (pair, sparse))
        return context.get_dummy_value()

    return signature, codegen


@compiled
def add_weighted_row_twice(typingctx, targets, place, source, entries, sparse, span):
    """``add_weighted_row`` into the first target; into the second with weights ``weights[k] factors[columns[k]]``.

    ``sparse = (columns i32, weights f32, factors f32)``. A row is read once for both sums.
    """
    integers = types.UniTuple(types.intp, 2)
    tables = types.Tuple([types.Array(types.int32, 1, "C"), FLOAT_ARRAY, FLOAT_ARRAY])
    signature = types.void(types.UniTuple(FLOAT_ARRAY, 2), types.intp, source, integers, tables, integers)

    def codegen(context, builder, signature, args):
        targets, place, source, entries, sparse, span = args
        given = (cgutils.unpack_tuple(builder, targets), place, source, entries, span)
        _add_rows(context, builder, signature.args[2], given, (tables, sparse))
        return context.get_dummy_value()

    return signature, codegen


def _add_rows(context: Any, builder: Builder, kind: types.Array, given: tuple, sparse: tuple) -> None:
    """The sums of weighted rows of a source of that kind into each target; of a second one with factors of the rows.

    Args:
        given: targets, place, source, entries and span. sparse: the type of the tuple of tables, and the tuple.
    """
    targets, place, source, entries, span = given
    halves = kind.dtype == types.uint16
    first, last = cgutils.unpack_tuple(builder, entries)
    stride, offset = cgutils.unpack_tuple(builder, span)
    columns, weights, *factors = _tables(context, builder, *sparse)
    smaller = halves and not converts(context)
    load = _load_singles if not halves else _load_small if smaller else _load_halves
    steps = [ir.Constant(place.type, part) for part in range(0, WIDE, _BROAD)]
    places = [
        [pointer_to(context, builder, FLOAT_ARRAY, target, builder.add(place, step)) for step in steps]
        for target in targets
    ]
    sums = [[cgutils.alloca_once_value(builder, _load_singles(builder, one)) for one in own] for own in places]

    def column_of(entry: ir.Value) -> ir.Value:
        return builder.sext(builder.load(builder.gep(columns, [entry])), stride.type)

    def row_at(column: ir.Value) -> ir.Value:
        return builder.add(builder.mul(column, stride), offset)

    with cgutils.for_range_slice(builder, first, last, ir.Constant(place.type, 1)) as (k, _):
        soon = row_at(column_of(builder.add(k, ir.Constant(k.type, AHEAD))))
        fetch(builder, pointer_to(context, builder, kind, source, soon), WIDE * (2 if halves else 4))
        single, column = builder.load(builder.gep(weights, [k])), column_of(k)
        singles = [single, *(builder.fmul(single, builder.load(builder.gep(table, [column]))) for table in factors)]
        unit = ir.Constant(FLOAT, _HALF_UNIT)
        units = [builder.fmul(one, unit) if smaller else one for one in singles]
        broad = [broadcast(builder, one, _BROAD_FLOATS) for one in units]
        base = row_at(column)
        for number, step in enumerate(steps):
            row = load(builder, pointer_to(context, builder, kind, source, builder.add(base, step)))
            for weight, own in zip(broad, sums, strict=True):
                builder.store(fused(builder, row, weight, builder.load(own[number])), own[number])
    for own, kept in zip(places, sums, strict=True):
        for pointer, total in zip(own, kept, strict=True):
            builder.store(builder.load(total), builder.bitcast(pointer, _BROAD_FLOATS.as_pointer()), align=4)


@compiled
def add_row_products(typingctx, other, place, source, entries, sparse, span):
    """``products[k] += sum_i source[columns[k] * stride + offset + i] other[place + i]`` over WIDE channels.

    ``sparse = (columns i32, products f64)``, ``entries = (first, last)`` of them, ``span = (stride, offset)`` of the
    flat source, f32. Gives the sum of ``other[place + i]^2``. Sixteen sums at a time are added up in a fixed tree.
    """
    integers = types.UniTuple(types.intp, 2)
    pair = types.Tuple([types.Array(types.int32, 1, "C"), types.Array(types.float64, 1, "C")])
    signature = types.float32(FLOAT_ARRAY, types.intp, FLOAT_ARRAY, integers, pair, integers)

    def codegen(context, builder, signature, args):
        other, place, source, entries, sparse, span = args
        first, last = cgutils.unpack_tuple(builder, entries)
        stride, offset = cgutils.unpack_tuple(builder, span)
        columns, products = _tables(context, builder, pair, sparse)
        steps = [ir.Constant(place.type, part) for part in range(0, WIDE, _BROAD)]

        def row_at(array: ir.Value, begin: ir.Value) -> list[ir.Value]:
            places = (pointer_to(context, builder, FLOAT_ARRAY, array, builder.add(begin, step)) for step in steps)
            return [_load_singles(builder, pointer) for pointer in places]

        others = row_at(other, place)
        with cgutils.for_range_slice(builder, first, last, ir.Constant(place.type, 1)) as (k, _):
            column = builder.sext(builder.load(builder.gep(columns, [k])), stride.type)
            row = row_at(source, builder.add(builder.mul(column, stride), offset))
            kept = builder.gep(products, [k])
            added = builder.fpext(_product(builder, row, others), ir.DoubleType())
            builder.store(builder.fadd(builder.load(kept), added), kept)
        return _product(builder, others, others)

    return signature, codegen


def _tables(context: Any, builder: Builder, kind: types.Tuple, pair: ir.Value) -> list[ir.Value]:
    """Where the arrays of a tuple begin."""
    arrays = zip(kind.types, cgutils.unpack_tuple(builder, pair), strict=True)
    return [context.make_array(one)(context, builder, value=array).data for one, array in arrays]


def _product(builder: Builder, left: list[ir.Value], right: list[ir.Value]) -> ir.Value:
    """The sum of the products of all lanes, halves onto halves."""
    lanes = ir.Constant(_BROAD_FLOATS, [0.0] * _BROAD)
    for one, other in zip(left, right, strict=True):
        lanes = fused(builder, one, other, lanes)
    count = _BROAD
    while count > 1:
        count //= 2
        low, high = (
            builder.shuffle_vector(lanes, lanes, ir.Constant(ir.VectorType(INT, count), list(range(at, at + count))))
            for at in (0, count)
        )
        lanes = builder.fadd(low, high)
    return builder.extract_element(lanes, ir.Constant(INT, 0))
