"""Do neighbouring cells of maps agree? Those of photos are smooth: neighbours are more alike than any two cells.

Bytes that lie in another order of axes than their shape says are smooth in that order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from liftcore.values.views import FeatureGrid, ViewFeatures

LEAST_SMOOTHNESS = 0.1  # of neighbouring cells' agreement over that of any two, as a share of what is left to one
READINGS = {"[F, h, w]": (1, 2, 0), "[w, h, F]": (1, 0, 2)}  # of the same bytes, and how their axes become h, w, F
LOOKED_AT = 4  # views whose grids' order of axes is looked at; of fewer grids none


@dataclass(frozen=True)
class Smoothness:
    """How alike the cells of maps are, means over them."""

    neighbours: float  # cosine of neighbouring cells
    anyone: float  # of any two
    readings: dict[str, float]  # of neighbouring cells, were the bytes read so

    @property
    def share(self) -> float:
        """What neighbours agree more, as a share of what is left to one."""
        return (self.neighbours - self.anyone) / max(1 - self.anyone, 1e-6)


def smoothness(grids: Sequence[np.ndarray]) -> Smoothness:
    """Of maps [h, w, F] f32, one at least."""
    rows = []
    for grid in grids:
        readings = [
            _agreement(grid.reshape(np.array(grid.shape)[np.argsort(axes)]).transpose(axes))[0]
            for axes in READINGS.values()
        ]
        rows.append([*_agreement(grid), *readings])
    neighbours, anyone, *others = np.median(np.array(rows), axis=0).tolist()
    return Smoothness(neighbours, anyone, dict(zip(READINGS, others, strict=True)))


def unlike_maps(grids: Sequence[np.ndarray]) -> list[str]:
    """What is wrong with maps [h, w, F] whose neighbouring cells are not alike."""
    if not grids:
        return []
    found = smoothness(grids)
    best = max(found.readings, key=lambda reading: found.readings[reading])
    agree = f"neighbouring cells agree to {found.neighbours:.2f}"
    if found.readings[best] - found.neighbours > LEAST_SMOOTHNESS:
        told = f"read as {best} they would to {found.readings[best]:.2f}: the bytes lie in that order"
        chosen = "--layout chw (in Python layout='chw')"
        hint = f"pack maps of channels first with {chosen}, and write others from contiguous arrays"
        return [f"features: {agree}, {told}; {hint}"]
    if found.share < LEAST_SMOOTHNESS:
        return [f"features: {agree}, as any two cells do: the maps show nothing of the photos"]
    return []


def _agreement(grid: np.ndarray) -> tuple[float, float]:
    """The mean cosine of neighbouring cells of a grid [h, w, F], and of any two."""
    grid = grid / np.maximum(np.abs(grid).max(axis=2, keepdims=True), 1e-30)  # no square overflows or vanishes
    unit = grid / np.maximum(np.linalg.norm(grid, axis=2, keepdims=True), 1e-30)
    down, across = (unit[1:] * unit[:-1]).sum(axis=2), (unit[:, 1:] * unit[:, :-1]).sum(axis=2)
    mean = unit.reshape(-1, unit.shape[2]).mean(axis=0)
    count = unit.shape[0] * unit.shape[1]
    anyone = (count * float(mean @ mean) - 1) / max(count - 1, 1)
    return float(np.concatenate([down.ravel(), across.ravel()]).mean()) if count > 1 else 1.0, anyone


def some_grids(features: Mapping[str, ViewFeatures], names: Sequence[str]) -> list[np.ndarray]:
    """The maps [h, w, F] f32 of some of the views, evenly spread; none where fewer are grids."""
    some = [names[int(place)] for place in np.linspace(0, len(names) - 1, min(LOOKED_AT, len(names)))]
    grids = [read.grid.float().numpy() for view in some if isinstance(read := features[view], FeatureGrid)]
    return grids if len(grids) == LOOKED_AT else []
