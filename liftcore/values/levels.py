"""Levels of a region map: all of them, or a single one."""

from typing import Literal

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.values.views import NO_LABEL, Regions, ViewFeatures

Levels = Literal["rows"] | int


def region_levels(regions: Regions) -> np.ndarray:
    """Return [M] i8: the level that each codebook row is labelled on, the coarsest of several; -1 on none."""
    row_levels = np.full(regions.codebook.shape[0] + 1, NO_LABEL, np.int8)
    for level in reversed(range(regions.labels.shape[0])):
        row_levels[regions.labels[level].numpy().ravel()] = level  # no label is the place after the last row
    return row_levels[:-1]


def at_levels(features: ViewFeatures, levels: Levels, view: str) -> ViewFeatures:
    """Return the features as ``levels`` takes them; a grid is its own level 0."""
    if levels == "rows":
        return features
    count = features.labels.shape[0] if isinstance(features, Regions) else 1
    if not 0 <= levels < count:
        got = f"levels 0 to {count - 1}" if count > 1 else "level 0 only"
        hint = "set levels to rows, or to a level that every view has"
        raise InvalidFeatures(f"view {view!r}", expected=f"level {levels}", got=got, hint=hint)
    if not isinstance(features, Regions):
        return features
    return Regions.unchecked(features.labels[levels : levels + 1], features.codebook)


def label_tuples(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the distinct tuples of labels that pixels carry over the levels, in the order of the pixels.

    Args:
        labels: [L, h, w] i32, -1 for none.

    Returns:
        numbers [h, w] i32, -1 where no level has a label; tuples [T, L] i32.
    """
    flat = labels.reshape(len(labels), -1)
    starts = np.ones(flat.shape[1], bool)  # of runs of pixels that have their neighbour's tuple: most have
    starts[1:] = False
    for level in flat:
        starts[1:] |= level[1:] != level[:-1]
    runs = flat[:, starts]
    keys = runs[0].astype(np.int64)
    for level in runs[1:]:  # numbered anew at each level, so that keys do not overflow
        keys = np.unique(keys, return_inverse=True)[1] * (int(level.max()) + 2) + level + 1
    _, first, of_run = np.unique(keys, return_index=True, return_inverse=True)
    labelled = np.flatnonzero((runs[:, first] != NO_LABEL).any(axis=0))
    order = labelled[np.argsort(first[labelled])]
    number = np.full(len(first), NO_LABEL, np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    lengths = np.diff(np.flatnonzero(starts), append=flat.shape[1])
    return np.repeat(number[of_run], lengths).reshape(labels.shape[1:]), np.ascontiguousarray(runs[:, first[order]].T)
