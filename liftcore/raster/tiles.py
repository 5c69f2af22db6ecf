"""Which splats touch which tile: a counting sort of the depth order into 16 x 16 pixel tiles.

The depth order is cut into a fixed number of shares; each share lists its tiles and counts them, a prefix sum gives
every (tile, share) its place, and each share writes there. No two threads write the same place and the order inside a
tile is the depth order, so the result does not depend on the number of threads.
"""

from __future__ import annotations

import math

import numpy as np

from liftcore.jit import inlined, kernel
from liftcore.raster.constants import TILE
from liftcore.raster.projection import EXTENT_X, EXTENT_Y, KX, KY, LEAN, MX, MY, REACH, SLOPE


@inlined
def _tile_rows(record, rows):
    """First and last tile row whose pixel centres the footprint can reach."""
    top = np.floor((np.ceil(record[MY] - record[EXTENT_Y] - 0.5)) / TILE)
    bottom = np.floor((np.floor(record[MY] + record[EXTENT_Y] - 0.5)) / TILE)
    return max(0.0, top), min(rows - 1.0, bottom)


@inlined
def _edge(record, dy, side):
    """x of the footprint's left (-1) or right (+1) edge at dy, relative to its centre."""
    room = max(0.0, record[REACH] - record[KY] * dy * dy)
    return record[SLOPE] * dy + side * math.sqrt(room / record[KX])


@inlined
def _tile_columns(record, tile_row, columns):
    """First and last tile column that the footprint touches between a tile row's first and last pixel centres."""
    narrow = np.floor(np.ceil(record[MX] - record[EXTENT_X] - 0.5) / TILE)
    wide = np.floor(np.floor(record[MX] + record[EXTENT_X] - 0.5) / TILE)
    if narrow == wide:  # one column at most: no need to look closer
        return max(0.0, narrow), min(columns - 1.0, wide)
    low = max(tile_row * TILE + 0.5 - record[MY], -record[EXTENT_Y])
    high = min(tile_row * TILE + TILE - 0.5 - record[MY], record[EXTENT_Y])
    if low > high:
        return 0.0, -1.0
    lean = record[LEAN]
    right = record[EXTENT_X] if low <= lean <= high else _edge(record, low if lean < low else high, 1.0)
    left = -record[EXTENT_X] if low <= -lean <= high else _edge(record, low if -lean < low else high, -1.0)
    first = np.floor(np.ceil(record[MX] + left - 0.5) / TILE)
    last = np.floor(np.floor(record[MX] + right - 0.5) / TILE)
    return max(0.0, first), min(columns - 1.0, last)


@kernel
def list_tiles(order, records, rows, columns, counts):
    """The tiles that each of ``order``'s footprints touches, one footprint after the other.

    Args:
        counts: [rows * columns] i64, zeros; receives how many footprints touch each tile.

    Returns:
        lengths [n] i32, how many tiles each footprint touches; tiles [sum] i32, row by row.
    """
    lengths = np.zeros(order.shape[0], np.int32)
    tiles = np.empty(max(1024, 4 * order.shape[0]), np.int32)
    count = 0
    for i in range(order.shape[0]):
        record = records[order[i]]
        before = count
        top, bottom = _tile_rows(record, rows)
        for tile_row in range(int(top), int(bottom) + 1):
            first, last = _tile_columns(record, tile_row, columns)
            if count + columns > tiles.shape[0]:
                tiles = np.concatenate((tiles, np.empty_like(tiles), np.empty(columns, np.int32)))
            for column in range(int(first), int(last) + 1):
                tile = tile_row * columns + column
                tiles[count] = tile
                counts[tile] += 1
                count += 1
        lengths[i] = count - before
    return lengths, tiles[:count]


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
