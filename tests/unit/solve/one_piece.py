"""The steps of a lift on W in one piece."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.lifting import steps
from liftcore.lifting.algebra import Algebra
from liftcore.lifting.engines import LocalEngine
from liftcore.lifting.geometry import Geometry
from liftcore.lifting.in_memory import pieces_of
from liftcore.runtime.progress import silent
from liftcore.solve.codebook import Codebook
from liftcore.solve.directions import RegionDirections
from liftcore.solve.objects import RegionObjects
from liftcore.solve.reweight import BlockReweighter, SceneConsistency, confidence_of, median_reliability
from liftcore.solve.sums import sum_pieces
from liftcore.values.region_weights import RegionWeights
from liftcore.values.settings import DIRECTIONS, LiftSettings
from tests.unit.solve.sparse_views import codebook_of


@dataclass(frozen=True)
class Reweighting:
    """Factors and scores of the robust step."""

    factors: Tensor  # [nnz] f32
    confidence: Tensor  # [P] f32
    reliability: float | None


def algebra_of(
    W: RegionWeights,
    codebook: Codebook | None = None,
    levels: np.ndarray | None = None,
    means: Tensor | None = None,
    **settings: Any,
) -> Algebra:
    """Return the algebra of W, with codebooks of zeros if there is none."""
    regions, splats = int(W.offsets[-1]), W.splats.shape[0]
    codebook = codebook or codebook_of([torch.zeros(int(count), 1) for count in W.offsets.diff()])
    geometry = Geometry(W, codebook, (), (), np.full(regions, -1, np.int8) if levels is None else levels)
    means, names = torch.zeros(splats, 3) if means is None else means, tuple(map(str, range(len(codebook.views))))
    pieces = pieces_of(geometry, means, LiftSettings.of(**settings), names, threads=None, memory_limit=None)
    return Algebra(pieces, LocalEngine(), silent, None)


def mask_consensus(W: RegionWeights, levels: np.ndarray, means: Tensor | None = None) -> np.ndarray:
    """Return c of every entry of W [nnz] f32."""
    algebra = algebra_of(W, levels=levels, means=means)
    algebra.compare_masks()
    consensus = steps.consensus_of(algebra.pieces, 0, steps.splat_block(algebra.pieces, 0).W, None)
    assert consensus is not None
    return consensus.numpy()


def region_objects(W: RegionWeights, levels: np.ndarray, total_weight: np.ndarray) -> RegionObjects:
    """Return the objects of W, numbered by total weight [P]."""
    weights = torch.from_numpy(total_weight.astype(np.float32))
    W = replace(W, total_weight_splats=torch.arange(weights.shape[0], dtype=torch.int32), total_weight=weights)
    return algebra_of(W, levels=levels).find_objects()[0]


def reweighting_of(
    W: RegionWeights,
    codebook: Codebook,
    *,
    masks: Tensor | None = None,
    consensus: Tensor | None = None,
    levels: np.ndarray | None = None,
) -> Reweighting:
    """Return the factors of W; masks [M] bool are the regions with a reliability."""
    totals = np.bincount(W.region.numpy(), W.weight.numpy(), minlength=codebook.regions).astype(np.float64)
    directions = RegionDirections.of(codebook, torch.from_numpy(totals), W.region.shape[0], DIRECTIONS)
    level_of = np.zeros(codebook.regions) if levels is None else levels
    groups = np.unique(level_of, return_inverse=True)[1].astype(np.int8)
    scores, mask = np.zeros((2, W.splats.shape[0])), np.zeros(groups.size, bool) if masks is None else masks.numpy()
    block = BlockReweighter(W, groups, None, None)
    factors, parts = block.cosines(directions, masks is not None)
    sums = sum_pieces(parts, block.shape)
    block.weigh(factors, SceneConsistency.of(sums, groups, mask), consensus, scores)
    return Reweighting(factors, confidence_of(scores), median_reliability(sums, mask))


def solve(W: RegionWeights, codebook: Codebook) -> Tensor:
    """Return ``D^-1 W E`` [P, F] f32."""
    return algebra_of(W, codebook, preset="row-sum", dtype="float32").solve()[0]
