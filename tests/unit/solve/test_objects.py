"""Objects without words: the chains against all pairs in float64, and promises on scenes of known objects."""

from __future__ import annotations

import numpy as np
import pytest

from liftcore.lifting.pieces import stacked
from liftcore.solve import objects
from liftcore.solve.objects import CONTAINS, OBSERVES
from liftcore.solve.region_tree import LEAST_VIEWS, MERGE_RATE
from liftcore.values.region_weights import RegionWeights
from tests.unit.solve.one_piece import region_objects
from tests.unit.solve.sparse_views import dense, of_dense
from tests.unit.solve.test_consensus import SPLATS, belonging, of_things, random_scene


def mistaken_scene(seed: int) -> tuple[RegionWeights, np.ndarray]:
    """Five things of two parts, masks of them and of their parts, with splats astray, unseen, and masks merged."""
    rng, parts, levels = np.random.default_rng(seed), [], []
    part = np.arange(SPLATS) // 6
    for _ in range(7):
        columns = []
        for level, right in enumerate((part // 2, part)):
            labels = np.where(rng.random(SPLATS) < 0.1, rng.integers(0, right.max() + 1, SPLATS), right)
            if rng.random() < 0.5:
                labels[labels == rng.integers(1, right.max() + 1)] = 0
            view = np.zeros((SPLATS, right.max() + 1))
            view[np.arange(SPLATS), labels] = rng.uniform(0.1, 3.0, SPLATS) * (rng.random(SPLATS) < 0.8)
            columns.append(view)
            levels += [level] * view.shape[1]
        parts.append(of_dense(np.concatenate(columns, axis=1)))
    return stacked(parts, SPLATS), np.array(levels, np.int8)


def defined(W: RegionWeights, levels: np.ndarray) -> np.ndarray:
    """The cluster of each region that any splat belongs to, by the module's words, line by line; -1 for none."""
    total, view, groups, B = belonging(W, levels)
    R = B.T @ (np.sqrt(total.sum(axis=1))[:, None] * B)
    size = levels.size
    supports, observes = np.zeros((size, size)), np.zeros((size, size))
    views = W.offsets.numel() - 1
    for v in range(views):
        sees, contained = np.zeros(size, bool), np.zeros((size, size), bool)
        for group_regions in (group for group in groups if view[group[0]] == v):
            group_weight = R[:, group_regions].sum(axis=1)
            observed = (group_weight > 0) & (group_weight >= OBSERVES * np.diag(R))
            best = group_regions[R[:, group_regions].argmax(axis=1)]
            contains = observed & (R[:, group_regions].max(axis=1) >= CONTAINS * group_weight)
            sees |= observed
            contained |= contains[:, None] & contains[None] & (best[:, None] == best[None])
        supports += contained
        observes += sees[:, None] & sees[None]
    clusters = [[int(m)] for m in np.flatnonzero(B.any(axis=0))]
    while len(clusters) > 1:
        rates = {}
        for i in range(len(clusters)):
            for j in range(i):
                pair = np.ix_(clusters[i], clusters[j])
                rates[i, j] = supports[pair].sum() / max(observes[pair].sum(), 1e-9)
        i, j = max(rates, key=lambda pair: rates[pair])
        if rates[i, j] < MERGE_RATE:
            break
        clusters[j] += clusters.pop(i)
    objects = np.full(size, -1)
    contains = [
        group_regions for group_regions in clusters if np.unique(view[group_regions]).size >= min(LEAST_VIEWS, views)
    ]
    for number, group_regions in enumerate(contains):
        objects[group_regions] = number
    return objects


@pytest.mark.parametrize("seed", range(3))
def test_objects_are_those_of_the_definition(seed: int) -> None:
    W, levels = mistaken_scene(seed)
    objects, expected = region_objects(W, levels, np.ones(SPLATS)), defined(W, levels)
    sums = np.zeros((SPLATS, expected.max() + 2))
    for m, group in enumerate(expected):
        sums[:, group + 1] += dense(W, SPLATS)[:, m]
    best, total = sums[:, 1:].argmax(axis=1), sums[:, 1:].sum(axis=1)
    assert expected.max() >= 2
    labels = np.where((total > 0) & (2 * sums[:, 1:].max(axis=1) >= total), best, -1)
    is_same = objects.labels[:, None] == objects.labels[None]
    np.testing.assert_array_equal(is_same, labels[:, None] == labels[None])
    np.testing.assert_array_equal(objects.labels < 0, labels < 0)


def test_merged_and_split_masks_do_not_change_the_objects() -> None:
    right = [0, 1, 2, 3]
    merged, split = [0, 0, 1, 2], [0, 1, 2, 2]
    W, levels = of_things([right, merged, right, split, right, right])
    objects = region_objects(W, levels, np.arange(SPLATS) + 1.0)
    np.testing.assert_array_equal(objects.labels, np.repeat([3, 2, 1, 0], SPLATS // 4))  # largest total weight first
    assert len(objects.views) == 4 and set(objects.views[0][objects.views[0] >= 0]) <= set(range(6))


@pytest.mark.parametrize("swapped", [False, True])
def test_a_splat_between_two_objects_has_the_one_of_its_first_region(swapped: bool) -> None:
    rows = np.zeros((SPLATS, 2))
    rows[:40, 0] = rows[20:, 1] = 1.0  # twenty splats have both
    W = stacked([of_dense(rows[:, ::-1] if swapped else rows), *[of_dense(rows)] * 3], SPLATS)
    labels = region_objects(W, np.zeros(8, np.int8), np.ones(SPLATS)).labels
    assert labels[0] != labels[-1] and min(labels) >= 0
    np.testing.assert_array_equal(labels[20:40], labels[-1 if swapped else 0])


def test_grids_have_no_objects() -> None:
    W, levels = random_scene(0)
    objects = region_objects(W, np.full_like(levels, -1), np.ones(SPLATS))
    assert (objects.labels == -1).all() and objects.views.shape[0] == 0


def test_views_beyond_the_bound_join_what_the_others_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objects, "MOST_REGIONS", 20)
    monkeypatch.setattr(objects, "FEWEST_VIEWS", 5)
    W, levels = of_things([[0, 1, 2, 3]] * 12)
    scene_objects = region_objects(W, levels, np.ones(SPLATS))
    regions = scene_objects.tree.region
    assert len(scene_objects.views) == 4 and (regions >= 0).all()
    np.testing.assert_array_equal(regions.reshape(12, 4), regions[:4][None].repeat(12, axis=0))
