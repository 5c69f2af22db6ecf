"""How the levels of a region map are taken: each as rows of its own, put together, or one alone.

Composite regions are the distinct tuples of labels that pixels carry over the levels. Each becomes one row of a new
codebook, the sum of the embeddings of its labels, normalised; an unlabelled level adds nothing. So a pixel reads one
row, as dense maps of summed embeddings have it, and the walk still meets no channel.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch

from liftcore.errors import InvalidFeatures
from liftcore.features.label_tuples import label_tuples
from liftcore.features.views import NO_LABEL, Regions, ViewFeatures

COMPOSITE_BYTES = 1 << 28  # of a view's codebook of tuples; real maps have some thousands of them
_BLOCK_FLOATS = 1 << 22  # summed at once

Levels = Literal["rows", "composite"] | int


def at_levels(observation: ViewFeatures, levels: Levels, view: str) -> ViewFeatures:
    """The observation as ``levels`` takes it; a grid is its own level 0.

    Args:
        levels: "rows" as it is, "composite" one region a distinct tuple of labels, a number that level alone.
        view: named in an error.

    Raises:
        InvalidFeatures: the view lacks the level, or has more tuples of labels than there is room for.
    """
    if levels == "rows":
        return observation
    if levels != "composite":
        return _one_level(observation, levels, view)
    return composite(observation, view) if isinstance(observation, Regions) else observation


def composite(regions: Regions, view: str) -> Regions:
    """One level whose regions are the distinct tuples of labels, in the order of their labels.

    Raises:
        InvalidFeatures: their codebook would take more than COMPOSITE_BYTES.
    """
    labels = regions.labels.to(torch.int32).contiguous().numpy()
    numbers, tuples = label_tuples(labels, labels[0].size)
    if not tuples.size:
        return Regions(regions.labels[:1], regions.codebook)
    size = tuples.shape[0] * regions.codebook[0].nbytes
    if size > COMPOSITE_BYTES:
        raise InvalidFeatures(
            f"view {view!r}", expected=f"tuples of labels whose sums take at most {COMPOSITE_BYTES >> 20} MiB",
            got=f"{tuples.shape[0]} tuples of {regions.codebook.shape[1]} channels, {size >> 20} MiB",
            hint="set levels to rows, which takes no room for tuples, or smooth the label maps",
        )  # fmt: skip
    order = np.lexsort(tuples.T[::-1])
    place = np.append(np.argsort(order), NO_LABEL).astype(np.int32)  # of each tuple; of none, which is -1, the last
    return Regions(torch.from_numpy(place[numbers][None]), _summed(tuples[order].T, regions.codebook))


def _one_level(observation: ViewFeatures, level: int, view: str) -> ViewFeatures:
    count = observation.labels.shape[0] if isinstance(observation, Regions) else 1
    if not 0 <= level < count:
        got = f"levels 0 to {count - 1}" if count > 1 else "level 0 only"
        hint = "set levels to rows, composite or a level that every view has"
        raise InvalidFeatures(f"view {view!r}", expected=f"level {level}", got=got, hint=hint)
    if not isinstance(observation, Regions):
        return observation
    return Regions(observation.labels[level : level + 1], observation.codebook)


def _summed(tuples: np.ndarray, codebook: torch.Tensor) -> torch.Tensor:
    """[n, F]: the unit sums of the embeddings of each tuple [L, n], zero where they cancel; the codebook's dtype."""
    largest = codebook.abs().amax().double().clamp_min(torch.finfo(torch.float64).tiny)  # squares cannot overflow
    sums = torch.empty(tuples.shape[1], codebook.shape[1], dtype=codebook.dtype)
    at_a_time = max(1, _BLOCK_FLOATS // codebook.shape[1])
    for first in range(0, sums.shape[0], at_a_time):
        block = slice(first, first + at_a_time)
        sums[block] = _unit_sums(tuples[:, block], codebook, largest)
    return sums


def _unit_sums(tuples: np.ndarray, codebook: torch.Tensor, largest: torch.Tensor) -> torch.Tensor:
    sums = torch.zeros(tuples.shape[1], codebook.shape[1], dtype=torch.float32)
    for level in tuples:
        labelled = torch.from_numpy(np.flatnonzero(level != NO_LABEL))
        rows = codebook[torch.from_numpy(level.astype(np.int64))[labelled]]
        sums[labelled] += (rows.double() / largest).float()
    norms = torch.linalg.vector_norm(sums.double(), dim=1, keepdim=True).clamp_min(torch.finfo(torch.float32).tiny)
    return sums / norms
