"""Rows of A on the device: single rays, each a lane that walks its tile's list by itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton.language as tl

from liftcore.raster.constants import TILE
from liftcore.raster.gpu import scene
from liftcore.raster.gpu.falloffs import falloff_at
from liftcore.raster.gpu.launching import jit, lang, launch
from liftcore.raster.gpu.walk import blend
from liftcore.raster.protocol import RayRows

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.gpu.frame import Frame

RAYS = 64  # a program

_TILE = tl.constexpr(TILE)
_INK, _OPACITY = tl.constexpr(scene.INK), tl.constexpr(scene.OPACITY)


@jit
def _trace(
    places, inks, starts, items, ids, pixels, counts, row_starts, splats, weights, rays, columns, tiles, band_tile,
    cap, stop, floor, KIND: tl.constexpr, RAYS: tl.constexpr, WRITES: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0) * RAYS + tl.arange(0, RAYS)
    x = tl.load(pixels + 2 * ray, mask=ray < rays, other=0)
    y = tl.load(pixels + 2 * ray + 1, mask=ray < rays, other=0)
    own = y // _TILE * columns + x // _TILE - band_tile
    given = (ray < rays) & (own >= 0) & (own < tiles)
    at = tl.load(starts + own, mask=given, other=0)
    last = tl.load(starts + own + 1, mask=given, other=0)
    light = tl.where(given, 1.0, 0.0)
    found = tl.zeros([RAYS], tl.int64)
    if WRITES:
        found += tl.load(row_starts + ray, mask=given, other=0)
    first_found = found
    # The start of the tile's row and a lane, as the tile's own walk has them.
    row_x = (x // _TILE * _TILE).to(tl.float64) + 0.5
    lane = (x % _TILE).to(tl.float32)
    row_y = y.to(tl.float64) + 0.5
    walking = (at < last) & (light > 0.0)
    while lang.max(walking.to(tl.int32), 0) > 0:
        item = tl.load(items + at, mask=walking, other=0)
        falloff = falloff_at(places, inks, item, walking, row_y, row_x, lane, KIND)
        opacity = tl.load(inks + item * _INK + _OPACITY, mask=walking, other=0.0)
        alpha = tl.minimum(opacity * falloff, cap)
        weight, light = blend(tl.where(alpha >= floor, alpha, 0.0), light, stop)
        met = walking & (weight > 0.0)
        if WRITES:
            tl.store(splats + found, tl.load(ids + item, mask=met, other=0), mask=met)
            tl.store(weights + found, weight, mask=met)
        found += met.to(tl.int64)
        at += 1
        walking = (at < last) & (light > 0.0)
    if not WRITES:
        tl.store(counts + ray, found - first_found, mask=given)


def ray_rows(frame: Frame, pixels: Tensor) -> RayRows:
    """Rows of A for pixels [n, 2] i32 (x, y) of the frame, on the device; the rows come back on the CPU."""
    rays = pixels.shape[0]
    counts = torch.zeros(rays, dtype=torch.int64, device=frame.device)
    row_starts = torch.zeros(rays + 1, dtype=torch.int64, device=frame.device)
    none = torch.empty(0, dtype=torch.int32, device=frame.device), torch.empty(0, device=frame.device)
    _run(frame, pixels, counts, row_starts, none, False)
    torch.cumsum(counts, 0, out=row_starts[1:])
    total = int(row_starts[-1])
    splats = torch.empty(total, dtype=torch.int32, device=frame.device)
    weights = torch.empty(total, device=frame.device)
    _run(frame, pixels, counts, row_starts, (splats, weights), True)
    return RayRows(row_starts.cpu(), splats.cpu(), weights.cpu())


def _run(
    frame: Frame, pixels: Tensor, counts: Tensor, row_starts: Tensor, found: tuple[Tensor, Tensor], writes: bool
) -> None:
    for lists in frame.lists():
        launch(
            _trace, -(-pixels.shape[0] // RAYS), *frame.splats, lists.starts, lists.items, frame.ids, pixels, counts,
            row_starts, *found, pixels.shape[0], frame.columns, lists.tiles, lists.first_tile, *frame.cuts,
            KIND=frame.kind, RAYS=RAYS, WRITES=writes,
        )  # fmt: skip
