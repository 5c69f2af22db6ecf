"""Each step of a lift on blocks of splats gives the same bits as on the whole scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from liftcore.solve import objects
from liftcore.solve.aggregate import cluster_means, cluster_sums, guard, with_feature
from liftcore.solve.codebook import Codebook
from liftcore.solve.consensus import (
    SplatTuples,
    along_curve,
    mask_consensus,
    mean_share,
    region_shares,
    splat_tuples,
    with_mean,
)
from liftcore.solve.directions import RegionDirections, region_totals
from liftcore.solve.loss import RegionDistances, huber_factors, mean_distance
from liftcore.solve.membership import RegionGroups, memberships
from liftcore.solve.region_tree import region_tree
from liftcore.solve.reweight import BlockReweighter, SceneConsistency, reweighting_factors
from liftcore.solve.rows import SomeRows, gather_rows, take_rows
from liftcore.solve.sums import PIECE, PieceSums, pack_sums, sum_pieces, unpack_sums
from liftcore.values.region_weights import RegionWeights, one_view, stacked
from tests.unit.solve.sparse_views import codebook_of

SPLATS = 3 * PIECE - 700
VIEWS, REGIONS = 6, 12  # of a view, half of them on each of two levels
LEVELS = np.tile(np.repeat(np.array([0, 1], np.int8), REGIONS // 2), VIEWS)


def random_view(rng: np.random.Generator) -> RegionWeights:
    """Return W of a random view: most splats have one region a level, by their position; some have a second one."""
    splats = np.flatnonzero(rng.random(SPLATS) < 0.6).astype(np.int32)
    labels = np.where(rng.random(splats.size) < 0.1, rng.integers(0, 6, splats.size), splats // (SPLATS // 4))
    coarse = np.where(rng.random(splats.size) < 0.1, rng.integers(0, REGIONS // 2, splats.size), labels)
    view = np.zeros((splats.size, REGIONS), np.float32)
    indices = np.arange(splats.size)
    view[indices, coarse] = rng.uniform(0.01, 3.0, splats.size)
    view[indices, REGIONS // 2 + labels] = rng.uniform(0.01, 3.0, splats.size)
    rows, region = np.nonzero(view)
    indptr = np.concatenate([[0], np.cumsum((view > 0).sum(axis=1))])
    parts = splats, indptr, region.astype(np.int32), view[rows, region]
    ids, starts, regions, weights = (torch.from_numpy(part) for part in parts)
    return one_view(ids, starts, regions, weights, ids, torch.rand(ids.shape[0]), regions=REGIONS)


@pytest.fixture(scope="module")
def views() -> list[RegionWeights]:
    rng = np.random.default_rng(0)
    return [random_view(rng) for _ in range(VIEWS)]


@pytest.fixture(scope="module", name="W")
def weights(views: list[RegionWeights]) -> RegionWeights:
    return stacked(views, SPLATS)


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
    return unpack_sums({name: tensor.numpy() for name, tensor in pack_sums(parts).items()})


def test_robust_steps_in_blocks_are_those_of_the_whole_scene(
    W: RegionWeights, means: torch.Tensor, codebook: Codebook, blocks: list[tuple[int, int]]
) -> None:
    masks, steps = torch.from_numpy(LEVELS == 0), 2
    consensus = torch.rand(W.weight.shape, generator=torch.manual_seed(3))
    expected = reweighting_factors(
        W, codebook, steps, means=means, threads=2, reliability=masks, consensus=consensus, levels=LEVELS
    )
    parts = [W.of_splats(*ends) for ends in blocks]
    blocks_of_views = [
        BlockReweighter(part, means[a:b], 1, LEVELS) for part, (a, b) in zip(parts, blocks, strict=True)
    ]
    sums = (sums for part in parts for sums in over_files(list(region_totals(part, 1))))
    totals = torch.from_numpy(sum_pieces(sums, (1, codebook.regions))[0])
    directions = RegionDirections(codebook, totals, W.region.shape[0])
    entry_slices = [slice(int(W.indptr[a]), int(W.indptr[b])) for a, b in blocks]
    factors, scores, scene = [None] * len(blocks), [], None
    for _ in range(steps):
        sums_of_pieces = list[PieceSums]()
        cosines = [
            block.cosines(directions, before, True, sums_of_pieces.append)
            for block, before in zip(blocks_of_views, factors, strict=True)
        ]
        sums = sum_pieces(over_files(sums_of_pieces), (2, codebook.regions + blocks_of_views[0].levels))
        scene = SceneConsistency.of(sums, masks, blocks_of_views[0].level)
        scores = [
            block.weigh(cosine, before, scene, consensus[entries])
            for block, cosine, before, entries in zip(blocks_of_views, cosines, factors, entry_slices, strict=True)
        ]
        factors = cosines
    assert scene is not None and scene.reliability == expected.reliability
    assert torch.equal(torch.cat([part for part in factors if part is not None]), expected.factors)
    confidence, consistency = torch.cat(scores, dim=1)
    assert expected.confidence is not None and torch.equal(confidence, expected.confidence)
    assert expected.feature_consistency is not None and torch.equal(consistency, expected.feature_consistency)
    assert len(torch.unique(expected.factors)) > 1000


@dataclass(frozen=True)
class ViewBlock:
    """Inputs of a worker for some views: their splats and W of these, with the region numbers of the whole scene."""

    base: int  # the first region
    splats: np.ndarray  # [n] i64
    W: RegionWeights
    own_region: np.ndarray  # [nnz] bool, entries of W whose splat belongs to their region
    tuples: SplatTuples  # of these views alone


def view_blocks(views: list[RegionWeights], groups: RegionGroups, size: int) -> list[ViewBlock]:
    blocks = []
    for first in range(0, VIEWS, size):
        view_weights = stacked(views[first : first + size], SPLATS)
        splats, base = np.flatnonzero(view_weights.indptr.diff().numpy()), first * REGIONS
        indptr = torch.cat([view_weights.indptr[:1], view_weights.indptr[1:][torch.from_numpy(splats)]])
        W = replace(view_weights, indptr=indptr, region=view_weights.region + base)
        own_region = memberships(W, groups, 1).own_region
        tuples = splat_tuples(W, own_region, groups, np.arange(splats.size))
        blocks.append(ViewBlock(base, splats, W, own_region, tuples))
    return blocks


def all_tuples(parts: list[ViewBlock]) -> SplatTuples:
    """Of all splats in all views, from the views' own numbers of tuples."""
    bases = np.cumsum([0, *(part.tuples.members.size for part in parts)])
    starts, (tuples,) = gather_rows(
        lambda: (
            SomeRows(part.splats, part.tuples.starts, [part.tuples.tuples + np.int32(base)])
            for part, base in zip(parts, bases, strict=False)
        ),
        SPLATS,
        [torch.int32],
    )
    block_parents = [
        np.where(p.tuples.parents < 0, -1, p.tuples.parents + b) for p, b in zip(parts, bases, strict=False)
    ]
    parents, members = (
        np.concatenate(block_parents).astype(np.int32),
        np.concatenate([p.tuples.members for p in parts]),
    )
    return SplatTuples(starts, tuples.numpy(), parents, members)


@pytest.mark.parametrize("size", [1, 4])
def test_consensus_by_blocks_of_views_is_that_of_the_whole_scene(
    views: list[RegionWeights], W: RegionWeights, means: torch.Tensor, size: int
) -> None:
    groups = RegionGroups.of(W.offsets.numpy(), LEVELS)
    parts, totals = view_blocks(views, groups, size), W.row_sums().numpy()
    tuples, rows_of_scene = all_tuples(parts), torch.nonzero(W.indptr.diff())[:, 0]
    bounds, shares = torch.stack([means[rows_of_scene].amin(dim=0), means[rows_of_scene].amax(dim=0)]), []
    for part in parts:
        rows = along_curve(means[torch.from_numpy(part.splats)], bounds)
        splats = part.splats[rows]
        block_tuples = SplatTuples(*take_rows(tuples.starts, splats, tuples.tuples), tuples.parents, tuples.members)
        shares.append(
            region_shares(
                part.W, part.own_region, groups, rows, totals[splats], block_tuples, base=part.base, threads=1
            )
        )
    mean = mean_share(sum(part.share_sum for part in shares), sum(part.share_count for part in shares))
    _, (sums, counts) = gather_rows(
        lambda: (
            SomeRows(part.splats, part.W.indptr.numpy(), [share.sums, share.views])
            for part, share in zip(parts, shares, strict=True)
        ),
        SPLATS,
        [torch.float32, torch.uint8],
    )
    assert np.unique(counts.numpy()).size > 3
    expected = mask_consensus(W, LEVELS, 2, means=means)
    np.testing.assert_array_equal(with_mean(sums.numpy(), counts.numpy(), mean, 1), expected)


def test_objects_by_blocks_are_those_of_the_whole_scene(
    views: list[RegionWeights], W: RegionWeights, blocks: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(objects, "MOST_REGIONS", VIEWS * REGIONS // 2)  # so that some views give no nodes
    monkeypatch.setattr(objects, "FEWEST_VIEWS", 3)
    total_weight = np.random.default_rng(4).random(SPLATS)
    expected = objects.region_objects(W, LEVELS, total_weight, 2)
    groups = RegionGroups.of(W.offsets.numpy(), LEVELS)
    parts, totals = view_blocks(views, groups, 2), W.row_sums().numpy()
    tuples = all_tuples(parts)
    sizes = np.concatenate(
        [np.bincount(p.W.region.numpy()[p.own_region] - p.base, minlength=2 * REGIONS) for p in parts]
    )
    nodes, other_masks = objects.choose_nodes(groups, sizes)
    assert nodes.size and other_masks.size
    containers = []
    for part in parts:
        begins, rows = objects.sampled_splats(part.W, part.own_region, nodes, part.base)
        local, numbers = np.unique(rows, return_inverse=True)
        splats = part.splats[local]
        block_tuples = SplatTuples(*take_rows(tuples.starts, splats, tuples.tuples), tuples.parents, tuples.members)
        table = objects.sampled_nodes(begins, numbers, block_tuples, totals[splats], nodes, LEVELS.size)
        containers.append(objects.node_containers(table, nodes, groups, 1))
    tree = region_tree(nodes, groups, np.concatenate(containers), 1)
    number = tree.parents.size
    cut = [W.of_splats(*ends) for ends in blocks]
    labels = [objects.node_labels(part, groups, tree, 1) for part in cut]
    shares = [
        sums
        for part, block_tuples in zip(cut, labels, strict=True)
        for sums in objects.node_shares(part, block_tuples, number, other_masks, 1)
    ]
    tree = objects.add_regions(tree, other_masks, over_files(shares))
    labels = [objects.node_labels(part, groups, tree, 1) for part in cut]
    sums = [
        sums
        for part, block_tuples in zip(cut, labels, strict=True)
        for sums in objects.view_shares(part, groups, block_tuples, number, 1)
    ]
    view_weights = sum_pieces(over_files(sums), (1, number * VIEWS)).reshape(number, VIEWS)
    all_labels = np.concatenate(labels)
    got = objects.number_objects(
        all_labels, tree, objects.node_numbering(all_labels, total_weight, tree), view_weights
    )
    assert (got.labels >= 0).any() and len(got.views) > 1
    for name in ("labels", "node", "node_views"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
    for name, part in vars(expected.tree).items():
        np.testing.assert_array_equal(getattr(got.tree, name), part)


def test_shares_of_regions_in_nodes_are_plain_sums(W: RegionWeights) -> None:
    labels, regions = np.random.default_rng(5).integers(-1, 4, SPLATS).astype(np.int32), np.array([1, 4, 5])
    table = sum_pieces(over_files(list(objects.node_shares(W, labels, 4, regions, 2))), (1, 5 * regions.size))
    dense = np.zeros((SPLATS, int(W.offsets[-1])))
    rows = np.repeat(np.arange(SPLATS), np.diff(W.indptr.numpy()))
    np.add.at(dense, (rows, W.region.numpy()), W.weight.double().numpy())
    expected = np.stack([dense[labels == label][:, regions].sum(axis=0) for label in range(-1, 4)])
    np.testing.assert_allclose(table.reshape(5, -1), expected, rtol=1e-12)
    assert expected.any(axis=1).all()


def test_hubers_loss_in_blocks_is_that_of_the_whole_scene(
    W: RegionWeights, means: torch.Tensor, codebook: Codebook, blocks: list[tuple[int, int]]
) -> None:
    expected = huber_factors(W, codebook, means=means, threads=2)
    parts = [(W.of_splats(first, last), means[first:last]) for first, last in blocks]
    sums = []
    for part, entries in parts:
        distances = RegionDistances(part, codebook, entries, 1)
        sums += distances.sums(distances.after(torch.ones_like(part.weight)))
    delta = mean_distance(sum_pieces(over_files(sums), (2, 1)))
    factors = [huber_factors(part, codebook, means=entries, threads=1, delta=delta) for part, entries in parts]
    assert torch.equal(torch.cat(factors), expected) and len(torch.unique(expected)) > 1000


def test_clusters_of_blocks_have_the_features_of_the_whole_scene(
    W: RegionWeights, codebook: Codebook, blocks: list[tuple[int, int]]
) -> None:
    rng = np.random.default_rng(5)
    features = torch.from_numpy(rng.normal(size=(SPLATS, 9)).astype(np.float16))
    labels, total_weight = rng.integers(-1, 4, SPLATS).astype(np.int32), rng.random(SPLATS).astype(np.float32)
    directions, own_consistency = RegionDirections.of_weights(W, codebook), torch.full((SPLATS,), 0.2)
    means_of_scene = cluster_means(
        sum_pieces(cluster_sums(features, total_weight, labels, 4, 2), (10, 4)), torch.float32
    )
    sums = [part for a, b in blocks for part in cluster_sums(features[a:b], total_weight[a:b], labels[a:b], 4, 1)]
    merged = cluster_means(sum_pieces(over_files(sums), (10, 4)), torch.float32)
    assert torch.equal(merged, means_of_scene)
    weights = features.double().numpy() * total_weight[:, None]
    expected = [weights[labels == k].sum(axis=0) / total_weight[labels == k].sum(dtype=np.float64) for k in range(4)]
    np.testing.assert_allclose(merged.numpy(), expected, rtol=1e-5, atol=1e-7)
    assigned = with_feature(torch.from_numpy(labels), merged)
    rejected = guard(assigned, torch.from_numpy(labels), merged, W, directions, own_consistency, 2)
    assert 0 < int(rejected.sum()) < int((labels >= 0).sum())
    for a, b in blocks:
        part = with_feature(torch.from_numpy(labels[a:b]), merged)
        block_rejected = guard(
            part, torch.from_numpy(labels[a:b]), merged, W.of_splats(a, b), directions, own_consistency[a:b], 1
        )
        assert torch.equal(block_rejected, rejected[a:b])
