"""W of small views, random or from dense matrices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from liftcore.solve.codebook import Codebook, ViewCodebook
from liftcore.values.region_weights import RegionWeights, one_view


def of_dense(view: np.ndarray) -> RegionWeights:
    """W of a view from a dense matrix [P, M]."""
    splats = np.flatnonzero(view.any(axis=1)).astype(np.int32)
    rows, region = np.nonzero(view)
    starts = np.concatenate([[0], np.cumsum((view[splats] != 0).sum(axis=1))]).astype(np.int64)
    parts = splats, starts, region.astype(np.int32), view[rows, region].astype(np.float32)
    ids, indptr, regions, weights = (torch.from_numpy(part) for part in parts)
    return one_view(ids, indptr, regions, weights, ids, torch.ones(splats.size), regions=view.shape[1])


def random_view(seed: int, regions: int, splats: int) -> RegionWeights:
    """W of a view: some splats, each with one to six entries."""
    rng = np.random.default_rng(seed)
    view = np.zeros((splats, regions))
    for splat in np.flatnonzero(rng.random(splats) < 0.4):
        row_regions = rng.choice(regions, rng.integers(1, min(6, regions) + 1), replace=False)
        view[splat, row_regions] = rng.uniform(0.01, 1, row_regions.size)
    return of_dense(view)


def dense(W: RegionWeights, splats: int) -> np.ndarray:
    """[P, M] f64."""
    return W.matrix(splats).toarray().astype(np.float64)


def codebook_of(books: Sequence[Tensor]) -> Codebook:
    """Return a codebook in which each region is one row of its view's book [M, F]."""
    return Codebook([ViewCodebook(book) for book in books])
