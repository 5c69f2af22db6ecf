"""Smoothness of feature maps, to find maps whose bytes have another order of axes than their shape.

In a map of a photo, neighbouring cells are more similar than any two cells. If the order of axes is wrong, the map is
smooth only in the right order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from liftcore.values.views import FeatureGrid, ViewFeatures

MIN_SMOOTHNESS = 0.1  # of a map of a photo: excess of the neighbours' cosine, as a share of the largest possible one
READINGS = {"[F, h, w]": (1, 2, 0), "[w, h, F]": (1, 0, 2)}  # shapes of the same bytes, and their axes h, w, F
SAMPLED_VIEWS = 4  # views whose grids are checked; fewer grids are not


def smoothness(grids: Sequence[np.ndarray]) -> dict[str, float]:
    """Return medians over maps [h, w, F] f32 of mean cosines of neighbours, of any two cells, and by READINGS."""
    rows = []
    for grid in grids:
        sides = np.array(grid.shape)
        readings = (grid.reshape(sides[np.argsort(axes)]).transpose(axes) for axes in READINGS.values())
        rows.append([*_mean_cosines(grid), *(_mean_cosines(reading)[0] for reading in readings)])
    medians = np.median(np.array(rows), axis=0).tolist()
    return dict(zip(("neighbouring_cells", "any_two_cells", *READINGS), medians, strict=True))


def unlike_maps(grids: Sequence[np.ndarray]) -> list[str]:
    """Return warnings about maps [h, w, F] whose neighbouring cells are not similar."""
    if not grids:
        return []
    figures = smoothness(grids)
    neighbours, any_two = figures["neighbouring_cells"], figures["any_two_cells"]
    best = max(READINGS, key=figures.__getitem__)
    cosine = f"neighbouring cells have a mean cosine of {neighbours:.2f}"
    if figures[best] - neighbours > MIN_SMOOTHNESS:
        reading_note = f"read as {best}, of {figures[best]:.2f}, so the bytes have that order"
        option = "--layout chw (in Python layout='chw')"
        hint = f"pack maps with channels first with {option}, and write others from contiguous arrays"
        return [f"features: {cosine}, {reading_note}; {hint}"]
    if neighbours - any_two < MIN_SMOOTHNESS * max(1 - any_two, 1e-6):
        return [f"features: {cosine}, like any two cells, so the maps have no relation to the photos"]
    return []


def _mean_cosines(grid: np.ndarray) -> tuple[float, float]:
    """Return the mean cosine of neighbouring cells of a grid [h, w, F], and that of any two cells."""
    grid = grid / np.maximum(np.abs(grid).max(axis=2, keepdims=True), 1e-30)  # so that no square overflows
    unit = grid / np.maximum(np.linalg.norm(grid, axis=2, keepdims=True), 1e-30)
    down, across = (unit[1:] * unit[:-1]).sum(axis=2), (unit[:, 1:] * unit[:, :-1]).sum(axis=2)
    mean = unit.reshape(-1, unit.shape[2]).mean(axis=0)
    count = unit.shape[0] * unit.shape[1]
    all_pairs = (count * float(mean @ mean) - 1) / max(count - 1, 1)
    return float(np.concatenate([down.ravel(), across.ravel()]).mean()) if count > 1 else 1.0, all_pairs


def some_grids(features: Mapping[str, ViewFeatures], names: Sequence[str]) -> list[np.ndarray]:
    """Return the maps [h, w, F] f32 of evenly spaced views; empty if fewer than SAMPLED_VIEWS of them are grids."""
    sample = [names[int(index)] for index in np.linspace(0, len(names) - 1, min(SAMPLED_VIEWS, len(names)))]
    grids = [
        view_features.grid.float().numpy()
        for view in sample
        if isinstance(view_features := features[view], FeatureGrid)
    ]
    return grids if len(grids) == SAMPLED_VIEWS else []
