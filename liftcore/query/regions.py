"""Regions of a lift's feature packs: those of a view, those that cover a pixel, and their masks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidQuery, NotFound
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.query.question import CoveringRegion
from liftcore.query.terms import Region

if TYPE_CHECKING:
    from liftcore.values.views import Regions


def regions_of(scene: OpenedLift, view: str, argument: str) -> Regions:
    """Return the regions of a view in the packs, by its name in the pack or that of its camera.

    Raises:
        NotFound: the packs lack the view. InvalidQuery: it is a grid. InvalidLift: a pack moved or changed.
    """
    from liftcore.scene.views import cameras_of_views
    from liftcore.values.views import Regions

    packs = scene.packs
    name = cameras_of_views([view], packs.views).get(view)
    if name is None:
        raise NotFound(argument, expected="a view of the lift's feature packs", got=repr(view))
    view_regions = packs[name]
    if not isinstance(view_regions, Regions):
        hint = "ask by a pixel, VIEW:x,y"
        raise InvalidQuery(argument, expected="a view with regions", got="a feature grid", hint=hint)
    return view_regions


def codebook_row(regions: Regions, example: Region) -> np.ndarray:
    """Return the vector of a region, [F].

    Raises:
        NotFound: the view's map has no such level, or the level has no such label.
    """
    _labelled(regions, example)
    return as_numpy(regions.codebook[example.region])


def regions_at(scene: OpenedLift, view: str, x: int, y: int) -> tuple[CoveringRegion, ...]:
    """Return the regions that cover pixel (x, y) of a view's photo, one a level at most, the smallest first.

    Raises:
        InvalidQuery: the pixel is outside the photo; or as `regions_of`, like NotFound and InvalidLift.
    """
    labels = as_numpy(regions_of(scene, view, "view").labels)
    rows, columns = _map_places(scene, view, labels)
    if not (0 <= x < len(columns) and 0 <= y < len(rows)):
        expected = f"a pixel with x in 0..{len(columns) - 1} and y in 0..{len(rows) - 1}"
        raise InvalidQuery("x, y", expected=expected, got=f"{x},{y}")
    regions = [
        CoveringRegion(example=str(region), **vars(region), share=float((labels[level] == region.region).mean()))
        for level, label in enumerate(labels[:, rows[y], columns[x]])
        if label >= 0
        for region in [Region(view, level, int(label))]
    ]
    return tuple(sorted(regions, key=lambda r: r.share))


def region_mask(scene: OpenedLift, example: Region) -> np.ndarray:
    """Return the pixels of the view's photo that a region covers, [H, W] bool.

    Raises:
        NotFound, InvalidQuery, InvalidLift: as `regions_of` and `codebook_row`.
    """
    regions = regions_of(scene, example.view, "view")
    rows, columns = _map_places(scene, example.view, as_numpy(regions.labels))
    return _labelled(regions, example)[np.ix_(rows, columns)]


def _labelled(regions: Regions, example: Region) -> np.ndarray:
    """Return the pixels with the example's label in its level of the map, [h, w] bool."""
    levels = regions.labels.shape[0]
    if example.level >= levels:
        raise NotFound(str(example), expected=f"a level in 0..{levels - 1}", got=str(example.level))
    inside = as_numpy(regions.labels[example.level]) == example.region
    if not inside.any():
        expected = f"a label of level {example.level} in view {example.view!r}"
        raise NotFound(str(example), expected=expected, got=str(example.region))
    return inside


def _map_places(scene: OpenedLift, view: str, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the row and column of the label map [L, h, w] for each row and column of the photo, [H] and [W]."""
    width, height = scene.cameras[view].photo_size
    rows, columns = ((np.arange(n) + 0.5) * m / n for n, m in zip((height, width), labels.shape[1:], strict=True))
    return rows.astype(np.int64), columns.astype(np.int64)
