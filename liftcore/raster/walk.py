"""The walk of a tile's rays through its splats: one splat's weights on up to 256 pixels at a time.

A tile is 16 rows of two half rows of eight pixels. Products (region weights, renders, ...) call ``touches`` and
``blend`` for each half row and use the weights at once, while they are in the cache.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from liftcore.raster.constants import ALPHA_FLOOR, TILE
from liftcore.raster.lanes import LANES, blend_lanes, gaussian_lanes
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

    transmittance: np.ndarray  # [256] f32, 0 = done
    weights: np.ndarray  # [256] f32, of the splat at hand
    falloff: np.ndarray  # [256] f32, of the splat at hand
    alive: np.ndarray  # [32] u8, half rows that still let light through


@njit(nogil=True, cache=True)
def new_rays():
    """Room for one tile's rays."""
    pixels = TILE * TILE
    return Rays(
        np.zeros(pixels, np.float32),
        np.zeros(pixels, np.float32),
        np.zeros(pixels, np.float32),
        np.zeros(HALVES, np.uint8),
    )


@njit(nogil=True, cache=True)
def start_rays(rays, frame, tile):
    """Light every ray of a tile that lies inside the image."""
    x0 = (tile % frame.columns) * TILE
    y0 = (tile // frame.columns) * TILE
    for y in range(TILE):
        for x in range(TILE):
            inside = x0 + x < frame.width and y0 + y < frame.height
            rays.transmittance[y * TILE + x] = np.float32(1.0) if inside else np.float32(0.0)
    look(rays)


@njit(nogil=True, cache=True)
def look(rays):
    """Note which half rows still let light through; whether any does."""
    any_alive = False
    for half in range(HALVES):
        light = np.float32(0.0)
        for lane in range(LANES):
            light = max(light, rays.transmittance[half * LANES + lane])
        rays.alive[half] = light > 0
        any_alive |= light > 0
    return any_alive


@njit(nogil=True, cache=True, inline="always")
def row_range(record, y0):
    """The tile's first and last pixel row that the footprint can reach (last < first: none)."""
    top = np.ceil(record[MY] - record[EXTENT_Y] - 0.5 - y0)
    bottom = np.floor(record[MY] + record[EXTENT_Y] - 0.5 - y0)
    return int(max(0.0, top)), int(min(TILE - 1.0, bottom))


@njit(nogil=True, cache=True, inline="always")
def row_centre(record, row, x0, y0):
    """The footprint in one pixel row: its centre in lanes from x0, its exponent there."""
    dy = y0 + row + 0.5 - record[MY]
    return record[MX] + record[SLOPE] * dy - x0 - 0.5, record[KY] * dy * dy


@njit(nogil=True, cache=True, inline="always")
def touches(record, centre, base, side):
    """Whether any lane of half row ``side`` (0 left, 1 right) can reach the alpha floor."""
    near = max(0.0, max(side * LANES - centre, centre - (side * LANES + LANES - 1)))
    return record[KX] * near * near + base <= record[REACH]


@njit(nogil=True, cache=True, inline="always")
def blend(rays, record, centre, base, half, limits):
    """Composite the splat over half row ``half``; its weights lie in ``rays.weights`` afterwards.

    ``limits = (cap, stop)`` as float32.
    """
    offset = half * LANES
    start = np.float32((half % 2) * LANES - centre)
    gaussian_lanes(rays.falloff, offset, start, np.float32(record[KX]), np.float32(base))
    alpha = (np.float32(record[OPACITY]), limits[0], np.float32(ALPHA_FLOOR), limits[1])
    blend_lanes(rays.weights, offset, rays.falloff, rays.transmittance, offset, alpha)


@njit(nogil=True, cache=True, inline="always")
def blend_plain(plain, falloff, record, half, limits):
    """The same splat for the rays without opacity gain, from the falloff that ``blend`` left."""
    offset = half * LANES
    alpha = (np.float32(record[PLAIN]), limits[0], np.float32(ALPHA_FLOOR), limits[1])
    blend_lanes(plain.weights, offset, falloff, plain.transmittance, offset, alpha)
