"""Planted clusters are found, on any number of threads, and what has none says so."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.solve.clusters import NO_CLUSTER, cluster_splats, draw, principal_axes
from liftcore.values.settings import LiftSettings

SETTINGS = LiftSettings.of(aggregation=True, aggregation_cluster_size=20)


def planted(count: int) -> tuple[torch.Tensor, np.ndarray]:
    """Features [P, 24] f16 around four directions in a narrow cone, and the group of each row."""
    rng = np.random.default_rng(0)
    group = rng.integers(0, 4, count)
    vectors = (3 * np.ones(24) + rng.normal(0, 1, (4, 24))) / np.sqrt(24)
    rows = vectors[group] + rng.normal(0, 0.1, (count, 24)) / np.sqrt(24)
    return torch.tensor(rows * rng.uniform(0.2, 1.0, (count, 1)), dtype=torch.float16), group


def same_partition(labels: np.ndarray, group: np.ndarray) -> bool:
    pairs = {(int(a), int(b)) for a, b in zip(labels, group, strict=True)}
    return len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


def test_planted_clusters_are_found_whatever_the_lengths_of_the_features():
    features, group = planted(600)
    clustering = cluster_splats(features, np.ones(600), SETTINGS)
    labels = clustering.labels.numpy()
    assert clustering.count == 4
    assert (labels == NO_CLUSTER).mean() < 0.05
    assert same_partition(labels[labels >= 0], group[labels >= 0])


@pytest.mark.parametrize(("smallest", "are_found"), [(20, True), (21, False)])
def test_a_group_of_fewer_splats_than_the_setting_is_no_cluster(smallest: int, are_found: bool) -> None:
    group = np.repeat([0, 1, 2], [20, 20, 30])
    rows = np.eye(3, 24)[group] + np.random.default_rng(0).normal(0, 0.01, (70, 24))
    settings = SETTINGS.model_copy(update={"aggregation_cluster_size": smallest})
    clustering = cluster_splats(torch.from_numpy(rows).float(), np.ones(70), settings)
    assert (clustering.count == 3) == are_found


def test_splats_outside_the_sample_join_their_cluster(monkeypatch):
    monkeypatch.setattr("liftcore.solve.clusters.SAMPLE", 400)
    features, group = planted(5_000)
    few = SETTINGS.model_copy(update={"aggregation_cluster_size": 250})
    clustering = cluster_splats(features, np.ones(5_000), few)
    labels = clustering.labels.numpy()
    assert (clustering.facts["sample"], clustering.facts["smallest_in_sample"]) == (400, 20)
    assert (labels >= 0).mean() > 0.9
    assert same_partition(labels[labels >= 0], group[labels >= 0])


def test_a_feature_far_from_every_cluster_stays_unclustered():
    features, _ = planted(600)
    features[7] = -features[7]
    features[8] = 0
    labels = cluster_splats(features, np.ones(600), SETTINGS).labels
    assert labels[7] == labels[8] == NO_CLUSTER


@pytest.mark.parametrize(
    "features",
    [
        torch.ones(1, 4),
        torch.zeros(100, 4),
        torch.full((300, 4), 6e4).half(),
        torch.full((300, 4), 1e-38),
        torch.tensor([[1.0, 0.0], [0.0, 1.0]]),
    ],
)
def test_features_without_clusters_give_none(features):
    clustering = cluster_splats(features, np.ones(len(features)), SETTINGS)
    assert clustering.count == 0
    assert bool((clustering.labels == NO_CLUSTER).all())


@pytest.mark.parametrize("scale", [1e-38, 1e30])
def test_equal_features_in_two_groups_are_two_clusters_at_any_scale(scale):
    features = torch.cat([torch.ones(150, 1), -torch.ones(150, 1)]) * scale
    clustering = cluster_splats(features, np.ones(300), SETTINGS)
    assert clustering.count == 2
    assert clustering.labels[:150].unique().numel() == clustering.labels[150:].unique().numel() == 1
    assert clustering.labels[0] != clustering.labels[150]


def test_splats_without_weight_are_never_drawn_and_faint_ones_less_often():
    odds = np.concatenate([np.zeros(1_000), np.full(1_000, 0.1), np.ones(1_000)])
    rows = draw(odds, 500, seed=0)
    assert rows.size == np.unique(rows).size == 500 and rows.min() >= 1_000
    assert (rows >= 2_000).mean() > 0.8
    assert np.array_equal(rows, draw(odds, 500, seed=0))
    assert not np.array_equal(rows, draw(odds, 500, seed=1))
    assert draw(odds, 5_000, seed=0).tolist() == list(range(1_000, 3_000))


def test_principal_axes_are_those_of_the_largest_variance():
    rng = np.random.default_rng(0)
    F = 60
    rows = (rng.normal(size=(300, 5)) * [9, 7, 5, 4, 3]) @ rng.normal(size=(5, F)) + 0.1 * rng.normal(size=(300, F))
    rows = (rows - rows.mean(axis=0)).astype(np.float32)
    exact = np.linalg.svd(rows.astype(np.float64), full_matrices=False)[2][:5].T
    axes = principal_axes(rows, 5)
    assert np.abs(np.abs((exact * axes).sum(axis=0)) - 1).max() < 1e-4
    assert np.abs(axes.T @ axes - np.eye(5)).max() < 1e-5
