"""Levels of a region map: separate rows of each, a composite, or a single one.

Composite regions are the distinct tuples of labels that pixels carry over the levels. Each becomes one row of a new
codebook, the sum of the embeddings of its labels, normalised; an unlabelled level adds nothing. So a pixel reads one
row, as dense maps of summed embeddings have it, and rasterization still reads no channel.
"""

from typing import Literal

import numpy as np
import torch

from liftcore.errors import InvalidFeatures
from liftcore.values.views import NO_LABEL, Regions, ViewFeatures

COMPOSITE_BYTES = 1 << 28  # of a view's codebook of tuples; real maps have some thousands of them
BLOCK_FLOATS = 1 << 22  # summed at once

Levels = Literal["rows", "composite"] | int


def region_levels(regions: Regions) -> np.ndarray:
    """Return [M] i8: the level that each codebook row is labelled on, the coarsest of several; -1 on none."""
    row_levels = np.full(regions.codebook.shape[0] + 1, NO_LABEL, np.int8)
    for level in reversed(range(regions.labels.shape[0])):
        row_levels[regions.labels[level].numpy().ravel()] = level  # no label is the place after the last row
    return row_levels[:-1]


def at_levels(features: ViewFeatures, levels: Levels, view: str) -> ViewFeatures:
    """Return the features as ``levels`` takes them; a grid is its own level 0.

    Args:
        levels: "rows" as they are, "composite" one region a distinct tuple of labels, a number that level alone.
        view: named in an error.

    Raises:
        InvalidFeatures: the view lacks the level, or has more tuples of labels than there is room for.
    """
    if levels == "rows":
        return features
    if levels == "composite":
        return composite(features, view) if isinstance(features, Regions) else features
    count = features.labels.shape[0] if isinstance(features, Regions) else 1
    if not 0 <= levels < count:
        got = f"levels 0 to {count - 1}" if count > 1 else "level 0 only"
        hint = "set levels to rows, composite or a level that every view has"
        raise InvalidFeatures(f"view {view!r}", expected=f"level {levels}", got=got, hint=hint)
    if not isinstance(features, Regions):
        return features
    return Regions.unchecked(features.labels[levels : levels + 1], features.codebook)


def composite(regions: Regions, view: str) -> Regions:
    """Return one level whose regions are the distinct tuples of labels, in the order of their labels.

    Raises:
        InvalidFeatures: their codebook would take more than COMPOSITE_BYTES.
    """
    numbers, tuples = label_tuples(regions.labels.numpy())
    if not len(tuples):
        return Regions.unchecked(regions.labels[:1], regions.codebook)
    size = len(tuples) * regions.codebook[0].nbytes
    if size > COMPOSITE_BYTES:
        raise InvalidFeatures(
            f"view {view!r}", expected=f"tuples of labels whose sums take at most {COMPOSITE_BYTES >> 20} MiB",
            got=f"{len(tuples)} tuples of {regions.codebook.shape[1]} channels, {size >> 20} MiB",
            hint="set levels to rows, which takes no room for tuples, or smooth the label maps",
        )  # fmt: skip
    order = np.lexsort(tuples.T[::-1])
    place = np.append(np.argsort(order), NO_LABEL).astype(np.int32)  # of each tuple; of none, which is -1, the last
    return Regions.unchecked(torch.from_numpy(place[numbers][None]), _unit_sums(tuples[order].T, regions.codebook))


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


def _unit_sums(tuples: np.ndarray, codebook: torch.Tensor) -> torch.Tensor:
    """Return [n, F] in the codebook's dtype: the normalised sum of the embeddings of each tuple [L, n], or zeros."""
    largest = codebook.abs().amax().double().clamp_min(torch.finfo(torch.float64).tiny)  # squares cannot overflow
    output = torch.empty(tuples.shape[1], codebook.shape[1], dtype=codebook.dtype)
    for block in torch.arange(len(output)).split(max(1, BLOCK_FLOATS // codebook.shape[1])):
        sums = torch.zeros(len(block), codebook.shape[1], dtype=torch.float32)
        for level in torch.from_numpy(tuples.astype(np.int64))[:, block]:
            labelled = level != NO_LABEL
            sums[labelled] += (codebook[level[labelled]].double() / largest).float()
        norms = torch.linalg.vector_norm(sums.double(), dim=1, keepdim=True)
        output[block] = (sums / norms.clamp_min(torch.finfo(torch.float32).tiny)).to(codebook.dtype)
    return output
