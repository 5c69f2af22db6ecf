"""Which weights count, in Triton: ``cpu.selection`` on a tile's rays, and each ray's largest weights."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton.language as tl

from liftcore.raster.base import TILE
from liftcore.raster.cpu.composite import CENTRAL, FRONT, LARGEST
from liftcore.raster.gpu import scene
from liftcore.raster.gpu.launching import WARPS, jit, lang, launch
from liftcore.raster.gpu.room import A_PIXEL
from liftcore.raster.gpu.walk import CHUNK, PART, PARTS, blend, blend_chunk, fill_alphas, start_rays

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.gpu.frame import Frame
    from liftcore.raster.gpu.tile_lists import Lists

A_MARK = 8  # bytes of one of a ray's largest weights, where marks are made
_WIDE = 32  # ranks a ray that more warps share, or the registers of a thread would not hold its part

_CHUNK = tl.constexpr(CHUNK)
_TILE = tl.constexpr(TILE)
_PIXELS = tl.constexpr(TILE * TILE)
_SCRATCH = tl.constexpr(PARTS * PART)
_WEIGHTS, _EVIDENCE = tl.constexpr(PART), tl.constexpr(PARTS * PART)
_LARGEST, _FRONT, _CENTRAL = tl.constexpr(LARGEST), tl.constexpr(FRONT), tl.constexpr(CENTRAL)
_PLACE = tl.constexpr(scene.PLACE)
_LATER = tl.constexpr(1 << 30)  # above every number of an item: a place that is still free


@jit
def blend_chosen(
    scratch, light, stop, count, least, room, light_in_front, SELECTION: tl.constexpr, PLAIN: tl.constexpr
):
    """``blend_chunk`` that leaves only weights that count, and with PLAIN all of them as the evidence's.

    Args:
        least: [256] f32, of top-k: the k-th largest weight of a ray; room: [256] i32, how many that equal it count.
        light_in_front: of front-mass: a weight counts while the light before it is above this.

    Returns:
        The light after the chunk, and the room that is left.
    """
    pixel = tl.arange(0, _PIXELS)
    for number in range(tl.minimum(count, _CHUNK)):
        own = scratch + number * _PIXELS + pixel
        before = light
        weight, light = blend(tl.load(own), light, stop)
        if PLAIN:
            tl.store(own + _EVIDENCE + _WEIGHTS, weight)
        if SELECTION == _LARGEST:  # equal ones near to far, until k are full
            equal = (weight == least) & (weight > 0.0) & (room > 0)
            room -= equal.to(tl.int32)
            tl.store(own + _WEIGHTS, tl.where(equal | (weight > least), weight, 0.0))
        else:
            tl.store(own + _WEIGHTS, tl.where(before > light_in_front, weight, 0.0))
    tl.debug_barrier()
    return light, room


@jit
def counted(
    weights, pixel, places, items, at, last, tile, columns, smallest, SELECTION: tl.constexpr, POWER: tl.constexpr
):
    """A chunk's weights [CHUNK, n] on pixels [n] to their power; none too small or off the centre."""
    weights = tl.where(weights >= smallest, weights, 0.0)
    if SELECTION == _CENTRAL:
        number = at + tl.arange(0, _CHUNK)
        inside = number < last
        place = places + tl.load(items + number, mask=inside, other=0) * _PLACE
        column = tl.floor(tl.load(place, mask=inside, other=-1.0)) - (tile % columns * _TILE).to(tl.float64)
        row = tl.floor(tl.load(place + 1, mask=inside, other=-1.0)) - (tile // columns * _TILE).to(tl.float64)
        own = (column[:, None] == (pixel % _TILE).to(tl.float64)[None, :]) & (
            row[:, None] == (pixel // _TILE).to(tl.float64)[None, :]
        )
        weights = tl.where(own, weights, 0.0)
    if POWER == 0:
        weights = tl.where(weights > 0.0, 1.0, 0.0)
    if POWER == 2:
        weights = weights * weights
    return weights


@jit
def _rank(
    places, inks, starts, items, scratch, largest, band_tile, own_tile, columns, width, height, count,
    cap, stop, floor, KIND: tl.constexpr, COUNT: tl.constexpr,
):  # fmt: skip
    own = own_tile + tl.program_id(0)
    tile = band_tile + own
    mine = scratch + tl.program_id(0) * _SCRATCH
    pixel = tl.arange(0, _PIXELS)
    rank = tl.arange(0, COUNT)
    first = tl.load(starts + own)
    at = first
    last = tl.load(starts + own + 1)
    light = start_rays(tile, columns, width, height)
    # The rest of a power of two is filled with what nothing displaces.
    held = tl.where((rank < count)[None, :] & (pixel >= 0)[:, None], 0.0, float("inf"))
    order = _LATER + rank[None, :] + tl.zeros([_PIXELS, COUNT], tl.int32)
    lit = lang.max(light, 0)
    while (at < last) & (lit > 0.0):
        known = (last - at).to(tl.int32)
        fill_alphas(places, inks, items, at, last, tile, columns, mine, cap, floor, KIND, False)
        light = blend_chunk(mine, light, stop, known)
        for number in range(tl.minimum(known, _CHUNK)):
            weight = tl.load(mine + _WEIGHTS + number * _PIXELS + pixel)
            least = lang.min(held, 1)
            # Of equal ones the last that came makes room.
            latest = lang.max(tl.where(held == least[:, None], order, -1), 1)
            displaced = (order == latest[:, None]) & (weight > least)[:, None]
            held = tl.where(displaced, weight[:, None], held)
            order = tl.where(displaced, (at - first).to(tl.int32) + number, order)
        lit = lang.max(light, 0)
        at += _CHUNK
    to = (tl.program_id(0) * _PIXELS + pixel)[:, None] * count + rank[None, :]
    tl.store(largest + to, held, mask=(rank < count)[None, :] & (pixel >= 0)[:, None])


def marks_of(frame: Frame, lists: Lists, run: tuple[int, int], count: int) -> tuple[Tensor, Tensor]:
    """What top-k knows of every ray of a run of tiles.

    Returns:
        least [tiles, 256] f32, the k-th largest weight, 0 when there are fewer; room [tiles, 256] i32, how many
        weights equal to it are among the k.
    """
    # Parts of the run, so that the largest weights take no more than A_PIXEL has for the pixels of all of it.
    step = max(1, frame.room.tiles * A_PIXEL // (A_MARK * count))
    parts = [(first, min(first + step, run[1])) for first in range(run[0], run[1], step)]
    marks = [_marks(_largest_weights(frame, lists, part, count)) for part in parts]
    least, room = (torch.cat(column) for column in zip(*marks, strict=True))
    return least, room


def _largest_weights(frame: Frame, lists: Lists, run: tuple[int, int], count: int) -> Tensor:
    """[tiles, 256, count] f32: the largest weights of each ray of a run, in no order; 0 where there are fewer."""
    tiles = run[1] - run[0]
    weights = torch.zeros(tiles, TILE * TILE, count, device=frame.device)
    wide = 1 << (count - 1).bit_length()
    launch(
        _rank, tiles, *lists.splats, lists.starts, lists.items, frame.scratch(tiles), weights,
        lists.first_tile, run[0], *frame.size, count, *frame.cuts, KIND=frame.kind,
        COUNT=wide, warps=8 if wide >= _WIDE else WARPS,
    )  # fmt: skip
    return weights


def _marks(weights: Tensor) -> tuple[Tensor, Tensor]:
    least = weights.amin(dim=2)
    return least, (weights == least[:, :, None]).sum(dim=2).to(torch.int32)
