"""The tree of regions on a scene of rooms, objects and parts, with mistakes of segmenters in their masks."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.lifting.pieces import stacked
from liftcore.solve.codebook import Codebook, ViewCodebook
from liftcore.solve.objects import NodeVectors, RegionObjects, object_facts
from liftcore.values.region_weights import RegionWeights
from tests.unit.solve.one_piece import region_objects
from tests.unit.solve.sparse_views import of_dense

SPLATS, VIEWS = 240, 12
PART = np.arange(SPLATS) // 20  # twelve parts of twenty splats
OBJECT = PART // 3  # four things of three parts
BACKGROUND = np.zeros(SPLATS, int)


def three_levels(
    seed: int, *, wrong: float = 0.3, backgrounds: bool = False
) -> tuple[RegionWeights, np.ndarray, Codebook]:
    """Return W, levels and codebooks of masks of parts, objects and, optionally, backgrounds, with noisy vectors.

    Args:
        wrong: share of the masks that are merged with a neighbour, or cut anywhere.
    """
    rng = np.random.default_rng(seed)
    vectors = np.random.default_rng(99).normal(size=(17, 32))
    parts, levels, books = [], [], []
    for _ in range(VIEWS):
        columns, rows = [], []
        masks: list[np.ndarray] = [BACKGROUND] if backgrounds else []
        masks += [OBJECT, PART]
        for level, right in enumerate(masks):
            labels, base = right.copy(), {0: 16, 3: 12, 11: 0}[int(right.max())]
            for label in np.unique(right):
                if rng.random() < wrong / 2 and label:
                    labels[labels == label] = label - 1
                elif rng.random() < wrong / 2:
                    cut = (labels == label) & (np.arange(SPLATS) > rng.choice(np.flatnonzero(right == label)))
                    labels[cut] = labels.max() + 1
            for label in range(labels.max() + 1):
                inside = labels == label
                columns.append(inside * rng.uniform(0.5, 1.5, SPLATS))
                expected = base + (np.bincount(right[inside]).argmax() if inside.any() else 0)
                rows.append(vectors[expected] + 0.3 * rng.normal(size=32))
                levels.append(level)
        parts.append(of_dense(np.stack(columns, axis=1) * (rng.random(SPLATS) < 0.9)[:, None]))
        books.append(ViewCodebook(torch.tensor(np.array(rows), dtype=torch.float32)))
    return stacked(parts, SPLATS), np.array(levels, np.int8), Codebook(books)


def members(objects: RegionObjects) -> list[np.ndarray]:
    """[P] bool of each node."""
    above = objects.tree.lineage().toarray().astype(bool)
    return [np.append(above[:, node], False)[objects.node] for node in range(len(above))]


def mean_iou(nodes: list[np.ndarray], owners: np.ndarray) -> float:
    """Of the best node of each owner."""
    table = np.stack(nodes)
    ious = []
    for owner in range(int(owners.max()) + 1):
        truth = owners == owner
        ious.append(float(((table & truth).sum(axis=1) / (table | truth).sum(axis=1)).max()))
    return float(np.mean(ious))


@pytest.mark.parametrize("seed", range(2))
def test_objects_and_their_parts_are_nodes_with_a_third_of_the_masks_wrong(seed: int) -> None:
    W, levels, _ = three_levels(seed)
    objects = region_objects(W, levels, np.ones(SPLATS))
    nodes, parents = members(objects), objects.tree.parents
    assert objects.count == 4 and (parents[:4] < 0).all()
    assert mean_iou(nodes, OBJECT) > 0.95
    assert mean_iou(nodes, PART) > 0.85
    assert len(nodes) < 2 * 16  # of some seventy wrong masks hardly any is repeated by a quarter of the views
    for node in np.flatnonzero(parents >= 0):
        assert nodes[node].sum() and not (nodes[node] & ~nodes[parents[node]]).any()


def test_masks_of_a_part_and_of_what_lies_behind_it_hold_it_together() -> None:
    half = np.arange(SPLATS) < 10  # of the first part, at which three of eight views cut it
    cut, merged = np.where(half, 12, PART), np.where(PART == 0, 3, PART)  # part 3 is of another thing
    parts, levels = [], []
    for masks in (PART, PART, cut, cut, cut, merged, merged, merged):
        for level, labels in enumerate((OBJECT, masks)):
            levels += [level] * len(np.unique(labels))
        parts.append(of_dense(np.concatenate([np.equal.outer(a, np.unique(a)) for a in (OBJECT, masks)], 1) * 1.0))
    objects = region_objects(stacked(parts, SPLATS), np.array(levels, np.int8), np.ones(SPLATS))
    assert any(np.array_equal(node, PART == 0) for node in members(objects))


def test_what_holds_the_whole_scene_is_a_group_and_its_parts_are_the_objects() -> None:
    W, levels, codebook = three_levels(1, wrong=0.0, backgrounds=True)
    objects = region_objects(W, levels, np.arange(SPLATS) + 1.0)
    assert objects.count == 4 and set(objects.tree.parents[:4]) == {4} and objects.tree.parents[4] < 0
    np.testing.assert_array_equal(objects.labels, 3 - OBJECT)  # the largest total weight first
    totals = np.bincount(W.region.numpy(), W.weight.numpy(), levels.size)
    facts = object_facts(objects, NodeVectors.of(codebook, totals, objects))
    assert (
        facts["largest_share"] == 1.0 and "100%" in facts["warning"] and "objects are its parts" in facts["warning"]
    )


def test_levels_that_differ_give_a_warning_and_stay_separate() -> None:
    W, levels, codebook = three_levels(2, wrong=0.0)
    totals = np.bincount(W.region.numpy(), W.weight.numpy(), levels.size)
    objects = region_objects(W, levels, np.ones(SPLATS))
    other = NodeVectors.of(codebook, totals, objects)
    assert other.level_agreement is not None and abs(other.level_agreement) < 0.5
    assert "different vectors" in object_facts(objects, other)["warning"]
    truth = np.random.default_rng(99).normal(size=(17, 32))
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    for node, inside in enumerate(members(objects)):
        expected = 12 + OBJECT[inside][0] if objects.tree.parents[node] < 0 else PART[inside][0]
        assert int((truth @ other.vectors[node]).argmax()) == expected
