"""W of some splats at a time, gathered from all views in the order of a curve through space.

Splats near to one another are seen in the same regions of the same views, so they read the same rows of the
codebooks. A trained file has its splats in the order in which training made them: summed in that order, nearly each
entry waits for a row that others have driven out of the cache.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liftcore.raster.cpu.lanes_rows import AHEAD
from liftcore.solve.weighted_sums import Entries, entries_before, gather_entries

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from liftcore.solve.host import EachShare
    from liftcore.solve.weight_tables import WeightTables

CHUNK_ENTRIES = 1 << 23  # gathered at a time, unless a splat alone has more
CHUNK_BYTES = 1 << 29  # of X at a time: where it is a mapped file, more might not stay in memory


class Chunk(NamedTuple):
    """Some splats that follow one another in the file, in the order of the curve."""

    splats: np.ndarray  # [B] i64
    entries: Entries  # of each


class Gathering:
    """W of all views, chunk by chunk; to be gone through as often as there are slices of channels.

    Args:
        each_share: does the work on a chunk.
        weights: W of all views.
        columns: where each view's columns begin among those of all, [V] i64, and the scale of each splat, [P] f64.
        curve: [P] places along the curve; None keeps the order of the file.
        row_bytes: of a row of X, which is written chunk by chunk too; 0 where none is.
    """

    def __init__(
        self,
        each_share: EachShare,
        weights: WeightTables,
        columns: tuple[np.ndarray, np.ndarray],
        curve: np.ndarray | None,
        row_bytes: int,
    ) -> None:
        self._each_share, self._columns, self._curve = each_share, columns, curve
        self._weights, self._tables = weights, (weights.addresses, weights.rows)  # addresses of what weights keeps
        self._counts = self._entry_counts(columns[1].size)
        self._ranges = chunk_ranges(self._counts, row_bytes)
        most = max((int(self._counts[first:last].sum()) for first, last in self._ranges), default=0)
        self._rows, self._shares = np.zeros(most + AHEAD, np.int32), np.empty(most, np.float32)  # of one chunk

    def __iter__(self) -> Iterator[Chunk]:
        """The chunks; each is gone when the next one is asked for."""
        return (self._gathered(*splats) for splats in self._ranges)

    def _entry_counts(self, splats: int) -> np.ndarray:
        """[P] i64: how many entries each splat has, over all views."""
        counts = np.empty(splats, np.int64)

        def count(share: tuple[int, int]) -> None:
            counts[share[0] : share[1]] = np.diff(entries_before(share, self._tables))

        self._each_share(count, 0, splats)
        return counts

    def _gathered(self, first: int, last: int) -> Chunk:
        """The splats ``first..last``."""
        own = np.arange(last - first) if self._curve is None else np.argsort(self._curve[first:last])
        starts = np.concatenate([[0], np.cumsum(self._counts[first:last][own])])
        chunk = Chunk(own + first, Entries(starts, self._rows, self._shares))

        def gather(share: tuple[int, int], cursors: np.ndarray) -> None:
            gather_entries(share, cursors, self._tables, self._columns, chunk.entries)

        self.in_file_order(chunk, gather)
        return chunk

    def in_file_order(self, chunk: Chunk, work: Callable[[tuple[int, int], np.ndarray], None]) -> None:
        """Do some work for shares of a chunk's splats as the file has them.

        Args:
            work: given a share, and where the entries of each of its splats begin [n] i64, which it may change.
        """
        first, count = int(chunk.splats.min()), chunk.splats.size
        places = np.empty(count, np.int64)
        places[chunk.splats - first] = chunk.entries.starts[:-1]
        self._each_share(lambda share: work(share, places[share[0] - first : share[1] - first]), first, first + count)


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
