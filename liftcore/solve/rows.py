"""Rows of a sparse table that is stored in parts, by views, joined for a block of splats.

Each part has some rows of the block and some columns of the table, in the order of the columns: a row of the block is
the concatenation of its rows in all parts. W, the consensus of its entries, and tuples are stored so.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from liftcore.runtime.jit import kernel
from liftcore.runtime.memory import zeros
from liftcore.values.region_weights import MEMORY_LIMIT


@dataclass(frozen=True)
class SomeRows:
    """Rows of one part."""

    rows: np.ndarray  # [r] i32 or i64 ascending, row numbers in the block
    starts: np.ndarray  # [r + 1] i64, offsets of the rows in the values; the first need not be 0
    values: Sequence[np.ndarray]  # each [n]


def row_starts(parts: Iterable[SomeRows], count: int) -> np.ndarray:
    """Return the offsets of a block's rows, [count + 1] i64."""
    lengths = np.zeros(count + 1, np.int64)
    for part in parts:
        lengths[part.rows + 1] += np.diff(part.starts)
    return np.cumsum(lengths)


def fill_rows(parts: Iterable[SomeRows], starts: np.ndarray, targets: Sequence[np.ndarray]) -> None:
    """Copy the values of all parts to those of the block, whose rows begin at ``starts`` (`row_starts`)."""
    cursors = starts[:-1].copy()
    for part in parts:
        at = cursors[part.rows]
        for source, target in zip(part.values, targets, strict=True):
            copy_rows(part.starts, at, source, target)
        cursors[part.rows] += np.diff(part.starts)


def values_of(count: int, dtype: torch.dtype) -> Tensor:
    """Return zeros [n], in a mapped file if they are many."""
    return zeros((count,), dtype, name="weights", in_file=count * dtype.itemsize > MEMORY_LIMIT >> 1)


def gather_rows(
    parts: Callable[[], Iterable[SomeRows]], count: int, dtypes: Sequence[torch.dtype]
) -> tuple[np.ndarray, list[Tensor]]:
    """Return the offsets [count + 1] i64 of a block's rows, and their values, of the given dtypes.

    Args:
        parts: returns an iterator over the parts, one in memory at a time; called twice.
    """
    starts = row_starts(parts(), count)
    targets = [values_of(int(starts[-1]), dtype) for dtype in dtypes]
    fill_rows(parts(), starts, [target.numpy() for target in targets])
    return starts, targets


def take_rows(starts: np.ndarray, rows: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return some rows [r] of a table: their offsets [r + 1] i64, and their values."""
    begins = np.concatenate([[0], np.cumsum(np.diff(starts)[rows])])
    target = np.empty(begins[-1], values.dtype)
    take(starts, rows, begins, values, target)
    return begins, target


@kernel
def copy_rows(starts, at, source, target):
    """Copy row i of the source, from ``starts[i]`` on, to ``at[i]`` of the target."""
    for i in range(at.size):
        shift = at[i] - starts[i]
        for k in range(starts[i], starts[i + 1]):
            target[k + shift] = source[k]


@kernel
def take(starts, rows, begins, values, target):
    """Copy the rows of `take_rows`."""
    for i in range(rows.size):
        shift = begins[i] - starts[rows[i]]
        for k in range(starts[rows[i]], starts[rows[i] + 1]):
            target[k + shift] = values[k]
