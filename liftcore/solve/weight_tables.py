"""W of all views for one compiled call: numba takes no list of arrays, so it is given where they lie.

A call for each view and block of splats would cost more than the sums of a small block.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import types
from numba.np.numpy_support import carray

from liftcore.jit import inlined
from liftcore.raster.cpu.lanes import compiled

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from liftcore.raster.base import RegionWeights

_SPLATS, _ROW_STARTS, _COLUMNS, _WEIGHTS = range(4)
_TYPES = (np.int32, np.int64, np.int32, np.float32)


class WeightTables:
    """Where W of every view lies.

    Args:
        store: W of every view; they must stay as they are while the tables are in use.
    """

    def __init__(self, store: Iterable[RegionWeights]) -> None:
        views = [(view.splats, view.indptr, view.columns, view.weights) for view in store]
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


@inlined
def table_at(addresses, rows):
    """(splats, indptr, columns, weights) of one view that has so many rows."""
    indptr = carray(_counts_at(addresses[_ROW_STARTS]), (rows + 1,))
    splats = carray(_integers_at(addresses[_SPLATS]), (rows,))
    entries = int(indptr[rows])
    columns = carray(_integers_at(addresses[_COLUMNS]), (entries,))
    weights = carray(_floats_at(addresses[_WEIGHTS]), (entries,))
    return splats, indptr, columns, weights


@inlined
def floats_at(address, count):
    """``count`` f32 values at an address."""
    return carray(_floats_at(address), (count,))


@inlined
def rows_between(splats, block):
    """First and last row of the splats ``block[0]..block[1]`` among ``splats`` [n] i32, ascending."""
    first = np.searchsorted(splats, block[0])
    last = first
    while last < splats.shape[0] and splats[last] < block[1]:
        last += 1
    return first, last
