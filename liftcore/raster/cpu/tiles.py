"""Depth order and tile lists: the splats that touch each 16 x 16 pixel tile, near to far.

The depth order is a stable sort of float32 depths; ties keep the order of the splats' rows, so the order, and with it
every product, is unique. It is split into a fixed number of shares; each share lists and counts its tiles, a prefix
sum gives every (tile, share) its offset, and each share writes there. No two threads write to the same memory and the
order inside a tile is the depth order, so the result does not depend on the number of threads.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liftcore.raster.cpu.composite import circle_of
from liftcore.raster.cpu.project import CUTOFF, EXTENT_X, EXTENT_Y, MX, MY, RIGHTMOST_DY, SLOPE, SQRT_A, C
from liftcore.raster.cpu.simd import fetch_row
from liftcore.runtime.jit import inlined, kernel
from liftcore.scene.compositing import TILE

if TYPE_CHECKING:
    from collections.abc import Callable

    from liftcore.raster.cpu.composite import Frame

_PREFETCH = 8  # splats by which rows are prefetched: in depth order they are scattered in memory
_DIGIT = 11  # bits per pass of the radix sort; three passes cover a float32
_BUCKETS = 1 << _DIGIT


@kernel
def depth_order(keys, places):
    """Sort ``places`` by their keys.

    Args:
        keys: [n] u32, the bits of positive float32 depths (they sort like the depths).
        places: [n] i32, rows of projected splats.

    Returns:
        [n] i32, the places from near to far.
    """
    n = keys.shape[0]
    other_keys = np.empty_like(keys)
    other_places = np.empty_like(places)
    counts = np.empty(_BUCKETS, np.int64)
    for digit in range(3):
        shift = np.uint32(digit * _DIGIT)
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
    """Return the first and last tile of a row or column with pixel centres in low..high; first > last if there is
    none.
    """
    return np.floor(np.ceil(low - 0.5) / TILE), np.floor(np.floor(high - 0.5) / TILE)


class _Outline(NamedTuple):
    """The outline of a projected splat, as scalars: numba would count references to an array at each use."""

    mx: float
    my: float
    extent_x: float
    extent_y: float
    slope: float
    sqrt_a: float
    c: float
    cutoff: float
    rightmost_dy: float


@inlined
def _outline(splat):
    return _Outline(
        splat[MX], splat[MY], splat[EXTENT_X], splat[EXTENT_Y], splat[SLOPE],
        splat[SQRT_A], splat[C], splat[CUTOFF], splat[RIGHTMOST_DY],
    )  # fmt: skip


@inlined
def _tile_rows(outline, circle, rows):
    """Return the first and last tile row whose pixel centres the splat can cover."""
    top, bottom = _tiles_between(outline.my - outline.extent_y, outline.my + outline.extent_y)
    if circle[2] >= 0:
        near_top, near_bottom = _tiles_between(circle[1] - circle[2], circle[1] + circle[2])
        top, bottom = min(top, near_top), max(bottom, near_bottom)
    return max(0.0, top), min(rows - 1.0, bottom)


@inlined
def _edge(outline, dy, side):
    """Return x of the outline's left (-1) or right (+1) edge at dy, relative to its centre."""
    remainder = max(0.0, outline.cutoff - outline.c * dy * dy)
    return outline.slope * dy + side * math.sqrt(remainder) / outline.sqrt_a


@inlined
def _outline_columns(outline, tile_row):
    """Return the first and last tile column that the outline touches between the pixel centres of a tile row."""
    narrow, wide = _tiles_between(outline.mx - outline.extent_x, outline.mx + outline.extent_x)
    if narrow == wide:  # at most one column: no closer bound is needed
        return narrow, wide
    low = max(tile_row * TILE + 0.5 - outline.my, -outline.extent_y)
    high = min(tile_row * TILE + TILE - 0.5 - outline.my, outline.extent_y)
    if low > high:
        return 0.0, -1.0
    rightmost_dy = outline.rightmost_dy
    right = (
        outline.extent_x if low <= rightmost_dy <= high else _edge(outline, low if rightmost_dy < low else high, 1.0)
    )
    left = (
        -outline.extent_x
        if low <= -rightmost_dy <= high
        else _edge(outline, low if -rightmost_dy < low else high, -1.0)
    )
    return _tiles_between(outline.mx + left, outline.mx + right)


@inlined
def _tile_columns(outline, circle, tile_row, columns):
    """Return the first and last tile column that the splat touches in a tile row."""
    first, last = _outline_columns(outline, tile_row)
    if circle[2] >= 0 and abs(tile_row * TILE + 0.5 * TILE - circle[1]) <= circle[2] + 0.5 * TILE:
        near_first, near_last = _tiles_between(circle[0] - circle[2], circle[0] + circle[2])
        if first > last:
            first, last = near_first, near_last
        else:
            first, last = min(first, near_first), max(last, near_last)
    return max(0.0, first), min(columns - 1.0, last)


def list_tiles(order: np.ndarray, frame: Frame, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List the tiles that each of ``order``'s splats touches, splat by splat.

    Args:
        order: [n] i32, rows of projected splats. frame: the view, still without lists.
        counts: [rows * columns] i64, zeros; receives the number of splats of each tile.

    Returns:
        lengths [n] i32, the number of tiles of each splat; tiles [sum] i32, row by row.
    """
    lengths, size = np.zeros(len(order), np.int32), (frame.rows, frame.columns)
    tiles = np.empty(4 * len(order) + len(counts), np.int32)
    first = count = 0
    while True:
        lists = lengths, tiles
        first, count = _list_until_full(order, (first, count), frame.kernel, frame.projected, size, counts, lists)
        if first == len(order):
            return lengths, tiles[:count]
        tiles = np.concatenate((tiles, np.empty(len(tiles) + len(counts), np.int32)))


@kernel
def _list_until_full(order, begin, kernel, projected, size, counts, lists):
    """Continue ``list_tiles`` from ``begin = (splat, item of the list)`` on, until a splat might not fit.

    Args:
        size: (rows, columns) of tiles. lists: (lengths, tiles), written.

    Returns:
        The next splat and item, as ``begin``.
    """
    (first_one, count), (rows, columns), (lengths, tiles) = begin, size, lists
    for i in range(first_one, order.shape[0]):
        if count + rows * columns > tiles.shape[0]:
            return i, count
        fetch_row(projected, order[min(i + _PREFETCH, order.shape[0] - 1)])
        before, splat = count, projected[order[i]]
        outline, circle = _outline(splat), circle_of(kernel, splat)
        top, bottom = _tile_rows(outline, circle, rows)
        for tile_row in range(int(top), int(bottom) + 1):
            first, last = _tile_columns(outline, circle, tile_row, columns)
            for tile in range(tile_row * columns + int(first), tile_row * columns + int(last) + 1):
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
    """Return the offsets at which every share writes.

    Args:
        counts: [shares, tiles] i64.

    Returns:
        starts [tiles + 1] i64 of each tile's list, cursors [shares, tiles] i64 of each share inside it.
    """
    by_tile = counts.T  # in a tile's list the shares follow in depth order
    ends = np.cumsum(by_tile.ravel()).reshape(by_tile.shape)
    cursors = np.ascontiguousarray((ends - by_tile).T)
    starts = np.concatenate([[0], ends[:, -1]]).astype(np.int64)
    return starts, cursors


def bin_tiles(frame: Frame, parts: list[np.ndarray], run: Callable[[Callable, list], list]) -> Frame:
    """Return a projected view with the lists of its tiles.

    Args:
        frame: the view, with empty lists.
        parts: the depth order, in shares.
        run: calls a function for each of a list of argument tuples, and returns the list of results.
    """
    counts = np.zeros((len(parts), frame.rows * frame.columns), np.int64)
    lists = run(lambda part, counts: list_tiles(part, frame, counts), list(zip(parts, counts, strict=True)))
    starts, cursors = _tile_places(counts)
    items = np.empty(starts[-1], np.int32)

    def fill(part: np.ndarray, lists: tuple[np.ndarray, np.ndarray], cursors: np.ndarray) -> None:
        fill_tiles(part, *lists, cursors, items)

    run(fill, list(zip(parts, lists, cursors, strict=True)))
    return frame._replace(starts=starts, items=items)
