"""What a view takes on the device, for the plan."""

from __future__ import annotations

from liftcore.raster.constants import TILE
from liftcore.raster.gpu.frame import TABLE_FLOATS, TILES_AT_ONCE
from liftcore.raster.gpu.projection import SPLATS_AT_ONCE
from liftcore.raster.gpu.scene import INK, PLACE
from liftcore.raster.gpu.tile_lists import LIST_ITEMS
from liftcore.raster.gpu.walk import PART, PARTS
from liftcore.raster.gpu.weighing import ENTRIES
from liftcore.scene.splats import Kernel

_DOUBLE, _LONG, _FLOAT = 8, 8, 4
_TILES_A_SPLAT = 12  # that a splat touches, taken as many as scenes of photographs have
_SUMS_AN_ITEM = 4  # columns of sums of an item: label tuples, or cells, that a tile's pixels read
_A_PIXEL = 100  # of the readings: keys of four taps, sorted, and where they came from
_AN_ITEM = 90  # of the lists while they are made: tiles and places, sorted, and where they came from
_AN_ENTRY, _A_LEVEL = 44, 60  # of a sum that becomes rows: where it is from; its keys and values, sorted, a level


def raster_bytes(splats: int, width: int, height: int, kernel: Kernel, levels: int) -> int:
    """The peak on the device of the region weights of a view that sees all splats.

    The scene and its footprints are stated to the byte; how many tiles splats touch and how many regions a tile has
    is taken as usual, and both are cut into pieces of a fixed size, ``LIST_ITEMS``, ``TABLE_FLOATS`` and ``ENTRIES``,
    where a view has more.

    Args:
        splats: P. width, height: of the image, pixels. levels: of its labels; 1 for grids.
    """
    discs = kernel is Kernel.GAUSSIAN_2D
    axes = 6 if discs else 9
    scene = splats * (3 * _FLOAT + (axes + 3 + (kernel is Kernel.BETA)) * _DOUBLE)
    record = _FLOAT + (12 if discs else 9) * _DOUBLE + PLACE * _DOUBLE + INK * _FLOAT
    made = 120 if discs else 60  # float64 columns while footprints are made
    footprints = 2 * splats * record + min(splats, SPLATS_AT_ONCE) * made * _DOUBLE
    tiles = -(-width // TILE) * -(-height // TILE)
    items = min(splats * min(tiles, _TILES_A_SPLAT), LIST_ITEMS)
    run = min(tiles, TILES_AT_ONCE)
    table = min(items * _SUMS_AN_ITEM, TABLE_FLOATS)
    walk = run * (2 * PARTS * PART * _FLOAT + TILE * TILE * _A_PIXEL)
    sums = table * (_FLOAT + _LONG) + min(table, ENTRIES) * (_AN_ENTRY + _A_LEVEL * levels)
    labels = width * height * levels * _LONG
    return scene + footprints + items * _AN_ITEM + walk + sums + labels
