"""The walk of a tile's rays through its splats: one splat's weights on up to 256 pixels at a time.

A tile is 16 rows of two half rows of eight pixels. Products (region weights, renders, ...) call ``touches`` and
``blend`` for each half row and use the weights at once, while they are in the cache.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from liftcore.jit import inlined, kernel
from liftcore.lanes import LANES, PLAIN_TRANSMITTANCE, TRANSMITTANCE
from liftcore.lanes_blend import blend_lanes, blend_squared_lanes, new_state
from liftcore.raster.constants import TILE
from liftcore.raster.footprints import Betas, Discs, Gaussians, lanes_of

HALVES = TILE * TILE // LANES  # half rows of a tile
CHECK_EVERY = 16  # splats between two looks at which half rows still let light through


class Frame(NamedTuple):
    """One view, projected and binned."""

    kernel: Gaussians | Betas | Discs  # its class is the footprint's, at compile time
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

    state: np.ndarray  # [STATE] f32, laid out as liftcore.lanes and liftcore.lanes_blend say
    alive: np.ndarray  # [32] u8, half rows that still let light through, with or without the gain


@kernel
def new_rays(frame):
    """Room for one tile's rays."""
    return Rays(new_state(frame.kernel.floor, frame.cap, frame.stop), np.zeros(HALVES, np.uint8))


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


@inlined
def blend(rays, splat, line, half):
    """Composite the splat over half row ``half``: its weights are in the state, and in the evidence lanes."""
    blend_lanes(rays.state, half * LANES, lanes_of(splat, line, half % 2), (np.float32(splat.opacity),))


@inlined
def blend_power(rays, splat, line, half, power, with_plain):
    """``blend`` that leaves weights or squared weights; with the evidence from plain rays if asked."""
    shape = lanes_of(splat, line, half % 2)
    alone = (np.float32(splat.opacity),)
    both = (np.float32(splat.opacity), np.float32(splat.plain))
    if with_plain and power == 2:
        blend_squared_lanes(rays.state, half * LANES, shape, both)
    elif with_plain:
        blend_lanes(rays.state, half * LANES, shape, both)
    elif power == 2:
        blend_squared_lanes(rays.state, half * LANES, shape, alone)
    else:
        blend_lanes(rays.state, half * LANES, shape, alone)
