"""Aggregation from clusters to features, against loops over pixels, regions and splats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from liftcore.errors import InvalidLift
from liftcore.io.splats import write_splats
from liftcore.lifting.files import lift_files
from liftcore.query.result import load_lift
from liftcore.raster.reference import ReferenceRaster, dense_view
from liftcore.runtime.progress import silent
from liftcore.scene.cameras import Cameras
from liftcore.solve.aggregate import filter_regions, weighted_means
from liftcore.solve.clusters import Clustering
from liftcore.values.lift_file import CLUSTER_TENSORS, save_lift
from liftcore.values.lift_views import LiftViews
from liftcore.values.pack import read_features, write_pack
from liftcore.values.settings import LiftSettings
from liftcore.values.views import FeatureGrid, Regions
from tests.inria_file import write_inria_cameras
from tests.scenes import centred, random_camera, random_grid, random_regions, random_splats

pytestmark = pytest.mark.slow

P, K = 40, 3


def clustering_of(labels: np.ndarray, count: int = K) -> Clustering:
    return Clustering(torch.tensor(labels, dtype=torch.int32), count, {})


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
    kept_masks = filter_regions(clustering_of(labels), 6, ReferenceRaster(splats), lifted, lift_settings, silent)

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
    assert kept_masks.regions == present
    assert kept_masks.counts.tolist() == counts.tolist()
    assert np.abs(kept_masks.sums - sums).max() < 1e-6


def test_clusters_of_grids_take_the_mean_of_their_splats_weighted_by_total_weight():
    rng = np.random.default_rng(0)
    labels, total_weight = rng.integers(-1, K - 1, 500), rng.uniform(0, 3, 500)
    features = torch.tensor(rng.normal(size=(500, 4)), dtype=torch.float32)
    means = weighted_means(features, total_weight, clustering_of(labels)).numpy()
    for k in range(K - 1):
        weights = total_weight * (labels == k)
        assert np.abs(means[k] - weights @ features.double().numpy() / weights.sum()).max() < 1e-6
    assert not means[K - 1].any()


def write_scene(folder, kind: str):
    """Two groups of splats left and right of the middle, seen by three cameras; splats, cameras, features."""
    splats = random_splats(5, 400, spread=0.3)
    side = torch.arange(400) % 2
    splats.means[:, 0] += torch.where(side == 0, -1.2, 1.2)
    pose = np.eye(4)
    pose[2, 3] = 4.0
    views = []
    for k in range(3):
        base = centred(random_camera(0, 40 + 8 * k, 30, name=f"v{k}"))
        views.append(base.replace(fx=40.0, fy=40.0, viewmat=pose))
    maps: dict[str, Regions | FeatureGrid] = {}
    for k, camera in enumerate(views):
        labels = torch.zeros(1, 15, 20, dtype=torch.int32)
        labels[:, :, 10:] = 1
        noise = np.random.default_rng(k).normal(0, 0.05, (2, 6))
        codebook = torch.tensor(np.eye(2, 6) + noise, dtype=torch.float32)
        maps[camera.name] = Regions(labels, codebook)
        if kind == "grids":
            maps[camera.name] = FeatureGrid(codebook[labels[0].long()])
    maps["nowhere"] = maps["v0"]
    paths = folder / "splats.ply", folder / "cameras.json", folder / "features.safetensors"
    write_splats(paths[0], splats)
    write_inria_cameras(Cameras(tuple(views)), paths[1])
    write_pack(paths[2], maps, {"encoder": "random"})
    return paths, side


KNOBS = {"preset": "tikhonov", "aggregation_cluster_size": 40, "diagnostic_rays": 10, "aggregation_iou": 0.2}


@pytest.mark.parametrize("kind", ["regions", "grids"])
def test_a_lift_with_aggregation_has_one_feature_a_cluster_and_says_so(tmp_path, kind):
    (splats, cameras, features), side = write_scene(tmp_path, kind)
    result = lift_files(splats, cameras, [features], LiftSettings.of(aggregation=True, **KNOBS))
    save_lift(result, tmp_path / "lift")
    stored = load_lift(tmp_path / "lift")
    assert stored.cluster is not None and stored.cluster_features is not None
    facts = stored.metadata.diagnostics["aggregation"]
    assert facts["clusters"] == stored.cluster_features.shape[0] >= 2
    assert ("kept_regions" in facts) == (kind == "regions")
    assert facts["filter"].startswith("iou" if kind == "regions" else "none")
    assigned = (stored.cluster >= 0) & (stored.cluster_features != 0).any(dim=1)[stored.cluster.long()]
    assert facts["changed"] == pytest.approx(float(assigned.float().mean())) and facts["changed"] > 0.3
    assert torch.equal(stored.features[assigned], stored.cluster_features[stored.cluster[assigned].long()])
    agree = stored.features[assigned].float()[:, :2].argmax(dim=1) == side[assigned]
    assert float(agree.float().mean()) > 0.95


def test_a_lift_without_clusters_is_the_lift_without_aggregation_and_says_so(tmp_path):
    (splats, cameras, features), _ = write_scene(tmp_path, "regions")
    baseline = lift_files(splats, cameras, [features], LiftSettings.of(diagnostic_rays=10))
    settings = LiftSettings.of(aggregation=True, diagnostic_rays=10)
    none = lift_files(splats, cameras, [features], settings)
    assert none.metadata.diagnostics["aggregation"]["clusters"] == 0
    assert none.metadata.diagnostics["aggregation"]["changed"] == 0
    assert torch.equal(baseline.features, none.features)
    assert none.cluster is not None and bool((none.cluster == -1).all())
    save_lift(none, tmp_path / "none")
    means = load_lift(tmp_path / "none").cluster_features
    assert means is not None and means.shape == (0, 6)
    save_lift(baseline, tmp_path / "plain")
    assert load_lift(tmp_path / "plain").cluster is None


def test_a_lift_whose_clusters_do_not_fit_is_refused(tmp_path):
    (splats, cameras, features), _ = write_scene(tmp_path, "regions")
    baseline = lift_files(splats, cameras, [features], LiftSettings.of(preset="row-sum", diagnostic_rays=10))
    parts = {"cluster": torch.zeros(400, dtype=torch.int32), "cluster_features": torch.zeros(3, 6).half()}
    assert set(parts) == set(CLUSTER_TENSORS)
    for overrides in (
        {"cluster": torch.full((400,), 3, dtype=torch.int32)},
        {"cluster": torch.full((400,), -2, dtype=torch.int32)},
        {"cluster": torch.zeros(399, dtype=torch.int32)},
        {"cluster": torch.zeros(400, dtype=torch.int64)},
        {"cluster_features": torch.zeros(3, 5, dtype=torch.float16)},
    ):
        save_lift(replace(baseline, **parts | overrides), tmp_path / "lift")
        with pytest.raises(InvalidLift):
            load_lift(tmp_path / "lift")


def test_one_splat_is_aggregated_without_harm(tmp_path):
    write_splats(tmp_path / "splats.ply", random_splats(0, 1))
    camera = centred(random_camera(0, name="v0"))
    write_inria_cameras(Cameras((camera,)), tmp_path / "cameras.json")
    write_pack(tmp_path / "f.safetensors", {"v0": random_regions(0, F=3)}, {"encoder": "random"})
    paths = tmp_path / "splats.ply", tmp_path / "cameras.json"
    settings = LiftSettings.of(aggregation=True, diagnostic_rays=10)
    result = lift_files(*paths, [tmp_path / "f.safetensors"], settings)
    assert result.cluster is not None and result.cluster.tolist() == [-1]
    assert bool(torch.isfinite(result.features).all())
