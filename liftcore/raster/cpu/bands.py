"""A view's tile lists: all of them at once, or of a band of tiles at a time where they would be long.

A splat that covers the image is in every tile's list. A million of them in three thousand tiles are three thousand
million items, so what lies in memory at a time has a bound, and only then is a view cut.
"""

from __future__ import annotations

from itertools import pairwise
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from liftcore.raster.cpu.readings import NO_SLOT
from liftcore.raster.cpu.tiles import fill_tiles, list_tiles, tile_places

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from liftcore.raster.base import RegionWeights
    from liftcore.raster.cpu.walk import Frame

MOST_LISTED = 1 << 26  # tiles that all splats together may list before the view is cut
BAND_ITEMS = 1 << 24  # of a band's lists, unless one tile has more: there may be several entries of W to each
NO_LIMIT = np.iinfo(np.int64).max


class Bands:
    """A projected view as frames that have the lists of some of its tiles: one frame of all tiles, as a rule.

    Where the cuts lie depends on the splats alone, not on the threads.

    Args:
        frame: the view, its lists empty.
        parts: the depth order, shared out.
        run: runs a function for each of a list of tuples of arguments, and gives what it returned.
    """

    def __init__(self, frame: Frame, parts: list[np.ndarray], run: Callable[[Callable, list], list]) -> None:
        self._bare, self._parts, self._run = frame, parts, run
        tiles = frame.rows * frame.columns
        self._edges = [0, tiles]
        self._whole = self._frame((0, tiles), MOST_LISTED)
        if self._whole is None:
            self._edges = _edges(self._counted(), BAND_ITEMS)

    def __iter__(self) -> Iterator[Frame]:
        """The frames, each made when it is asked for; other tiles than its own have empty lists."""
        for span in pairwise(self._edges):
            frame = self._whole or self._frame(span, NO_LIMIT)
            assert frame is not None
            yield frame

    def _frame(self, span: tuple[int, int], most: int) -> Frame | None:
        """The frame of the tiles from ``span[0]`` to ``span[1]``; None where there are more than ``most`` items."""
        counts = np.zeros((len(self._parts), self._bare.rows * self._bare.columns), np.int64)
        found, lock = 0, Lock()

        def listed(part: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            nonlocal found
            room = most - found
            lengths, tiles = self._list(part if room >= 0 else part[:0], span, max(0, room), counts)
            with lock:
                found += len(tiles)
            return lengths, tiles

        lists = self._run(listed, list(zip(self._parts, counts, strict=True)))
        if found > most:
            return None
        starts, cursors = tile_places(counts)
        items = np.empty(starts[-1], np.int32)

        def fill(part: np.ndarray, lists: tuple[np.ndarray, np.ndarray], cursors: np.ndarray) -> None:
            fill_tiles(part, *lists, cursors, items)

        self._run(fill, list(zip(self._parts, lists, cursors, strict=True)))
        return self._bare._replace(starts=starts, items=items)

    def _list(
        self, part: np.ndarray, span: tuple[int, int], most: int, counts: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """``list_tiles`` of a part [n] i32 of the depth order: lengths [n] i32, tiles [sum] i32; counts grow."""
        size = self._bare.rows, self._bare.columns
        return list_tiles(part, self._bare.kernel, self._bare.records, size, span, most, counts)

    def _counted(self) -> np.ndarray:
        """[tiles] i64: how many splats touch each tile, by lists that are not kept."""
        tiles = self._bare.rows * self._bare.columns
        at_a_time = max(1, BAND_ITEMS // tiles)

        def counted(part: np.ndarray) -> np.ndarray:
            counts = np.zeros(tiles, np.int64)
            for first in range(0, len(part), at_a_time):
                self._list(part[first : first + at_a_time], (0, tiles), NO_LIMIT, counts)
            return counts

        return np.sum(self._run(counted, [(part,) for part in self._parts]), axis=0)


def _edges(counts: np.ndarray, most: int) -> list[int]:
    """Cuts between tiles such that runs of them have at most so many items, or are single tiles."""
    ends, edges = np.cumsum(counts), [0]
    while edges[-1] < len(counts):
        before = ends[edges[-1] - 1] if edges[-1] else 0
        edges.append(max(edges[-1] + 1, int(np.searchsorted(ends, before + most, side="right"))))
    return edges


def no_lists(tiles: int) -> tuple[np.ndarray, np.ndarray]:
    """``starts`` and ``items`` of a frame whose lists are still to be made."""
    return np.zeros(tiles + 1, np.int64), np.empty(0, np.int32)


def entries_of(found: RegionWeights, ids: np.ndarray, codebook_rows: int, levels: int) -> tuple[np.ndarray, ...]:
    """What other bands have found as a share of entries, as ``weigh_tiles`` gives them: a slot for each column."""
    used = np.flatnonzero(ids >= 0)
    records = used[np.searchsorted(ids[used], found.splats.numpy())]
    met = used[np.searchsorted(ids[used], found.evidence_splats.numpy())]
    entries, evidence = found.columns.numpy(), found.evidence.numpy()
    slot_rows = np.full((codebook_rows, levels), -1, np.int32)
    slot_rows[:, 0] = np.arange(codebook_rows)
    return (
        np.concatenate([np.repeat(records, np.diff(found.indptr.numpy())), met]).astype(np.int32),
        np.concatenate([entries, np.full(len(met), NO_SLOT, np.int32)]),
        np.concatenate([found.weights.numpy(), np.zeros(len(met), np.float32)]),
        np.concatenate([np.zeros(len(entries), np.float32), evidence]),
        slot_rows,
    )


def in_order(rows: list[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    """Rows of the same rays, of which each has its entries in one of the bands, as one (starts, splats, weights)."""
    if len(rows) == 1:
        return rows[0]
    lengths = np.array([np.diff(starts) for starts, _, _ in rows])
    rays = np.concatenate([np.repeat(np.arange(lengths.shape[1]), own) for own in lengths])
    order = np.argsort(rays, kind="stable")
    splats, weights = (np.concatenate([row[k] for row in rows])[order] for k in (1, 2))
    return np.concatenate([[0], np.cumsum(lengths.sum(axis=0))]), splats, weights
