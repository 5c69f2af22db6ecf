"""The graph of neighbouring splats, compared with its formula pair by pair."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liftcore.scene.neighbours import COLOUR_WIDTH, LEAST_AFFINITY, NEIGHBOURS, SplatGraph
from liftcore.scene.splats import Splats
from tests.scenes import random_splats

SEEDS = st.integers(0, 2**16)


def dense(graph: SplatGraph) -> np.ndarray:
    """Return the affinities [P, P] f64 in the order of the splats."""
    count = len(graph.order)
    matrix = np.zeros((count, count))
    rows = np.repeat(np.arange(count), np.diff(graph.starts))
    matrix[graph.order[rows], graph.order[graph.neighbours]] = graph.affinities
    return matrix


def by_formula(splats: Splats) -> np.ndarray:
    """Return the affinities [P, P] f64 of splats at distinct positions."""
    means = splats.means.double().numpy()
    distances = np.linalg.norm(means[:, None] - means[None], axis=2)
    matrix = np.zeros_like(distances)
    for j, row in enumerate(distances):
        near = np.argsort(row)[1 : NEIGHBOURS + 1]
        matrix[j, near] = np.exp(-((row[near] / np.median(row[near])) ** 2) / 2)
    if splats.sh is not None:
        colours = (0.5 + splats.sh[:, 0].double().numpy() / np.sqrt(4 * np.pi)).clip(0, 1)
        colour_distances = ((colours[:, None] - colours[None]) ** 2).sum(axis=2)
        matrix *= np.exp(-colour_distances / COLOUR_WIDTH**2 / 2)
    matrix[matrix < LEAST_AFFINITY] = 0
    return (matrix + matrix.T) / 2


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS, count=st.integers(2, 80), coloured=st.booleans())
def test_affinities_are_those_of_the_formula(seed: int, count: int, coloured: bool) -> None:
    splats = random_splats(seed, count)
    assert splats.sh is not None
    splats = replace(splats, sh=0.2 * splats.sh if coloured else None)
    graph = SplatGraph.of(splats)
    assert graph.coloured == coloured
    assert sorted(graph.order) == list(range(count))
    np.testing.assert_allclose(dense(graph), by_formula(splats), rtol=1e-4, atol=2 * LEAST_AFFINITY)


@pytest.mark.parametrize("count", [5, 12, 60])
def test_splats_at_one_place_are_neighbours(count: int) -> None:
    splats = replace(random_splats(0, 60), sh=None)
    splats.means[:count] = splats.means[0]
    matrix = dense(SplatGraph.of(splats))
    assert np.array_equal(matrix, matrix.T)
    assert not matrix.diagonal().any()
    inside = matrix[:count, :count]
    assert (inside.sum(axis=1) >= min(count - 1, NEIGHBOURS) / 2).all()
    assert (inside[inside > 0] >= 0.5).all()
