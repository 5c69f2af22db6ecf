"""Each step of a lift on blocks of splats gives the bits of a scene that lies in one place."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from liftcore.solve.codebook import Codebook
from liftcore.solve.directions import RegionDirections, region_totals
from liftcore.solve.reweight import SceneAgreement, ViewConsistency, agreement_factors
from liftcore.solve.sums import PIECE, PieceSums, added, packed, unpacked
from liftcore.solve.weights import RegionWeights, one_view, stacked
from tests.unit.solve.sparse_views import codebook_of

SPLATS = 3 * PIECE - 700
VIEWS, REGIONS = 6, 12  # of a view, half of them on each of two levels
LEVELS = np.tile(np.repeat(np.array([0, 1], np.int8), REGIONS // 2), VIEWS)


def random_view(rng: np.random.Generator) -> RegionWeights:
    """Some splats, most with a region of each level, which their place gives, some with another one beside."""
    splats = np.flatnonzero(rng.random(SPLATS) < 0.2).astype(np.int32)
    own = splats // (SPLATS // 4) + rng.integers(0, 2, splats.size)
    coarse = np.where(rng.random(splats.size) < 0.1, rng.integers(0, REGIONS // 2, splats.size), own)
    view = np.zeros((splats.size, REGIONS), np.float32)
    every = np.arange(splats.size)
    view[every, coarse] = rng.uniform(0.01, 3.0, splats.size)
    view[every, REGIONS // 2 + own] = rng.uniform(0.01, 3.0, splats.size)
    rows, region = np.nonzero(view)
    indptr = np.concatenate([[0], np.cumsum((view > 0).sum(axis=1))])
    parts = splats, indptr, region.astype(np.int32), view[rows, region]
    ids, starts, regions, weights = (torch.from_numpy(part) for part in parts)
    return one_view(ids, starts, regions, weights, ids, torch.rand(ids.shape[0]), regions=REGIONS)


@pytest.fixture(scope="module", name="W")
def weights() -> RegionWeights:
    rng = np.random.default_rng(0)
    return stacked([random_view(rng) for _ in range(VIEWS)], SPLATS)


@pytest.fixture(scope="module")
def means() -> torch.Tensor:
    return torch.rand(SPLATS, 3, generator=torch.manual_seed(1))


@pytest.fixture(scope="module")
def codebook() -> Codebook:
    rng = np.random.default_rng(2)
    return codebook_of([torch.from_numpy(rng.normal(size=(REGIONS, 9)).astype(np.float32)) for _ in range(VIEWS)])


@pytest.fixture(params=[1, 2])
def blocks(request: pytest.FixtureRequest) -> list[tuple[int, int]]:
    """Of so many pieces; the last one is shorter."""
    rows = request.param * PIECE
    return [(first, min(first + rows, SPLATS)) for first in range(0, SPLATS, rows)]


def over_files(parts: list[PieceSums]) -> Iterator[PieceSums]:
    """The sums of a block's pieces as those who read them from its file have them."""
    return unpacked({name: tensor.numpy() for name, tensor in packed(parts).items()})


def test_robust_steps_in_blocks_are_those_of_the_whole_scene(
    W: RegionWeights, means: torch.Tensor, codebook: Codebook, blocks: list[tuple[int, int]]
) -> None:
    masks, steps = torch.from_numpy(LEVELS == 0), 2
    consensus = torch.rand(W.weight.shape, generator=torch.manual_seed(3))
    whole = agreement_factors(W, codebook, steps, means=means, threads=2, reliability=masks, consensus=consensus)
    parts = [W.of_splats(*ends) for ends in blocks]
    judges = [ViewConsistency(part, means[a:b], 1) for part, (a, b) in zip(parts, blocks, strict=True)]
    sums = (sums for part in parts for sums in over_files(list(region_totals(part, 1))))
    totals = torch.from_numpy(added(sums, (1, codebook.regions))[0])
    directions = RegionDirections(codebook, totals, W.region.shape[0])
    own = [slice(int(W.indptr[a]), int(W.indptr[b])) for a, b in blocks]
    factors, scores, scene = [None] * len(blocks), [], None
    for _ in range(steps):
        found = list[PieceSums]()
        cosines = [
            judge.cosines(directions, before, True, found.append)
            for judge, before in zip(judges, factors, strict=True)
        ]
        scene = SceneAgreement.of(added(over_files(found), (2, codebook.regions + 1)), masks)
        scores = [
            judge.weigh(cosine, before, scene, consensus[entries])
            for judge, cosine, before, entries in zip(judges, cosines, factors, own, strict=True)
        ]
        factors = cosines
    assert scene is not None and scene.reliability == whole.reliability
    assert torch.equal(torch.cat([part for part in factors if part is not None]), whole.factors)
    confidence, explained = torch.cat(scores, dim=1)
    assert whole.confidence is not None and torch.equal(confidence, whole.confidence)
    assert whole.explained is not None and torch.equal(explained, whole.explained)
    assert len(torch.unique(whole.factors)) > 1000
