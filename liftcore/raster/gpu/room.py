"""How much of a view is held on the device at a time: all of it where it fits, pieces of it where it does not.

No bit of a product depends on it. Where memory is short, the scene stays on the host and comes in blocks, and a view
is walked in strips of tile rows, each with footprints and lists of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

from liftcore.raster.base import TILE
from liftcore.raster.gpu.scene import INK, PLACE
from liftcore.raster.gpu.walk import PART, PARTS
from liftcore.scene.splats import Kernel

_DOUBLE, _FLOAT = 8, 4
SPLATS = 1 << 20  # projected at a time
SPANNED = 1 << 18  # splats whose spans are made at a time
ITEMS = 1 << 24  # of the lists that are held at a time; a single tile row may have more
TILES = 4096  # programs of a launch, each with scratch of its own
TABLE = 1 << 26  # floats of a launch's table of sums; a single unit of tiles may need more
ENTRY_BYTES = 1 << 30  # of sums that become rows of splats at a time; likewise
LEAST_SPLATS, LEAST_ITEMS, LEAST_TILES, LEAST_TABLE = 1 << 12, 1 << 14, 32, 1 << 16
LEAST_ENTRY_BYTES = LEAST_KEPT = 1 << 22

A_PIXEL = 100  # keys of four taps, sorted, and their origin; or its largest weights, in as many tiles as that holds
A_TILE = 2 * PARTS * PART * _FLOAT + TILE * TILE * A_PIXEL  # scratch, and its pixels
AN_ITEM = 90  # of the lists while they are made: tiles and places, sorted, and where they came from
A_SPAN = 32  # of a footprint's tiles in a tile row, twice while they are put together
A_SPANNED = 1100  # of a splat while its spans are made, in three or four tile rows
A_FLOAT = 12  # of a table: itself, and where it is not zero
A_SEEN = 48  # of a splat in the survey: its depth, its rows, and both in order
SCENE_SHARE, FOOTPRINT_SHARE, SURVEY_SHARE, PIECE_SHARE, KEPT_SHARE = 0.25, 0.2, 0.1, 0.25, 0.1  # SPARE in sum
SPARE = 0.9  # of the free memory: what is freed does not lie in one piece


@dataclass(frozen=True)
class Room:
    """Sizes of what is held at a time; None where there is no limit."""

    scene: int | None  # bytes of a scene that lies on the device
    footprints: int | None  # bytes of the footprints of a strip
    survey: int | None  # bytes of a survey that is made on the device
    kept: int | None  # bytes of finished sums that wait there for others
    splats: int = SPLATS
    spanned: int = SPANNED
    items: int = ITEMS
    tiles: int = TILES
    table: int = TABLE
    entry_bytes: int = ENTRY_BYTES


AMPLE = Room(None, None, None, None)


def room_within(free: int | None, kernel: Kernel, need: int) -> Room:
    """The pieces for ``free`` bytes, where ``need`` are what a view takes in one piece; None for no limit."""
    if free is None or need <= SPARE * free:
        return AMPLE
    shrunk = min(1.0, PIECE_SHARE * free / pieces_bytes(AMPLE, kernel))
    return Room(
        scene=int(SCENE_SHARE * free),
        footprints=int(FOOTPRINT_SHARE * free),
        survey=int(SURVEY_SHARE * free),
        kept=max(LEAST_KEPT, int(KEPT_SHARE * free)),
        splats=max(LEAST_SPLATS, int(shrunk * SPLATS)),
        spanned=max(LEAST_SPLATS, int(shrunk * SPANNED)),
        items=max(LEAST_ITEMS, int(shrunk * ITEMS)),
        tiles=max(LEAST_TILES, int(shrunk * TILES)),
        table=max(LEAST_TABLE, int(shrunk * TABLE)),
        entry_bytes=max(LEAST_ENTRY_BYTES, int(shrunk * ENTRY_BYTES)),
    )


def pieces_bytes(room: Room, kernel: Kernel) -> int:
    """Bytes of all pieces at their largest."""
    projected = room.splats * made_bytes(kernel) + room.spanned * A_SPANNED
    return projected + room.items * AN_ITEM + room.tiles * A_TILE + room.table * A_FLOAT + room.entry_bytes


def scene_bytes(splats: int, kernel: Kernel) -> int:
    """Bytes of the activated splats."""
    axes = 6 if kernel is Kernel.GAUSSIAN_2D else 9
    return splats * (3 * _FLOAT + (axes + 3 + (kernel is Kernel.BETA)) * _DOUBLE)


def footprint_bytes(kernel: Kernel) -> int:
    """Bytes of a footprint, its spans included, while footprints are put in order: all but the spans twice."""
    outline = (12 if kernel is Kernel.GAUSSIAN_2D else 9) * _DOUBLE
    return 2 * (_FLOAT + outline + PLACE * _DOUBLE + INK * _FLOAT) + 4 * A_SPAN


def made_bytes(kernel: Kernel) -> int:
    """Bytes between a splat and its footprint: columns of float64."""
    return (120 if kernel is Kernel.GAUSSIAN_2D else 60) * _DOUBLE
