"""Region weights: what each region of each view weighs at each splat, before any feature is looked at."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from liftcore.solve.gathering import Gathering
from liftcore.solve.host import Host
from liftcore.solve.view_weights import WeightStore


@dataclass(frozen=True)
class RegionWeights:
    """``W = A^T S`` of all views, CSR by splat. Features of any encoder for the same regions are ``D^-1 W E``."""

    splats: Tensor  # [n] i32 ascending, the splats that have a row
    indptr: Tensor  # [n + 1] i64, where rows begin
    region: Tensor  # [nnz] i32 ascending in a row: view v's region m, or cell of a grid, is offsets[v] + m
    weight: Tensor  # [nnz] f32, sums over rays
    offsets: Tensor  # [V + 1] i64, the first region of each view, and how many there are in all
    views: tuple[str, ...]  # their names, in the order of the offsets

    def matrix(self, splats: int) -> csr_array:
        """W [splats, M] for scipy, a row for each of so many splats."""
        lengths = np.zeros(splats, np.int64)
        lengths[self.splats.numpy()] = np.diff(self.indptr.numpy())
        indptr = np.concatenate([[0], np.cumsum(lengths)])
        return csr_array((self.weight.numpy(), self.region.numpy(), indptr), shape=(splats, int(self.offsets[-1])))


def merged(
    store: WeightStore, counts: list[int], views: tuple[str, ...], splats: int, threads: int | None
) -> RegionWeights:
    """The weights of all views in one matrix.

    Args:
        counts: regions of every view. splats: P.
    """
    with Host(threads).workers() as (_, each_share):
        gathering = Gathering(each_share, store, counts, np.ones(splats), None, 0)
        chunks = [(np.diff(chunk.indptr), chunk.rows, chunk.shares) for chunk in gathering]
    lengths, region, weight = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
    rows = np.flatnonzero(lengths)
    indptr, offsets = np.concatenate([[0], np.cumsum(lengths[rows])]), np.concatenate([[0], np.cumsum(counts)])
    return RegionWeights(
        splats=torch.from_numpy(rows.astype(np.int32)),
        indptr=torch.from_numpy(indptr),
        region=torch.from_numpy(region),
        weight=torch.from_numpy(weight),
        offsets=torch.from_numpy(offsets),
        views=views,
    )
