"""Which splats touch which tile: a counting sort of the depth order into 16 x 16 pixel tiles.

The depth order is cut into a fixed number of shares; each share lists its tiles and counts them, a prefix sum gives
every (tile, share) its place, and each share writes there. No two threads write the same place and the order inside a
tile is the depth order, so the result does not depend on the number of threads.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from liftcore.jit import inlined, kernel
from liftcore.raster.constants import TILE
from liftcore.raster.cpu.footprints import circle_of
from liftcore.raster.cpu.lanes import fetch_ahead
from liftcore.raster.cpu.records import EXTENT_X, EXTENT_Y, KY, LEAN, MX, MY, REACH, ROOT_X, SLOPE

AHEAD = 8  # footprints between asking for a record and reading it: in the order of depth they lie anywhere


@inlined
def _tiles_between(low, high):
    """First and last tile of a row or column whose pixel centres lie between two places; none when none does."""
    return np.floor(np.ceil(low - 0.5) / TILE), np.floor(np.floor(high - 0.5) / TILE)


class Outline(NamedTuple):
    """What a record says of its footprint's outline, as numbers: an array would be counted at each use."""

    mx: float
    my: float
    extent_x: float
    extent_y: float
    slope: float
    root_x: float
    ky: float
    reach: float
    lean: float


@inlined
def _outline(record):
    return Outline(
        record[MX], record[MY], record[EXTENT_X], record[EXTENT_Y], record[SLOPE],
        record[ROOT_X], record[KY], record[REACH], record[LEAN],
    )  # fmt: skip


@inlined
def _tile_rows(outline, circle, rows):
    """First and last tile row whose pixel centres the footprint can reach."""
    top, bottom = _tiles_between(outline.my - outline.extent_y, outline.my + outline.extent_y)
    if circle[2] >= 0:
        near_top, near_bottom = _tiles_between(circle[1] - circle[2], circle[1] + circle[2])
        top, bottom = min(top, near_top), max(bottom, near_bottom)
    return max(0.0, top), min(rows - 1.0, bottom)


@inlined
def _edge(outline, dy, side):
    """x of the footprint's left (-1) or right (+1) edge at dy, relative to its centre."""
    room = max(0.0, outline.reach - outline.ky * dy * dy)
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
    """First and last tile column that the footprint touches in a tile row."""
    first, last = _outline_columns(outline, tile_row)
    if circle[2] >= 0 and abs(tile_row * TILE + 0.5 * TILE - circle[1]) <= circle[2] + 0.5 * TILE:
        near_first, near_last = _tiles_between(circle[0] - circle[2], circle[0] + circle[2])
        if first > last:
            first, last = near_first, near_last
        else:
            first, last = min(first, near_first), max(last, near_last)
    return max(0.0, first), min(columns - 1.0, last)


@kernel
def list_tiles(order, kernel, records, size, span, most, counts):
    """The tiles that each of ``order``'s footprints touches, one footprint after the other.

    Args:
        order: [n] i32, places of records. kernel: of the frame, as liftcore.raster.cpu.footprints says.
        size: (rows, columns) of tiles. span: (first, last), the tiles that are listed, others are passed over.
        most: where more tiles than that are found, the list may end there.
        counts: [rows * columns] i64, zeros; receives how many footprints touch each tile.

    Returns:
        lengths [n] i32, how many tiles each footprint touches; tiles [sum] i32, row by row.
    """
    lengths = np.zeros(order.shape[0], np.int32)
    tiles = np.empty(4 * order.shape[0] + span[1] - span[0], np.int32)
    lists = lengths, tiles
    done, count = _list_while_room(order, (0, 0), kernel, records, (size, span), counts, lists)
    while done < order.shape[0] and count <= most:
        tiles = np.concatenate((tiles, np.empty(tiles.shape[0] + span[1] - span[0], np.int32)))
        lists = lengths, tiles
        done, count = _list_while_room(order, (done, count), kernel, records, (size, span), counts, lists)
    return lengths, tiles[:count]


@kernel
def _list_while_room(order, begin, kernel, records, window, counts, lists):
    """``list_tiles`` from ``begin = (footprint, tile of the list)`` on, while one that touches all tiles has room.

    A function of its own, as arrays that are replaced in a loop are counted at each use in it.

    Args:
        window: (size, span). lists: (lengths, tiles), written.

    Returns:
        Where it ended, like ``begin``.
    """
    (first_one, count), ((rows, columns), (start, end)), (lengths, tiles) = begin, window, lists
    first_row, last_row = start // columns, (end - 1) // columns
    for i in range(first_one, order.shape[0]):
        if count + end - start > tiles.shape[0]:
            return i, count
        fetch_ahead(records, order[min(i + AHEAD, order.shape[0] - 1)])
        before, record = count, records[order[i]]
        outline, circle = _outline(record), circle_of(kernel, record)
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


def tile_places(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
