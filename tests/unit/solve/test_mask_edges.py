"""Edges weakened by masks: counts of views, their probabilities, and objects that colours do not distinguish."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from liftcore.scene.neighbours import SplatGraph
from liftcore.solve.mask_edges import MOST_VIEWS, same_object_probability, weaken_edges
from liftcore.solve.smooth import smooth
from liftcore.values.region_weights import stacked
from tests.scenes import random_splats
from tests.unit.scene.test_neighbours import dense
from tests.unit.solve.sparse_views import of_dense
from tests.unit.solve.test_consensus import SPLATS, belonging, random_scene


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_edges_weaken_as_often_as_views_separate_them(seed: int, threads: int) -> None:
    W, levels = random_scene(seed)
    graph = SplatGraph.of(random_splats(seed, SPLATS))
    _, _, groups, B = belonging(W, levels)
    joining, separating = np.zeros((2, SPLATS, SPLATS), int)
    for group in groups:
        in_group = B[:, group].astype(int)
        same_region, observed = in_group @ in_group.T, in_group.sum(axis=1)
        joining += same_region
        separating += np.outer(observed, observed) - same_region
    edges, before = np.zeros((MOST_VIEWS + 1, MOST_VIEWS + 1)), dense(graph)
    np.add.at(edges, (joining[before > 0], separating[before > 0]), 1)
    weakened, share = weaken_edges(graph, W, levels, threads)
    np.testing.assert_allclose(
        dense(weakened), before * same_object_probability(edges)[joining, separating], rtol=1e-5
    )
    assert 0 < share < 1


def test_masks_that_are_often_wrong_say_less() -> None:
    def probability(split: float, merged: float) -> np.ndarray:
        rng, edges = np.random.default_rng(0), np.zeros((MOST_VIEWS + 1, MOST_VIEWS + 1))
        for count, rate in ((95_000, split), (5_000, 1 - merged)):
            separating = rng.binomial(5, rate, count)
            np.add.at(edges, (5 - separating, separating), 1)
        return same_object_probability(edges)

    right, wrong = probability(0.01, 0.05), probability(0.2, 0.3)
    assert right[0, 0] == wrong[0, 0] == 1
    assert right[0, 5] < 1e-3 < wrong[0, 5]
    assert right[2, 3] < 0.5 < wrong[3, 2]
    assert right[4, 1] > 0.95


SIDE = 30  # splats of a square cloth
PLACES = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2)
OBJECTS = {
    "thin": PLACES[:, 0] == 15,
    "small": (np.abs(PLACES - 15) <= 1).all(axis=1),
    "large": (np.abs(PLACES - 15) <= 7).all(axis=1),
}


@pytest.mark.parametrize("kind", OBJECTS)
def test_object_of_the_colour_of_its_cloth_stays_separate(kind: str) -> None:
    labels, rng, count, views = OBJECTS[kind].astype(int), np.random.default_rng(1), SIDE**2, 6
    means = torch.from_numpy(np.column_stack([PLACES, np.zeros(count)])).float()
    splats = replace(random_splats(1, count), means=means, sh=torch.zeros(count, 1, 3))
    merged = rng.permutation(views) < 2  # views whose mask of the cloth contains the object
    W = stacked([of_dense(np.eye(2)[0 * labels if is_merged else labels]) for is_merged in merged], count)
    graph = SplatGraph.of(splats)
    weakened, _ = weaken_edges(graph, W, np.zeros(2 * views, np.int8))
    truth, ones = torch.from_numpy(np.eye(2)[labels]).float(), torch.ones(count)
    noisy = truth + 0.5 * torch.from_numpy(rng.normal(size=(count, 2))).float()

    def wrong(X: torch.Tensor) -> int:
        return int((X.argmax(dim=1).numpy() != labels)[OBJECTS[kind]].sum())

    from_weakened, from_graph = (
        smooth(noisy.clone(), edges, ones, None, ones > 0, 4.0)[0] for edges in (weakened, graph)
    )
    assert wrong(from_weakened) == 0
    assert wrong(from_graph) > 0
