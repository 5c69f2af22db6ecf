"""The walk of a tile's rays through its splats: one splat's weights on up to 256 pixels at a time.

A tile is 16 rows of two half rows of eight pixels. Products (region weights, renders, ...) take the half rows that a
splat ``meets`` one by one, ``blend`` it there and use the weights at once, while they are in a register.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from liftcore.jit import inlined, kernel
from liftcore.raster.constants import TILE
from liftcore.raster.cpu.footprints import Betas, Discs, Gaussians, footprint, halves_of, lanes_of
from liftcore.raster.cpu.lanes import LANES, PLAIN_TRANSMITTANCE, ROWS, TRANSMITTANCE, fetch_ahead
from liftcore.raster.cpu.lanes_blend import blend_lanes, blend_twice, new_state
from liftcore.raster.cpu.lanes_halves import both, either, lit_halves

AHEAD = 8  # items of a tile's list between asking for a record and reading it: they lie anywhere in memory
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

    state: np.ndarray  # [STATE] f32, laid out as liftcore.raster.cpu.lanes and liftcore.raster.cpu.lanes_blend say
    lit: np.ndarray  # [1] u32, the half rows that still let light through, with or without the gain


@kernel
def new_rays(frame):
    """Room for one tile's rays."""
    return Rays(new_state(frame.kernel.floor, frame.cap, frame.stop), np.zeros(1, np.uint32))


@inlined
def place_of(y, x):
    """Where the ray of a tile's pixel lies among its 256."""
    return (x // LANES * ROWS + y) * LANES + x % LANES


@inlined
def next_splat(frame, tile, step, x0, y0):
    """The footprint of an item of a tile's list; one that comes soon is asked for."""
    if step + AHEAD < frame.starts[tile + 1]:
        fetch_ahead(frame.records, frame.items[step + AHEAD])
    return footprint(frame.kernel, frame.records, frame.items[step], x0, y0)


@kernel
def start_rays(rays, frame, tile):
    """Light every ray of a tile that lies inside the image."""
    x0 = (tile % frame.columns) * TILE
    y0 = (tile // frame.columns) * TILE
    for y in range(TILE):
        for x in range(TILE):
            light = np.float32(x0 + x < frame.width and y0 + y < frame.height)
            rays.state[TRANSMITTANCE + place_of(y, x)] = light
            rays.state[PLAIN_TRANSMITTANCE + place_of(y, x)] = light


@inlined
def look(rays, with_plain):
    """Note which half rows still let light through, with or without the gain; whether any does."""
    lit = lit_halves(rays.state, TRANSMITTANCE)
    if with_plain:
        lit = either(lit, lit_halves(rays.state, PLAIN_TRANSMITTANCE))
    rays.lit[0] = lit
    return lit != 0


@inlined
def meets(rays, splat):
    """The half rows where the splat can have a weight and there is light: a set of ``lanes_halves``."""
    return both(halves_of(splat, rays.state), rays.lit[0])


@inlined
def blend(rays, splat, half):
    """Composite the splat over a half row: its weights, eight lanes."""
    shape = lanes_of(splat, rays.state, half)
    return blend_lanes(rays.state, half * LANES, shape, np.float32(splat.fade))


@inlined
def blend_both(rays, splat, half, plain):
    """``blend``, and the weights without the opacity gain: on rays of their own, or the same where ``plain`` is None.

    The two ways differ in the last digits, so who compares weights for equality has to go one way.
    """
    if plain is None:
        heavy = blend(rays, splat, half)
        return heavy, heavy
    shape = lanes_of(splat, rays.state, half)
    return blend_twice(rays.state, half * LANES, shape, (np.float32(splat.opacity), np.float32(splat.plain)))
