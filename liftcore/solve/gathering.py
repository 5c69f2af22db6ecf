"""W of some splats at a time, gathered from all views: one CSR matrix a chunk, its rows the splats in file order.

Splats near to one another are seen in the same regions of the same views, so they read the same rows of the
codebooks. A trained file has its splats in the order in which training made them: summed in that order, nearly each
entry waits for a row that others have driven out of the cache. So a chunk has an order along a curve through space.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import Unavailable
from liftcore.jit import kernel
from liftcore.raster.base import RegionWeights

LONG = 256  # entries of a splat that float32 adds up one by one
WIDE = 64  # channels of a strip: what a splat's sum holds in the first cache
CHUNK_ENTRIES = 1 << 23  # gathered at a time, unless a splat alone has more
CHUNK_BYTES = 1 << 29  # of X at a time: where it is a mapped file, more might not stay in memory
STRIP_BYTES = 1 << 28  # of the strips of all codebooks at a time, unless a single one has more
MOST_ROWS = 2**31 - 1  # of all codebooks: an entry names its row in four bytes

# Does some work for each part of a range, first to last.
EachShare = Callable[[Callable[[int, int], None], int, int], None]


class Chunk(NamedTuple):
    """W of the splats ``first..last``, row by row, the views of a row in their order."""

    first: int
    last: int
    order: np.ndarray  # [n] i64, in which neighbours follow one another; rows are numbered from 0
    indptr: np.ndarray  # [n + 1] i64
    rows: np.ndarray  # [nnz] i32, among the rows of all codebooks
    shares: np.ndarray  # [nnz] f32, weights times the splat's scale
    runs: np.ndarray  # [nnz] i32, at the first entry of a view in a row how many of them follow; else not set


class Gathering:
    """W of all views, chunk by chunk; to be gone through as often as there are slices of channels.

    Args:
        store: W of every view. counts: rows of every codebook. scale: [P] f64, what rows of W are multiplied with.
        curve: [P] places along the curve; None keeps the order of the file.
        row_bytes: of a row of X, which is written chunk by chunk too; 0 where none is.
    """

    def __init__(
        self,
        each_share: EachShare,
        store: Iterable[RegionWeights],
        counts: Sequence[int],
        scale: np.ndarray,
        curve: np.ndarray | None,
        row_bytes: int,
    ) -> None:
        if sum(counts) > MOST_ROWS:
            got, hint = f"{sum(counts)} in {len(counts)} views", "lift fewer views, or smaller maps"
            raise Unavailable("features", expected=f"at most {MOST_ROWS} rows of codebooks", got=got, hint=hint)
        self._each_share, self._scale, self._curve = each_share, scale, curve
        self._views = [
            (own.splats.numpy(), own.indptr.numpy(), own.columns.numpy(), own.weights.numpy()) for own in store
        ]
        self._bases = np.concatenate([[0], np.cumsum(counts)])[:-1].tolist()
        self._counts = np.zeros(scale.size, np.int64)
        for ids, indptr, _, _ in self._views:
            self._counts[ids] += np.diff(indptr)
        self._ranges = chunk_ranges(self._counts, row_bytes)

    def __iter__(self) -> Iterator[Chunk]:
        """The chunks."""
        return (self._gathered(first, last) for first, last in self._ranges)

    def _gathered(self, first: int, last: int) -> Chunk:
        order = np.arange(last - first) if self._curve is None else np.argsort(self._curve[first:last])
        indptr = np.concatenate([[0], np.cumsum(self._counts[first:last])])
        total, scale = int(indptr[-1]), self._scale
        rows, shares, runs = np.empty(total, np.int32), np.empty(total, np.float32), np.empty(total, np.int32)

        def gather(begin: int, end: int) -> None:
            cursors = indptr[begin - first : end - first].copy()
            for view, base in zip(self._views, self._bases, strict=True):
                gather_view(begin, end, *view, base, scale, cursors, rows, shares, runs)

        self._each_share(gather, first, last)
        return Chunk(first, last, order, indptr, rows, shares, runs)

    def scatter(
        self,
        chunk: Chunk,
        found: np.ndarray,
        marked: np.ndarray,
        into: Sequence[np.ndarray],
        marks: Sequence[np.ndarray],
    ) -> None:
        """Add what was found of a chunk's entries [nnz] f32 to the views' own [nnz_v], in the order of their W.

        What is ``marked`` [nnz] f32 at the first entry of a run goes to the view's rows in ``marks`` [n_v].
        """

        def give_back(begin: int, end: int) -> None:
            cursors = chunk.indptr[begin - chunk.first : end - chunk.first].copy()
            for (ids, starts, _, _), target, squares in zip(self._views, into, marks, strict=True):
                scatter_view(begin, end, ids, starts, cursors, found, marked, target, squares)

        self._each_share(give_back, chunk.first, chunk.last)


def chunk_ranges(counts: np.ndarray, row_bytes: int) -> list[tuple[int, int]]:
    """The splats of each chunk, first and last: of about the same size, within both limits but for a splat.

    Args:
        counts: [P] of entries. row_bytes: of a row of X.
    """
    before = np.concatenate([[0], np.cumsum(counts / CHUNK_ENTRIES + row_bytes / CHUNK_BYTES)])  # of a full chunk
    number = max(math.ceil(before[-1]), 1)
    ends = np.searchsorted(before, before[-1] * np.arange(1, number) / number)
    edges = np.unique([0, *ends, counts.size]).tolist()
    return list(pairwise(edges))


def channel_slices(rows: int, channels: int) -> list[tuple[int, int]]:
    """Channels whose strips lie in memory at a time, of so many rows in all."""
    step = max(WIDE, STRIP_BYTES // (4 * max(rows, 1)) // WIDE * WIDE)
    return [(begin, min(begin + step, channels)) for begin in range(0, channels, step)]


def strips_of(parts: Iterable[Tensor], rows: int, channels: int) -> np.ndarray:
    """Codebooks [M_v, channels], one after the other, in strips [S, M, WIDE] f32; zeros beyond the last channel."""
    strips, base = torch.zeros(-(-channels // WIDE), rows, WIDE), 0
    for part in parts:
        for strip in range(strips.shape[0]):
            own = part[:, strip * WIDE : (strip + 1) * WIDE]
            strips[strip, base : base + own.shape[0], : own.shape[1]] = own
        base += part.shape[0]
    return strips.numpy()


@kernel
def gather_view(first, last, ids, indptr, columns, weights, base, scale, cursors, rows, shares, runs):
    """Put a view's entries of the splats ``first..last`` to where ``cursors`` i64 say, which move on."""
    row = np.searchsorted(ids, first)
    while row < ids.shape[0] and ids[row] < last:
        splat = ids[row]
        at = cursors[splat - first]
        count = indptr[row + 1] - indptr[row]
        if count > 0:
            runs[at] = count
        for k in range(indptr[row], indptr[row + 1]):
            rows[at] = base + columns[k]
            shares[at] = weights[k] * scale[splat]
            at += 1
        cursors[splat - first] = at
        row += 1


@kernel
def scatter_view(first, last, ids, indptr, cursors, found, marked, target, squares):
    """Add a view's part of what was found to its own arrays; the way back of ``gather_view``."""
    row = np.searchsorted(ids, first)
    while row < ids.shape[0] and ids[row] < last:
        at = cursors[ids[row] - first]
        if indptr[row + 1] > indptr[row]:
            squares[row] += marked[at]
        for k in range(indptr[row], indptr[row + 1]):
            target[k] += found[at]
            at += 1
        cursors[ids[row] - first] = at
        row += 1
