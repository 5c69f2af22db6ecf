"""How many entries the walks will make: how many parts of a view's map a splat's footprint meets.

A footprint that is ``d`` cells wide lies in about ``(d + r)^2`` cells, of which a pixel reads ``r^2``: one region or
the nearest cell, or four cells of a grid that is read bilinearly. Some of them lie behind other splats, or where the
footprint is too faint, more of them the finer the cells are. With ``k`` the mean of ``(d / r + 1)^2`` over the splats
that a view can see, before occlusion, such a splat has about ``r^2 (OPEN k + MET k^BEND)`` entries. The three were
fitted to the entries of `tabletop` and `plush` with cells from a sixteenth of the image's height to a pixel, and a
tenth was added; `python -m tests.benchmarks.plan_memory SPLATS CAMERAS FEATURES...` holds the plan against lifts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from liftcore.raster.base import TILE
from liftcore.solve.columns import by_rows

if TYPE_CHECKING:
    from collections.abc import Mapping

    from liftcore.features.pack import FeaturePacks
    from liftcore.plan.visibility import Visibility
    from liftcore.scene.cameras import Camera
    from liftcore.settings import LiftSettings

OPEN, MET, BEND = 0.24, 0.68, 0.45
MORE_ENTRIES = 0.6  # of a level's for each further level, where columns are tuples; as many where they are rows


@dataclass(frozen=True)
class PlannedEntries:
    """Of a splat that a view can see, in the mean over such splats and over the views."""

    splats: float  # how many a view can see, before occlusion
    entries: float  # of W
    listed: float  # tiles that have it in their lists
    walked: float  # entries that the walk of the tiles makes, before they are summed to those of W


@dataclass(frozen=True)
class _Parts:
    """What a view's map tells apart."""

    cell: float  # px^2 of a part
    reach: int  # parts that a pixel reads, along either axis
    levels: float  # what several levels have of the entries of one


def planned_entries(
    seen: Visibility, packs: FeaturePacks, cameras: Mapping[str, Camera], settings: LiftSettings
) -> PlannedEntries:
    """Estimate what the walks of these views will make.

    Args:
        seen: the footprints in each of the views, in their order.
        cameras: the views that are lifted, by name.
    """
    sums = np.zeros(4)
    for areas, (view, camera) in zip(seen.areas, cameras.items(), strict=True):
        own = areas[areas > 0].astype(np.float64)
        if not own.size:
            continue
        parts = _parts_of(packs, view, camera, settings)
        entries = parts.levels * _met(own, parts.cell, parts.reach)
        tile = float((TILE * settings.stride) ** 2)
        walked = parts.reach**2 * _met(own, tile, 1) + entries
        sums += own.size * np.array([1.0, entries, _spread(own, tile, 1), walked])
    count = max(sums[0], 1.0)
    entries, listed, walked = (float(total / count) for total in sums[1:])
    return PlannedEntries(seen.splats_a_view, entries, listed, walked)


def _parts_of(packs: FeaturePacks, view: str, camera: Camera, settings: LiftSettings) -> _Parts:
    """What the view's map tells apart, as the settings read it."""
    specs, pixels = packs.specs(view), camera.width * camera.height
    if "grid" in specs:
        bilinear = settings.grid_reading == "bilinear"
        height, width = specs["grid"].shape[:2]
        reach, levels, own = 2 if bilinear else 1, 1, pixels / (width * height)
    else:
        shape, rows = specs["labels"].shape, specs["codebook"].shape[0]
        levels = shape[0] if len(shape) == 3 else 1
        reach, own = 1, pixels * levels / max(rows, 1)
    single = isinstance(settings.levels, int)
    more = 0.0 if single else (levels - 1) * (1.0 if by_rows(settings) else MORE_ENTRIES)
    # No part is finer than the pixels that are walked, of which each reads so many.
    return _Parts(min(max(own, (settings.stride / reach) ** 2), pixels), reach, 1.0 + more)


def _spread(areas: np.ndarray, cell: float, reach: int) -> float:
    """``k`` of footprints of these areas [n] px^2, where a part has ``cell`` px^2 and a pixel reads ``reach^2``."""
    sides = 2.0 * np.sqrt(areas / (math.pi * cell))
    return float(np.mean((sides / reach + 1.0) ** 2))


def _met(areas: np.ndarray, cell: float, reach: int) -> float:
    """The parts that get some of such a footprint's weight, in the mean."""
    k = _spread(areas, cell, reach)
    return reach**2 * (OPEN * k + MET * k**BEND)
