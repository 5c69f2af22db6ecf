"""Which of a ray's weights count, and to which power: a gate between the blending and the sums.

The walk that counts all weights never comes here. For the others, ``chosen`` zeroes the lanes of a half row that do
not count. The k largest weights of a ray are known only at its end, so top-k walks every tile twice: ``rank_tile``
finds what the least of them is, ``chosen`` then keeps to it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from liftcore.errors import InvalidInput
from liftcore.jit import inlined, kernel
from liftcore.raster.base import MOST_OF_A_RAY, Selection, Weighting
from liftcore.raster.constants import TILE
from liftcore.raster.cpu.lanes import (
    HALVES,
    LANES,
    PIXELS,
    in_all_lanes,
    keep_lanes,
    lanes_at,
    no_lanes,
    plus,
    times,
)
from liftcore.raster.cpu.lanes_halves import lowest_half, without_lowest
from liftcore.raster.cpu.lanes_select import (
    any_above,
    larger,
    only_lane,
    smaller,
    where_above,
    where_equal,
    where_reached,
)
from liftcore.raster.cpu.walk import CHECK_EVERY, blend_both, look, meets, next_splat, place_of, start_rays

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
    """What top-k knows of a tile's 256 rays after its first walk: [(k + 1) * 256] f32, of no use to other choices.

    The rays' largest weights, then their second largest, and so on to the k-th, 0 for none; at last how many weights
    equal to a ray's k-th belong to the k. None where all weights count (None).
    """
    return None if choice is None else np.zeros((choice.k + 1) * PIXELS, np.float32)


@kernel
def rank_tile(rays, frame, tile, marks, plain):
    """Walk a tile once, as ``weigh_tiles`` will, for the largest weights of its rays; the rays are spent."""
    x0 = float((tile % frame.columns) * TILE)
    y0 = float((tile // frame.columns) * TILE)
    start_rays(rays, frame, tile)
    marks[:] = 0
    met = np.zeros(HALVES, np.int64)  # splats of each half row: it has no more weights than that
    last = marks.shape[0] // PIXELS - 2
    for step in range(frame.starts[tile], frame.starts[tile + 1]):
        if (step - frame.starts[tile]) % CHECK_EVERY == 0 and not look(rays, False):
            break
        splat = next_splat(frame, tile, step, x0, y0)
        halves = meets(rays, splat)
        while halves:
            half = lowest_half(halves)
            halves = without_lowest(halves)
            weights = blend_both(rays, splat, half, plain)[0]
            at = min(met[half], last) * PIXELS + half * LANES
            met[half] += 1
            while at >= PIXELS and any_above(weights, lanes_at(marks, at)):
                above = lanes_at(marks, at - PIXELS)
                keep_lanes(marks, at, larger(lanes_at(marks, at), smaller(above, weights)))
                at -= PIXELS
            if at < PIXELS:
                keep_lanes(marks, at, larger(lanes_at(marks, at), weights))
    least = last * PIXELS
    for place in range(least + PIXELS):
        ray = place % PIXELS
        marks[least + PIXELS + ray] += np.float32(marks[place] == marks[least + ray])


@inlined
def spot_of(splat):
    """The ray of the tile at the splat's projected centre; NO_SPOT when there is none."""
    column, row = np.floor(splat.mx + 0.5), np.floor(splat.my + 0.5)
    if 0 <= column < TILE and 0 <= row < TILE:
        return place_of(int(row), int(column))
    return NO_SPOT


@inlined
def chosen(choice, weights, behind, marks, lane):
    """A half row's weights as they count: zero in the lanes that do not, raised to the power in the others.

    Args:
        weights: eight lanes. behind: the transmittance behind them. marks: (the k-th weights of their rays; how many
            equal to those still belong to the k). lane: that of the splat's centre, if it is one of the eight.

    Returns:
        The weights, and the second of the marks.
    """
    none, (least, room) = no_lanes(), marks
    weights = where_reached(weights, in_all_lanes(choice.floor), weights)
    if choice.kind == CENTRAL:
        weights = only_lane(weights, lane)
    elif choice.kind == FRONT:
        weights = where_above(plus(behind, weights), in_all_lanes(choice.light), weights)
    elif choice.kind == LARGEST:
        equal = where_equal(weights, least, where_above(room, none, weights))  # near to far, until k are full
        room = plus(room, where_above(equal, none, in_all_lanes(np.float32(-1.0))))
        weights = plus(where_above(weights, least, weights), equal)
    if choice.power == 0:
        weights = where_above(weights, none, in_all_lanes(np.float32(1.0)))
    elif choice.power == 2:
        weights = times(weights, weights)
    return weights, room
