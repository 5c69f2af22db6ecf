"""The inputs of the tree of regions from a W on a GPU's device against those of the processor."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.solve import objects_on_card
from liftcore.solve.directions import region_totals
from liftcore.solve.membership import RegionGroups, memberships
from liftcore.solve.membership_on_card import memberships_on_card
from liftcore.solve.objects import MOST_SPLATS, TreeInputs, choose_nodes
from liftcore.solve.objects_on_card import TreeInputsOnCard
from liftcore.solve.region_tree import SPLIT, UNSEEN, region_tree
from liftcore.solve.sums import sum_pieces
from liftcore.solve.sums_on_card import region_totals_on_card
from liftcore.values.region_weights import RegionWeights, stacked
from tests.unit.solve.sparse_views import of_dense

VIEWS = 8


def nested_scene(seed: int, splats: int, equal_weights: bool) -> tuple[RegionWeights, np.ndarray]:
    """W of views with masks of the scene, its 3 things, 9 parts and 27 parts of parts, some wrong, in any order, and
    cells of grids.
    """
    rng, smallest = np.random.default_rng(seed), np.arange(splats) * 27 // splats
    views, levels = [], []
    for _ in range(VIEWS):
        columns, level_of = [rng.random((splats, 2)) < 0.5], [-1, -1]
        for level in range(4):
            labels = smallest // 3 ** (3 - level)
            number = labels.max() + 1
            labels = np.where(rng.random(splats) < 0.1, rng.integers(0, number, splats), labels)
            if rng.random() < 0.3:
                labels[labels == rng.integers(number)] = 0
            masks = labels[:, None] == np.arange(number)
            masks |= rng.random(masks.shape) < 0.02  # splats on borders
            is_visible = (rng.random(splats) < 0.8) & (smallest // 3 != rng.integers(9))  # one part is hidden
            columns.append(masks & is_visible[:, None])
            level_of += [level] * number
        order = rng.permutation(len(level_of))
        weight = 1.0 if equal_weights else rng.uniform(0.01, 2.0, (splats, len(level_of)))
        views.append(of_dense(weight * np.concatenate(columns, axis=1)[:, order]))
        levels += np.array(level_of)[order].tolist()
    return stacked(views, splats), np.array(levels, np.int8)


def both_inputs(W: RegionWeights, levels: np.ndarray) -> tuple[TreeInputs, TreeInputsOnCard]:
    groups = RegionGroups.of(W.offsets.numpy(), levels)
    return (
        TreeInputs(W, groups, memberships(W, groups), None),
        TreeInputsOnCard(W, groups, memberships_on_card(W, groups)),
    )


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("equal_weights", [False, True], ids=["weights", "ones"])
@pytest.mark.parametrize(("splats", "few_rows"), [(270, False), (270, True), (9000, False), (9000, True)])
def test_inputs_of_the_tree_are_the_processors(
    seed: int, equal_weights: bool, splats: int, few_rows: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if few_rows:
        sizes = {"BLOCK_ROWS": splats // 20, "BLOCK_ENTRIES": 20 * splats, "TABLE_ENTRIES": 2000}
        for name, value in sizes.items():
            monkeypatch.setattr(objects_on_card, name, value)
    W, levels = nested_scene(seed, splats, equal_weights)
    expected, got = both_inputs(W, levels)
    sizes = expected.region_sizes()
    np.testing.assert_array_equal(got.region_sizes(), sizes)
    assert (sizes.max() > MOST_SPLATS) == (splats == 9000)
    nodes, _ = choose_nodes(expected.groups, sizes)
    nodes = nodes[nodes >= int(W.offsets[2])]  # the first two views get none
    other_masks = np.flatnonzero(levels[: int(W.offsets[2])] >= 0)
    containers = expected.containers(nodes)
    assert {SPLIT, UNSEEN} < set(containers.ravel().tolist())
    np.testing.assert_array_equal(got.containers(nodes), containers)
    tree = region_tree(nodes, expected.groups, containers)
    number, labels = tree.parents.size, expected.labels(tree)
    assert (tree.parents[tree.parents[tree.parents >= 0]] >= 0).any(), "the tree has parts of parts"
    np.testing.assert_array_equal(got.labels(tree), labels)
    labels[::7] = -1
    shape = 1, (number + 1) * other_masks.size
    shares = [sum_pieces(inputs.node_shares(labels, number, other_masks), shape) for inputs in (got, expected)]
    np.testing.assert_allclose(*shares, rtol=1e-12)
    weights = [inputs.view_weights(labels, number) for inputs in (got, expected)]
    np.testing.assert_allclose(*weights, rtol=1e-12)
    totals = sum_pieces(region_totals(W), (1, levels.size))[0]
    np.testing.assert_allclose(region_totals_on_card(W).numpy(), totals, rtol=1e-12)


def test_heavy_and_light_splats_overflow_no_sum() -> None:
    W, levels = nested_scene(3, 9000, False)
    W.weight[W.indptr[4000] : W.indptr[4500]] *= 1e16
    W.weight[W.indptr[5000] : W.indptr[5500]] *= 1e8
    expected, got = both_inputs(W, levels)
    nodes, _ = choose_nodes(expected.groups, expected.region_sizes())
    np.testing.assert_array_equal(got.containers(nodes), expected.containers(nodes))


def test_a_scene_without_entries_has_no_nodes() -> None:
    _, got = both_inputs(stacked([of_dense(np.zeros((5, 3)))] * 2, 5), np.zeros(6, np.int8))
    nodes = np.zeros(0, np.int64)
    assert not got.region_sizes().any() and got.containers(nodes).shape[0] == 0
    tree = region_tree(nodes, got.groups, got.containers(nodes))
    labels = got.labels(tree)
    assert labels.tolist() == [-1] * 5 and got.view_weights(labels, 0).shape == (0, 2)
    assert torch.equal(region_totals_on_card(got.W), torch.zeros(6, dtype=torch.float64))
