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
from liftcore.observe.label_tuples import label_tuples
from liftcore.observe.observation import NO_LABEL, Observation, RegionMap

Levels = Literal["rows", "composite"] | int


def at_levels(observation: Observation, levels: Levels, view: str) -> Observation:
    """The observation as ``levels`` takes it; a grid is its own level 0.

    Args:
        levels: "rows" as it is, "composite" one region a distinct tuple of labels, a number that level alone.
        view: named in an error.

    Raises:
        InvalidFeatures: the view lacks the level.
    """
    if levels == "rows":
        return observation
    if levels != "composite":
        return _one_level(observation, levels, view)
    return composite(observation) if isinstance(observation, RegionMap) else observation


def composite(regions: RegionMap) -> RegionMap:
    """One level whose regions are the distinct tuples of labels, in the order of their labels."""
    labels = regions.labels.to(torch.int32).contiguous().numpy()
    numbers, tuples = label_tuples(labels, labels[0].size)
    if not tuples.size:
        return RegionMap(regions.labels[:1], regions.codebook)
    order = np.lexsort(tuples.T[::-1])
    place = np.append(np.argsort(order), NO_LABEL).astype(np.int32)  # of each tuple; of none, which is -1, the last
    return RegionMap(torch.from_numpy(place[numbers][None]), _summed(tuples[order].T, regions.codebook))


def _one_level(observation: Observation, level: int, view: str) -> Observation:
    count = observation.labels.shape[0] if isinstance(observation, RegionMap) else 1
    if not 0 <= level < count:
        got = f"levels 0 to {count - 1}" if count > 1 else "level 0 only"
        hint = "set levels to rows, composite or a level that every view has"
        raise InvalidFeatures(f"view {view!r}", expected=f"level {level}", got=got, hint=hint)
    if not isinstance(observation, RegionMap):
        return observation
    return RegionMap(observation.labels[level : level + 1], observation.codebook)


def _summed(tuples: np.ndarray, codebook: torch.Tensor) -> torch.Tensor:
    """[n, F]: the unit sums of the embeddings of each tuple [L, n], zero where they cancel; the codebook's dtype."""
    largest = codebook.abs().amax().double().clamp_min(torch.finfo(torch.float64).tiny)  # squares cannot overflow
    sums = torch.zeros(tuples.shape[1], codebook.shape[1], dtype=torch.float32)
    for level in tuples:
        labelled = torch.from_numpy(np.flatnonzero(level != NO_LABEL))
        rows = codebook[torch.from_numpy(level.astype(np.int64))[labelled]]
        sums[labelled] += (rows.double() / largest).float()
    norms = torch.linalg.vector_norm(sums.double(), dim=1, keepdim=True).clamp_min(torch.finfo(torch.float32).tiny)
    return (sums / norms).to(codebook.dtype)
