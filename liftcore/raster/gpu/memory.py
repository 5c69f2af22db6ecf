"""What a view takes on the device, for the plan."""

from __future__ import annotations

from liftcore.raster.base import TILE
from liftcore.raster.gpu import room
from liftcore.raster.gpu.sums import A_KEY, A_SUM
from liftcore.raster.gpu.weighing import A_LEVEL, AN_ENTRY
from liftcore.scene.splats import Kernel

USUAL_LEVELS = 4  # of labels, for products that read none
_LABEL = 12  # bytes, of a pixel and level: as it came, and as a key
_TILES_A_SPLAT = 12  # that a splat touches, taken as many as scenes of photographs have
_ROWS_A_SPLAT = 4  # of tiles, likewise
_UNITS_A_SPLAT = 4  # of tiles, each with a sum of a splat and label of its own: about one a row
_SUMS_AN_ITEM = 4  # columns of sums of an item: label tuples, or cells, that a tile's pixels read


def raster_bytes(splats: int, width: int, height: int, kernel: Kernel, levels: int) -> int:
    """The peak on the device of the region weights of a view that sees all splats, in one piece.

    The scene and its footprints are stated to the byte; how many tiles splats touch and how many regions a tile has
    is taken as usual, and both are cut into pieces of a fixed size (``AMPLE``) where a view has more.

    Args:
        splats: P. width, height: of the image, pixels. levels: of its labels; 1 for grids.
    """
    ample, tiles = room.AMPLE, _tiles(width, height)
    made = min(splats, ample.splats) * room.made_bytes(kernel) + min(splats, ample.spanned) * room.A_SPANNED
    items = min(splats * min(tiles, _TILES_A_SPLAT), ample.items)
    table = min(items * _SUMS_AN_ITEM, ample.table)
    entries = min(table * (AN_ENTRY + A_LEVEL * levels), ample.entry_bytes)
    pieces = made + items * room.AN_ITEM + min(tiles, ample.tiles) * room.A_TILE + table * room.A_FLOAT + entries
    held = room.scene_bytes(splats, kernel) + splats * room.footprint_bytes(kernel)
    joined = splats * levels * _UNITS_A_SPLAT * (A_KEY + A_SUM)  # of all units at once, where there is room for it
    return held + pieces + joined + width * height * levels * _LABEL


def least_raster_bytes(splats: int, width: int, height: int, kernel: Kernel, levels: int) -> int:
    """About what the same takes at least, cut as finely as it can be, with the scene on the host.

    That is the footprints and the lists of a row of tiles, taken twice as long as the mean, and a view's labels.
    """
    rows = -(-height // TILE)
    own = 2 * splats * min(_ROWS_A_SPLAT, rows) // rows
    items = 2 * splats * min(_tiles(width, height), _TILES_A_SPLAT) // rows
    pieces = room.pieces_bytes(room.room_within(0, kernel, 1), kernel) + room.LEAST_KEPT
    cut = own * room.footprint_bytes(kernel) + items * room.AN_ITEM + pieces + width * height * levels * _LABEL
    return min(cut, raster_bytes(splats, width, height, kernel, levels))  # small views are no larger than pieces


def _tiles(width: int, height: int) -> int:
    return -(-width // TILE) * -(-height // TILE)
