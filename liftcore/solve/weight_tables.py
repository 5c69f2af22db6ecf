"""W of all views for one compiled call: numba takes no list of arrays, so it is given where they lie.

A call for each view and block of splats would cost more than the sums of a small block, and only small blocks stay
in a core's own cache.

Sums are float32 over a few hundred terms at most. Longer ones, of a splat behind a million regions or of thousands of
views, are sums of such parts: added one by one, ten million equal terms would be wrong in their first digit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import overload
from numba.np.numpy_support import carray

from liftcore.jit import inlined, kernel
from liftcore.lanes import WIDE, add_weighted_row, compiled

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from liftcore.raster.protocol import RegionWeights

LONG = 256  # entries of a row that float32 adds up one by one
VIEWS = 64  # views that add to a block one by one

_SPLATS, _ROW_STARTS, _COLUMNS, _WEIGHTS = range(4)
_TYPES = (np.int32, np.int64, np.int32, np.float32)


class Books(NamedTuple):
    """Where some channels of every codebook lie, all of one kind."""

    places: np.ndarray  # [V, 3] i64: the address, how many numbers lie there, and how many from one row to the next
    kind: np.ndarray  # [0], of f32, or of u16 for the bits of f16


class WeightTables:
    """Where W of every view lies.

    Args:
        store: W of every view; they must stay as they are while the tables are in use.
    """

    def __init__(self, store: Iterable[RegionWeights]) -> None:
        views = [(view.splats, view.row_starts, view.columns, view.weights) for view in store]
        self._kept = [  # compiled code takes the types for granted
            tuple(np.ascontiguousarray(part.numpy(), kind) for part, kind in zip(view, _TYPES, strict=True))
            for view in views
        ]
        self.addresses = addresses_of(self._kept)  # [V, 4] i64
        self.rows = np.array([view[_SPLATS].size for view in self._kept], np.int64)  # [V]


def addresses_of(tables: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """[n, k] i64: where the arrays of n tuples of k begin. They must outlive the numbers.

    An empty array has an address too, and nobody may read it.
    """
    if not all(array.flags.c_contiguous for table in tables for array in table):
        raise ValueError("an array with gaps has no address that compiled code could walk from")
    return np.array([[array.ctypes.data for array in table] for table in tables], np.int64)


def _pointer(kind: types.Type) -> tuple:
    signature = types.CPointer(kind)(types.int64)

    def codegen(context, builder, signature, args):
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return signature, codegen


@compiled
def _integers_at(typingctx, address):
    """The address of i32 values."""
    return _pointer(types.int32)


@compiled
def _counts_at(typingctx, address):
    """The address of i64 values."""
    return _pointer(types.int64)


@compiled
def _floats_at(typingctx, address):
    """The address of f32 values."""
    return _pointer(types.float32)


@compiled
def _halves_at(typingctx, address):
    """The address of u16 values."""
    return _pointer(types.uint16)


@inlined
def table_at(addresses, rows):
    """(splats, row_starts, columns, weights) of one view that has so many rows."""
    row_starts = carray(_counts_at(addresses[_ROW_STARTS]), (rows + 1,))
    splats = carray(_integers_at(addresses[_SPLATS]), (rows,))
    entries = int(row_starts[rows])
    columns = carray(_integers_at(addresses[_COLUMNS]), (entries,))
    weights = carray(_floats_at(addresses[_WEIGHTS]), (entries,))
    return splats, row_starts, columns, weights


@inlined
def floats_at(address, count):
    """``count`` f32 values at an address."""
    return carray(_floats_at(address), (count,))


def _book_at(kind, address, count) -> Any:
    """``count`` values at an address, of the kind that the array ``kind`` is of."""


@overload(_book_at, inline="always")
def _overload_book_at(kind, address, count):
    return _halves_book if kind.dtype == types.uint16 else _floats_book


def _halves_book(kind, address, count):
    return carray(_halves_at(address), (count,))


def _floats_book(kind, address, count):
    return carray(_floats_at(address), (count,))


@kernel
def add_weighted_rows(rows, weights, scale, book, target, width):
    """``block[splats[r] - offset] += W[r] scale[splats[r]] codebook`` for some CSR rows.

    Args:
        rows: (first, last, offset): the CSR rows ``first..last``, and the splat that the block starts with.
        weights: (splats [n] i32, row_starts [n + 1] i64, columns [nnz] i32, weights [nnz] f32). scale: [P] f64.
        book: (source, stride): the codebook from its first channel on, flat, and from one row to the next.
        target: the block [B, C] f32, flat. width: C, a multiple of WIDE.
    """
    first, last, offset = rows
    source, stride = book
    splats, row_starts, columns, values = weights
    begin = row_starts[first]
    shares = np.empty(row_starts[last] - begin, np.float32)
    own_columns = columns[begin : row_starts[last]]
    for row in range(first, last):
        entries = (row_starts[row] - begin, row_starts[row + 1] - begin)
        for k in range(entries[0], entries[1]):
            shares[k] = values[begin + k] * scale[splats[row]]
        place = (splats[row] - offset) * width
        if entries[1] - entries[0] > LONG:
            _add_long_row(target[place : place + width], book, entries, (own_columns, shares))
            continue
        for channel in range(0, width, WIDE):
            add_weighted_row(target, place + channel, source, entries, (own_columns, shares), (stride, channel))


@kernel
def _add_long_row(target, book, entries, sparse):
    """One row of the block, of many entries: the sums of LONG of them at a time are added in float64."""
    source, stride = book
    width = target.shape[0]
    part, total = np.empty(width, np.float32), np.zeros(width)
    for start in range(entries[0], entries[1], LONG):
        chunk = (start, min(start + LONG, entries[1]))
        part[:] = 0
        for channel in range(0, width, WIDE):
            add_weighted_row(part, channel, source, chunk, sparse, (stride, channel))
        total += part
    for channel in range(width):
        target[channel] += total[channel]


@inlined
def rows_between(splats, block):
    """First and last row of the splats ``block[0]..block[1]`` among ``splats`` [n] i32, ascending."""
    first = np.searchsorted(splats, block[0])
    last = first
    while last < splats.shape[0] and splats[last] < block[1]:
        last += 1
    return first, last


@kernel
def add_views(block, tables, scale, sums, part):
    """``W E`` of a block of splats, summed over the views in their order, VIEWS of them at a time.

    Args:
        block: (offset, end), the splats.
        tables: (addresses, rows, books): two of WeightTables, and the Books of E_v.
        scale: [P] f64. sums: [B, C] f32, written. part: room for the same.
    """
    addresses, rows, books = tables
    width, target, met = sums.shape[1], part.reshape(-1), 0
    sums[:] = 0
    part[:] = 0
    for view in range(addresses.shape[0]):
        weights = table_at(addresses[view], rows[view])
        first, last = rows_between(weights[0], block)
        if first == last:
            continue
        if met == VIEWS:
            sums += part
            part[:] = 0
            met = 0
        address, count, stride = books.places[view]
        book = _book_at(books.kind, address, count)
        add_weighted_rows((first, last, block[0]), weights, scale, (book, stride), target, width)
        met += 1
    sums += part


def books_of(parts: Sequence[np.ndarray]) -> Books:
    """The books of ``parts`` [M, C], f32 or all of them u16, which must stay where they are.

    They may be channels of wider codebooks: a row is whole, the next one may begin later.
    """
    kind = np.empty(0, parts[0].dtype)
    if any(part.dtype != kind.dtype or part.strides[1] != kind.itemsize for part in parts):
        raise ValueError("books of several kinds, or with gaps in a row, cannot be walked")
    strides = [part.strides[0] // kind.itemsize for part in parts]
    lengths = [(part.shape[0] - 1) * stride + part.shape[1] for part, stride in zip(parts, strides, strict=True)]
    addresses = [part.ctypes.data for part in parts]
    return Books(np.array([addresses, lengths, strides], np.int64).T.copy(), kind)
