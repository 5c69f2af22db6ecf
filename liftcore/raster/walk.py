"""The walk of a tile's rays through its splats: one splat's weights on up to 256 pixels at a time.

A tile is 16 rows of two half rows of eight pixels. Products (region weights, renders, ...) call ``touches`` and
``blend`` for each half row and use the weights at once, while they are in the cache.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from liftcore.jit import inlined, kernel
from liftcore.lanes import (
    LANES,
    PLAIN_TRANSMITTANCE,
    TRANSMITTANCE,
    blend_both_lanes,
    blend_both_squared_lanes,
    blend_lanes,
    blend_squared_lanes,
    new_state,
)
from liftcore.raster.constants import ALPHA_FLOOR, TILE
from liftcore.raster.projection import EXTENT_Y, KX, KY, MX, MY, OPACITY, PLAIN, REACH, SLOPE

HALVES = TILE * TILE // LANES  # half rows of a tile
CHECK_EVERY = 16  # splats between two looks at which half rows still let light through


class Frame(NamedTuple):
    """One view, projected and binned."""

    records: np.ndarray  # [P, RECORD] f64, footprints; rows in use are named by ids
    ids: np.ndarray  # [P] i32, the splat of a record
    starts: np.ndarray  # [tiles + 1] i64, each tile's list in items
    items: np.ndarray  # [n] i32, records, near to far in each tile
    columns: int  # tiles a row
    rows: int  # rows of tiles
    width: int  # pixels
    height: int  # pixels
    cap: float
    stop: float


class Rays(NamedTuple):
    """The state of a tile's 256 rays."""

    state: np.ndarray  # [STATE] f32, laid out as liftcore.lanes says
    alive: np.ndarray  # [32] u8, half rows that still let light through, with or without the gain


@kernel
def new_rays(frame):
    """Room for one tile's rays."""
    return Rays(new_state(ALPHA_FLOOR, frame.cap, frame.stop), np.zeros(HALVES, np.uint8))


@kernel
def start_rays(rays, frame, tile):
    """Light every ray of a tile that lies inside the image."""
    x0 = (tile % frame.columns) * TILE
    y0 = (tile // frame.columns) * TILE
    for y in range(TILE):
        for x in range(TILE):
            light = np.float32(x0 + x < frame.width and y0 + y < frame.height)
            rays.state[TRANSMITTANCE + y * TILE + x] = light
            rays.state[PLAIN_TRANSMITTANCE + y * TILE + x] = light


@kernel
def look(rays, with_plain):
    """Note which half rows still let light through, with or without the gain; whether any does."""
    any_alive = False
    for half in range(HALVES):
        light = np.float32(0.0)
        for lane in range(LANES):
            light = max(light, rays.state[TRANSMITTANCE + half * LANES + lane])
        if with_plain:
            for lane in range(LANES):
                light = max(light, rays.state[PLAIN_TRANSMITTANCE + half * LANES + lane])
        rays.alive[half] = light > 0
        any_alive |= light > 0
    return any_alive


class Footprint(NamedTuple):
    """One splat as a tile sees it: the record relative to the tile's first pixel centre."""

    top: int  # first pixel row of the tile that it can reach
    bottom: int  # last one; before the first when there is none
    mx: float
    my: float
    slope: float
    kx: float
    ky: float
    reach: float
    opacity: float
    plain: float  # opacity without the gain


@inlined
def footprint(records, place, x0, y0):
    """The record of a splat for the tile whose first pixel is (x0, y0)."""
    my = records[place, MY] - y0 - 0.5
    extent = records[place, EXTENT_Y]
    return Footprint(
        int(max(0.0, np.ceil(my - extent))),
        int(min(TILE - 1.0, np.floor(my + extent))),
        records[place, MX] - x0 - 0.5,
        my,
        records[place, SLOPE],
        records[place, KX],
        records[place, KY],
        records[place, REACH],
        records[place, OPACITY],
        records[place, PLAIN],
    )


@inlined
def row_centre(splat, row):
    """The footprint in one pixel row: its centre in lanes, its exponent there."""
    dy = row - splat.my
    return splat.mx + splat.slope * dy, splat.ky * dy * dy


@inlined
def touches(splat, centre, base, side):
    """Whether any lane of half row ``side`` (0 left, 1 right) can reach the alpha floor."""
    near = max(0.0, side * LANES - centre, centre - (side * LANES + LANES - 1))
    return splat.kx * near * near + base <= splat.reach


@inlined
def blend(rays, splat, centre, base, half):
    """Composite the splat over half row ``half``: its weights are in the state, and in the evidence lanes."""
    start = np.float32((half % 2) * LANES - centre)
    shape = (start, np.float32(splat.kx), np.float32(base), np.float32(splat.opacity))
    blend_lanes(rays.state, half * LANES, shape)


@inlined
def blend_power(rays, splat, centre, base, half, power, with_plain):
    """``blend`` that leaves weights or squared weights; with the evidence from plain rays if asked."""
    start = np.float32((half % 2) * LANES - centre)
    shape = (start, np.float32(splat.kx), np.float32(base), np.float32(splat.opacity))
    both = (*shape, np.float32(splat.plain))
    if with_plain and power == 2:
        blend_both_squared_lanes(rays.state, half * LANES, both)
    elif with_plain:
        blend_both_lanes(rays.state, half * LANES, both)
    elif power == 2:
        blend_squared_lanes(rays.state, half * LANES, shape)
    else:
        blend_lanes(rays.state, half * LANES, shape)
