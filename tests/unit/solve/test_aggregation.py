"""Aggregation from clusters to features, against loops over pixels, regions and splats."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from liftcore.raster.reference import ReferenceRaster, dense_view
from liftcore.runtime.progress import silent
from liftcore.scene.cameras import Cameras
from liftcore.solve.aggregate import filter_regions, weighted_means
from liftcore.solve.clusters import Clustering
from liftcore.values.lift_views import LiftViews
from liftcore.values.pack import read_features, write_pack
from liftcore.values.settings import LiftSettings
from tests.scenes import random_camera, random_grid, random_regions, random_splats

pytestmark = pytest.mark.slow

P, K = 40, 3


def clustering_of(labels: np.ndarray) -> Clustering:
    return Clustering(torch.tensor(labels, dtype=torch.int32), K, {})


@given(st.integers(0, 2**20), st.sampled_from([0.1, 0.3, 0.6]))
@settings(max_examples=25, deadline=None)
def test_kept_regions_are_those_of_the_paper_pixel_by_pixel(tmp_path_factory, seed, iou):
    lift_settings, splats = (
        LiftSettings.of(aggregation=True, aggregation_iou=iou, diagnostic_rays=10),
        random_splats(seed, P),
    )
    views = tuple(random_camera(seed + k, 21 + 4 * k, 17, name=f"v{k}") for k in range(2))
    maps = {"v0": random_regions(seed, 2, 5, (9, 14)), "v1": random_grid(seed)}
    path = tmp_path_factory.mktemp("pack") / "features.safetensors"
    write_pack(path, maps, {"encoder": "random"})
    labels = np.random.default_rng(seed).integers(-1, K, P)
    lifted = LiftViews.of(read_features(path), Cameras(views), lift_settings)
    means, regions, kept_count = filter_regions(
        clustering_of(labels), 6, ReferenceRaster(splats), lifted, lift_settings, silent
    )

    onehot = np.array([[float(label == k) for k in range(-1, K)] for label in labels])
    A = dense_view(splats, views[0], lift_settings.compositing).A
    # A ray that splats fill by less than half shows no cluster, whatever little it meets.
    kappa = np.where(A.sum(axis=1) < 0.5, -1, (A @ onehot).argmax(axis=1) - 1).reshape(17, 21)
    sums, counts, present = np.zeros((K, 6)), np.zeros(K, int), 0
    for row, vector in enumerate(maps["v0"].codebook.double().numpy()):
        y, x = ((np.arange(17) + 0.5) * 9 / 17).astype(int), ((np.arange(21) + 0.5) * 14 / 21).astype(int)
        mask = (maps["v0"].labels.numpy()[:, y][:, :, x] == row).any(axis=0)
        present += int(mask.any())
        shares = [(mask & (kappa == k)).sum() for k in range(-1, K)]
        majority = int(np.argmax(shares)) - 1
        if mask.any() and majority >= 0:
            footprint = kappa == majority
            if (mask & footprint).sum() / (mask | footprint).sum() >= iou:
                sums[majority] += vector
                counts[majority] += 1
    assert (regions, kept_count) == (present, counts.sum())
    assert np.abs(means.numpy() - sums / np.maximum(counts, 1)[:, None]).max() < 1e-6


def test_clusters_of_grids_take_the_mean_of_their_splats_weighted_by_total_weight():
    rng = np.random.default_rng(0)
    labels, total_weight = rng.integers(-1, K - 1, 500), rng.uniform(0, 3, 500)
    features = torch.tensor(rng.normal(size=(500, 4)), dtype=torch.float32)
    means = weighted_means(features, total_weight, clustering_of(labels)).numpy()
    for k in range(K - 1):
        weights = total_weight * (labels == k)
        assert np.abs(means[k] - weights @ features.double().numpy() / weights.sum()).max() < 1e-6
    assert not means[K - 1].any()
