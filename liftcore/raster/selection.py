"""Which of a ray's weights count, and to which power: a gate between the blending and the sums.

The walk that counts all weights never comes here. For the others, the plain weights of a half row are kept in the
state, and ``choose`` zeroes the lanes that do not count. The k largest weights of a ray are known only at
its end, so top-k walks every tile twice: ``rank_tile`` finds what the least of them is, ``choose`` then keeps to it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from liftcore.errors import InvalidInput
from liftcore.jit import inlined, kernel
from liftcore.lanes import LANES, PIXELS, TRANSMITTANCE, WEIGHTS, keep_lanes
from liftcore.lanes_halves import lowest_half, without_lowest
from liftcore.raster.constants import TILE
from liftcore.raster.protocol import MOST_OF_A_RAY, Selection, Weighting
from liftcore.raster.walk import CHECK_EVERY, blend_both, look, meets, next_splat, place_of, start_rays

EVERY, LARGEST, FRONT, CENTRAL = range(4)
_KINDS = {
    Selection.ALL: EVERY,
    Selection.TOP_K: LARGEST,
    Selection.FRONT_MASS: FRONT,
    Selection.CENTRE: CENTRAL,
}
NO_SPOT = -1  # the splat's centre lies in another tile


class Choice(NamedTuple):
    """A Weighting as the compiled code takes it."""

    gated: bool  # whether any weight may be left out or counted otherwise than blending leaves it
    kind: int
    power: int
    k: int  # of top-k
    light: np.float32  # of front-mass: a weight counts while T before it is above this
    floor: np.float32


class Marks(NamedTuple):
    """What top-k knows of a tile's 256 rays after its first walk."""

    largest: np.ndarray  # [256 * k] f32, each ray's largest weights, descending
    known: np.ndarray  # [256] i32, how many of them it has
    least: np.ndarray  # [256] f32, the k-th of them; 0 when there are fewer
    room: np.ndarray  # [256] i32, how many weights equal to the least belong to the k


def choice_of(weighting: Weighting) -> Choice:
    """The weighting for the compiled code.

    Raises:
        InvalidInput: a knob of the weighting is out of its range.
    """
    _check(weighting)
    kind = _KINDS[weighting.selection]
    gated = kind != EVERY or weighting.power == 0 or weighting.floor > 0
    light = np.float32(1.0 - weighting.mass)
    return Choice(gated, kind, weighting.power, weighting.count, light, np.float32(weighting.floor))


def _check(weighting: Weighting) -> None:
    if weighting.power not in (0, 1, 2):
        raise InvalidInput("power", expected="0, 1 or 2", got=str(weighting.power))
    if weighting.selection is Selection.TOP_K and not 1 <= weighting.count <= MOST_OF_A_RAY:
        raise InvalidInput("count", expected=f"1 to {MOST_OF_A_RAY} weights of a ray", got=str(weighting.count))
    if weighting.selection is Selection.FRONT_MASS and not 0 < weighting.mass <= 1:
        raise InvalidInput("mass", expected="above 0 and at most 1", got=str(weighting.mass))
    if not weighting.floor >= 0:
        raise InvalidInput("floor", expected="0 or more", got=str(weighting.floor))


@kernel
def new_marks(choice) -> Any:
    """Room for one tile's marks; empty unless the choice is top-k, none where all weights count (None)."""
    if choice is None:
        return None
    pixels = PIXELS if choice.kind == LARGEST else 0
    return Marks(
        np.zeros(pixels * choice.k, np.float32),
        np.zeros(pixels, np.int32),
        np.zeros(pixels, np.float32),
        np.zeros(pixels, np.int32),
    )


@kernel
def rank_tile(rays, frame, tile, marks, count, plain):
    """Walk a tile once, as ``weigh_tiles`` will, for the ``count`` largest weights of a ray; the rays are spent."""
    x0 = float((tile % frame.columns) * TILE)
    y0 = float((tile // frame.columns) * TILE)
    state = rays.state
    start_rays(rays, frame, tile)
    marks.known[:] = 0
    marks.least[:] = 0
    for step in range(frame.starts[tile], frame.starts[tile + 1]):
        if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not look(rays, False):
            break
        splat = next_splat(frame, tile, step, x0, y0)
        halves = meets(rays, splat)
        while halves:
            half = lowest_half(halves)
            halves = without_lowest(halves)
            keep_lanes(state, WEIGHTS + half * LANES, blend_both(rays, splat, half, plain)[0])
            for pixel in range(half * LANES, half * LANES + LANES):
                weight = state[WEIGHTS + pixel]
                if weight > marks.least[pixel]:
                    _insert(marks, pixel, count, weight)
    for pixel in range(PIXELS):
        if marks.least[pixel] > 0:
            own = marks.largest[pixel * count : pixel * count + count]
            marks.room[pixel] = (own == marks.least[pixel]).sum()


@inlined
def _insert(marks, pixel, count, weight):
    """Put a weight above the least in its place among the pixel's largest."""
    largest, first = marks.largest, pixel * count
    known = marks.known[pixel]
    place = first + known
    if known < count:
        marks.known[pixel] = known + 1
    else:
        place -= 1
    while place > first and largest[place - 1] < weight:
        largest[place] = largest[place - 1]
        place -= 1
    largest[place] = weight
    if known >= count - 1:
        marks.least[pixel] = largest[first + count - 1]


@inlined
def spot_of(splat):
    """The ray of the tile at the splat's projected centre; NO_SPOT when there is none."""
    column, row = np.floor(splat.mx + 0.5), np.floor(splat.my + 0.5)
    if 0 <= column < TILE and 0 <= row < TILE:
        return place_of(int(row), int(column))
    return NO_SPOT


@inlined
def choose(choice, state, least, room, half, spot):
    """Zero the lanes of a half row that do not count, and raise the others to the power; whether any counts."""
    first = half * LANES
    if choice.kind == CENTRAL and not first <= spot < first + LANES:
        return False
    largest = np.float32(0.0)
    for lane in range(first, first + LANES):
        weight = state[WEIGHTS + lane]
        lit = choice.kind != FRONT or state[TRANSMITTANCE + lane] + weight > choice.light
        weight = weight if lit and weight >= choice.floor else np.float32(0.0)
        state[WEIGHTS + lane] = weight
        largest = max(largest, weight)
    if largest == 0:
        return False
    if choice.kind == CENTRAL:
        for lane in range(first, first + LANES):
            if lane != spot:
                state[WEIGHTS + lane] = 0
    elif choice.kind == LARGEST:
        for lane in range(first, first + LANES):
            weight = state[WEIGHTS + lane]
            if weight == least[lane] and weight > 0 and room[lane] > 0:  # equal ones near to far, until k are full
                room[lane] -= 1
            elif weight <= least[lane]:
                state[WEIGHTS + lane] = 0
    largest = np.float32(0.0)
    for lane in range(first, first + LANES):
        weight = state[WEIGHTS + lane]
        largest = max(largest, weight)
        if choice.power == 0:
            weight = np.float32(weight > 0)
        elif choice.power == 2:
            weight *= weight
        state[WEIGHTS + lane] = weight
    return largest > 0
