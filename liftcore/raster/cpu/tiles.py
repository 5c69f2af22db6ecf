"""Depth order and tile lists: which splats touch which 16 x 16 pixel tile, near to far.

The depth order is a stable sort of float32 depths; ties keep the order of the splats' rows, so the order, and with it
every product, is unique. It is cut into a fixed number of shares; each share lists its tiles and counts them, a
prefix sum gives every (tile, share) its place, and each share writes there. No two threads write the same place and
the order inside a tile is the depth order, so the result does not depend on the number of threads.
"""

from __future__ import annotations

import math
from itertools import pairwise
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liftcore.raster.cpu.composite import circle_of
from liftcore.raster.cpu.project import CUTOFF, EXTENT_X, EXTENT_Y, KY, LEAN, MX, MY, ROOT_X, SLOPE
from liftcore.raster.cpu.simd import fetch_row
from liftcore.runtime.jit import inlined, kernel
from liftcore.scene.compositing import TILE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from liftcore.raster.cpu.composite import Frame

MOST_LISTED = 1 << 26  # tiles that all splats together may list before the view is cut into bands
BAND_ITEMS = 1 << 24  # of a band's lists, unless one tile has more: there may be several entries of W to each
_NO_LIMIT = int(np.iinfo(np.int64).max)
_AHEAD = 8  # splats between asking for a row and reading it: in the order of depth they lie anywhere
_DIGIT = 11  # bits a pass of the sort; three passes cover a float32
_BUCKETS = 1 << _DIGIT


@kernel
def depth_order(keys, places):
    """Sort ``places`` by their keys.

    Args:
        keys: [n] u32, the bits of positive float32 depths (they order like the depths).
        places: [n] i32, what to sort.

    Returns:
        [n] i32, the places from near to far.
    """
    n = keys.shape[0]
    other_keys = np.empty_like(keys)
    other_places = np.empty_like(places)
    counts = np.empty(_BUCKETS, np.int64)
    for turn in range(3):
        shift = np.uint32(turn * _DIGIT)
        counts[:] = 0
        for i in range(n):
            counts[(keys[i] >> shift) & np.uint32(_BUCKETS - 1)] += 1
        total = 0
        for b in range(_BUCKETS):
            count = counts[b]
            counts[b] = total
            total += count
        for i in range(n):
            bucket = (keys[i] >> shift) & np.uint32(_BUCKETS - 1)
            slot = counts[bucket]
            counts[bucket] = slot + 1
            other_keys[slot] = keys[i]
            other_places[slot] = places[i]
        keys, other_keys = other_keys, keys
        places, other_places = other_places, places
    return places


@inlined
def _tiles_between(low, high):
    """First and last tile of a row or column whose pixel centres lie between two places; none when none does."""
    return np.floor(np.ceil(low - 0.5) / TILE), np.floor(np.floor(high - 0.5) / TILE)


class _Outline(NamedTuple):
    """The outline of a projected splat, as numbers: an array would be counted at each use."""

    mx: float
    my: float
    extent_x: float
    extent_y: float
    slope: float
    root_x: float
    ky: float
    cutoff: float
    lean: float


@inlined
def _outline(splat):
    return _Outline(
        splat[MX], splat[MY], splat[EXTENT_X], splat[EXTENT_Y], splat[SLOPE],
        splat[ROOT_X], splat[KY], splat[CUTOFF], splat[LEAN],
    )  # fmt: skip


@inlined
def _tile_rows(outline, circle, rows):
    """First and last tile row whose pixel centres the splat can reach."""
    top, bottom = _tiles_between(outline.my - outline.extent_y, outline.my + outline.extent_y)
    if circle[2] >= 0:
        near_top, near_bottom = _tiles_between(circle[1] - circle[2], circle[1] + circle[2])
        top, bottom = min(top, near_top), max(bottom, near_bottom)
    return max(0.0, top), min(rows - 1.0, bottom)


@inlined
def _edge(outline, dy, side):
    """x of the outline's left (-1) or right (+1) edge at dy, relative to its centre."""
    room = max(0.0, outline.cutoff - outline.ky * dy * dy)
    return outline.slope * dy + side * math.sqrt(room) / outline.root_x


@inlined
def _outline_columns(outline, tile_row):
    """First and last tile column that the outline touches between a tile row's first and last pixel centres."""
    narrow, wide = _tiles_between(outline.mx - outline.extent_x, outline.mx + outline.extent_x)
    if narrow == wide:  # one column at most: no need to look closer
        return narrow, wide
    low = max(tile_row * TILE + 0.5 - outline.my, -outline.extent_y)
    high = min(tile_row * TILE + TILE - 0.5 - outline.my, outline.extent_y)
    if low > high:
        return 0.0, -1.0
    lean = outline.lean
    right = outline.extent_x if low <= lean <= high else _edge(outline, low if lean < low else high, 1.0)
    left = -outline.extent_x if low <= -lean <= high else _edge(outline, low if -lean < low else high, -1.0)
    return _tiles_between(outline.mx + left, outline.mx + right)


@inlined
def _tile_columns(outline, circle, tile_row, columns):
    """First and last tile column that the splat touches in a tile row."""
    first, last = _outline_columns(outline, tile_row)
    if circle[2] >= 0 and abs(tile_row * TILE + 0.5 * TILE - circle[1]) <= circle[2] + 0.5 * TILE:
        near_first, near_last = _tiles_between(circle[0] - circle[2], circle[0] + circle[2])
        if first > last:
            first, last = near_first, near_last
        else:
            first, last = min(first, near_first), max(last, near_last)
    return max(0.0, first), min(columns - 1.0, last)


def list_tiles(order, frame, span, most, counts) -> tuple[np.ndarray, np.ndarray]:
    """The tiles that each of ``order``'s splats touches, one splat after the other.

    Args:
        order: [n] i32, rows of projected splats. frame: the view, whose lists are still to be made.
        span: (first, last), the tiles that are listed, others are passed over.
        most: where more tiles than that are found, the list may end there.
        counts: [rows * columns] i64, zeros; receives how many splats touch each tile.

    Returns:
        lengths [n] i32, how many tiles each splat touches; tiles [sum] i32, row by row.
    """
    lengths, width = np.zeros(len(order), np.int32), span[1] - span[0]
    tiles = np.empty(4 * len(order) + width, np.int32)
    size = frame.rows, frame.columns
    done = count = 0
    while True:
        lists = lengths, tiles
        done, count = _list_while_room(order, (done, count), frame.kernel, frame.projected, size, span, counts, lists)
        if done == len(order) or count > most:
            return lengths, tiles[:count]
        tiles = np.concatenate((tiles, np.empty(len(tiles) + width, np.int32)))


@kernel
def _list_while_room(order, begin, kernel, projected, size, span, counts, lists):
    """``list_tiles`` from ``begin = (splat, tile of the list)`` on, while one that touches all tiles has room.

    Args:
        size: (rows, columns) of tiles. lists: (lengths, tiles), written.

    Returns:
        Where it ended, like ``begin``.
    """
    (first_one, count), (rows, columns), (start, end), (lengths, tiles) = begin, size, span, lists
    first_row, last_row = start // columns, (end - 1) // columns
    for i in range(first_one, order.shape[0]):
        if count + end - start > tiles.shape[0]:
            return i, count
        fetch_row(projected, order[min(i + _AHEAD, order.shape[0] - 1)])
        before, splat = count, projected[order[i]]
        outline, circle = _outline(splat), circle_of(kernel, splat)
        top, bottom = _tile_rows(outline, circle, rows)
        for tile_row in range(max(int(top), first_row), min(int(bottom), last_row) + 1):
            first, last = _tile_columns(outline, circle, tile_row, columns)
            tile_0 = tile_row * columns
            for tile in range(max(tile_0 + int(first), start), min(tile_0 + int(last) + 1, end)):
                tiles[count] = tile
                counts[tile] += 1
                count += 1
        lengths[i] = count - before
    return order.shape[0], count


@kernel
def fill_tiles(order, lengths, tiles, cursors, items):
    """Write ``order``'s places into ``items`` [n] i32 from each tile's cursor on."""
    at = 0
    for i in range(order.shape[0]):
        for _ in range(lengths[i]):
            tile = tiles[at]
            items[cursors[tile]] = order[i]
            cursors[tile] += 1
            at += 1


def _tile_places(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where every share writes.

    Args:
        counts: [shares, tiles] i64.

    Returns:
        starts [tiles + 1] i64 of each tile's list, cursors [shares, tiles] i64 of each share inside it.
    """
    by_tile = counts.T  # a tile's list holds the shares in depth order
    ends = np.cumsum(by_tile.ravel()).reshape(by_tile.shape)
    cursors = np.ascontiguousarray((ends - by_tile).T)
    starts = np.concatenate([[0], ends[:, -1]]).astype(np.int64)
    return starts, cursors


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
            self._edges = _cuts(self._counted(), BAND_ITEMS)

    def __iter__(self) -> Iterator[Frame]:
        """The frames, each made when it is asked for; other tiles than its own have empty lists."""
        for span in pairwise(self._edges):
            frame = self._whole or self._frame(span, _NO_LIMIT)
            assert frame is not None
            yield frame

    def _frame(self, span: tuple[int, int], most: int) -> Frame | None:
        """The frame of the tiles from ``span[0]`` to ``span[1]``; None where there are more than ``most`` items."""
        counts = np.zeros((len(self._parts), self._bare.rows * self._bare.columns), np.int64)
        found, lock = 0, Lock()

        def listed(part: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            nonlocal found
            room = most - found
            lengths, tiles = list_tiles(part if room >= 0 else part[:0], self._bare, span, max(0, room), counts)
            with lock:
                found += len(tiles)
            return lengths, tiles

        lists = self._run(listed, list(zip(self._parts, counts, strict=True)))
        if found > most:
            return None
        starts, cursors = _tile_places(counts)
        items = np.empty(starts[-1], np.int32)

        def fill(part: np.ndarray, lists: tuple[np.ndarray, np.ndarray], cursors: np.ndarray) -> None:
            fill_tiles(part, *lists, cursors, items)

        self._run(fill, list(zip(self._parts, lists, cursors, strict=True)))
        return self._bare._replace(starts=starts, items=items)

    def _counted(self) -> np.ndarray:
        """[tiles] i64: how many splats touch each tile, by lists that are not kept."""
        tiles = self._bare.rows * self._bare.columns
        at_a_time = max(1, BAND_ITEMS // tiles)

        def counted(part: np.ndarray) -> np.ndarray:
            counts = np.zeros(tiles, np.int64)
            for first in range(0, len(part), at_a_time):
                list_tiles(part[first : first + at_a_time], self._bare, (0, tiles), _NO_LIMIT, counts)
            return counts

        return np.sum(self._run(counted, [(part,) for part in self._parts]), axis=0)


def _cuts(counts: np.ndarray, most: int) -> list[int]:
    """Cuts between tiles such that runs of them have at most so many items, or are single tiles."""
    ends, edges = np.cumsum(counts), [0]
    while edges[-1] < len(counts):
        before = ends[edges[-1] - 1] if edges[-1] else 0
        edges.append(max(edges[-1] + 1, int(np.searchsorted(ends, before + most, side="right"))))
    return edges
