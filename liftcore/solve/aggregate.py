"""Post-Lifting Aggregation (paper, Post Aggregation Filtering): one feature per cluster.

1. Cluster the splats by their lifted features (`liftcore.solve.clusters`).
2. Render the clusters to every lifted view: ``kappa = argmax(A onehot(cluster))``. Unclustered splats are a class,
   which also has all rays whose row sum is below one half.
3. Keep the regions whose IoU with their majority cluster's footprint reaches tau (`filter_regions`).
4. A cluster's feature is the mean of its kept regions' codebook rows; its splats take this feature.

Grids have no regions to filter: a cluster's feature is then the mean of its splats' features, weighted by total
weight. Splats without a cluster, and those of clusters without a kept region, keep their own features.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from liftcore.raster.base import Raster
from liftcore.runtime.progress import Progress
from liftcore.solve.clusters import BLOCK, NO_CLUSTER, Clustering, cluster_splats
from liftcore.values.levels import at_levels
from liftcore.values.lift_views import LiftViews
from liftcore.values.settings import LiftSettings
from liftcore.values.views import Regions, cells_under

LEAST_LIGHT = 0.5  # row sum from which a ray shows a cluster, as for masks of answers


@dataclass(frozen=True)
class Aggregation:
    """Clusters and their features."""

    clusters: Tensor  # [P] i32, -1 = no cluster
    cluster_features: Tensor  # [K, F] like the features; zero rows of clusters without a feature
    facts: dict[str, Any]  # for the diagnostics


def aggregate(
    features: Tensor,
    total_weight: np.ndarray,
    raster: Raster,
    views: LiftViews,
    settings: LiftSettings,
    progress: Progress,
    threads: int | None = None,
) -> tuple[Tensor, Aggregation]:
    """Cluster the splats and assign the features of clusters, in place.

    Args:
        features: [P, F] f16 or f32; rows of splats that take their cluster's feature are overwritten with it, and the
            same tensor is returned.
        total_weight: [P] f64, sums of unscaled weights.
        views: the lifted views.
    """
    progress("aggregate", 0, len(views), "views")
    clustering = cluster_splats(features, total_weight, settings, threads)
    facts: dict[str, Any] = {}
    if clustering.count == 0:
        merged = torch.zeros(0, features.shape[1], dtype=features.dtype)
    elif any(views.features.is_regions(name) for name in views.names):
        means, regions, kept_count = filter_regions(clustering, features.shape[1], raster, views, settings, progress)
        merged, facts = means.to(features.dtype), {"filter": "iou", "regions": regions, "kept_regions": kept_count}
    else:
        merged = weighted_means(features, total_weight, clustering)
        facts = {"filter": "none: grids have no regions"}
    has_feature = torch.cat([(merged != 0).any(dim=1), torch.zeros(1, dtype=torch.bool)])  # the last is for -1
    assigned = has_feature[clustering.labels.long()]
    for first in range(0, features.shape[0], BLOCK):
        rows = first + torch.nonzero(assigned[first : first + BLOCK])[:, 0]
        features[rows] = merged[clustering.labels[rows].long()]
    progress("aggregate", len(views), len(views), "views")
    facts |= {
        "clusters": clustering.count,
        "clusters_with_feature": int(has_feature.sum()),
        "unclustered_share": float((clustering.labels == NO_CLUSTER).float().mean()),
        "changed": float(assigned.float().mean()),
        **clustering.facts,
    }
    return features, Aggregation(clustering.labels, merged, facts)


def filter_regions(
    clustering: Clustering,
    channels: int,
    raster: Raster,
    views: LiftViews,
    settings: LiftSettings,
    progress: Progress,
) -> tuple[Tensor, int, int]:
    """Render the clusters to every lifted view and keep the regions that match one by ``aggregation_iou``.

    Returns:
        The mean of each cluster's kept rows of codebooks [K, F] f64, zero if there is none; the number of regions of
        all views, and of those that are kept.
    """
    sums, counts, regions = np.zeros((clustering.count, channels)), np.zeros(clustering.count, np.int64), 0
    params = settings.compositing
    for number, name in enumerate(views.names):
        camera, features = views[number]
        observation = at_levels(features, settings.levels, name)
        if isinstance(observation, Regions):
            kappa = raster.strongest_labels(camera, clustering.labels, params).numpy()
            kappa = np.where(raster.row_sums(camera, params).numpy() < LEAST_LIGHT, NO_CLUSTER, kappa)
            codebook = observation.codebook.double().numpy()
            areas, clusters, ious = match_regions(observation.labels.numpy(), kappa, len(codebook), clustering.count)
            rows = np.flatnonzero((clusters != NO_CLUSTER) & (ious >= settings.aggregation_iou))
            np.add.at(sums, clusters[rows], codebook[rows])
            np.add.at(counts, clusters[rows], 1)
            regions += int((areas > 0).sum())
        progress("aggregate", number + 1, len(views), "views")
    return torch.from_numpy(sums / np.maximum(counts, 1)[:, None]), regions, int(counts.sum())


def weighted_means(features: Tensor, total_weight: np.ndarray, clustering: Clustering) -> Tensor:
    """Return the mean of the features of each cluster's splats, [K, F], weighted by their total weight."""
    labels, count = clustering.labels.numpy(), clustering.count
    sums, weight_sums = np.zeros((count, features.shape[1])), np.zeros(count)
    for begin in range(0, labels.size, BLOCK):
        rows = begin + np.flatnonzero(labels[begin : begin + BLOCK] >= 0)
        clusters, weights = labels[rows], total_weight[rows].astype(np.float64)
        shares = csr_matrix((weights, (clusters, np.arange(rows.size))), shape=(count, rows.size))
        sums += shares @ features[torch.from_numpy(rows)].double().numpy()
        weight_sums += np.bincount(clusters, weights, minlength=count)
    means = np.divide(sums, weight_sums[:, None], out=np.zeros_like(sums), where=weight_sums[:, None] > 0)
    return torch.from_numpy(means).to(features.dtype)


def match_regions(
    labels: np.ndarray, kappa: np.ndarray, rows: int, clusters: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Match the regions of a view with clusters.

    Args:
        labels: [L, h, w] i32 in -1..rows - 1, of any size; a region is the union of its pixels on all levels.
        kappa: [H, W] i32 in -1..clusters - 1.

    Returns:
        Of each region [M] the pixels i64, the majority cluster i64, -1 for none, and their IoU f64, 0 for none.
    """
    y, x = (cells_under(np.arange(side), side, n) for side, n in zip(kappa.shape, labels.shape[1:], strict=True))
    regions = labels[:, y[:, None], x].reshape(len(labels), -1)
    level, pixel = np.nonzero(regions >= 0)
    reads = csr_matrix((np.ones(level.size, np.int64), (regions[level, pixel], pixel)), shape=(rows, kappa.size))
    reads.data[:] = 1  # a pixel counts once for a region on two levels
    shown_cluster = np.ones(kappa.size, np.int64), kappa.ravel() + 1, np.arange(kappa.size + 1)
    table = reads @ csr_matrix(shown_cluster, shape=(kappa.size, clusters + 1))  # the first column is no cluster
    areas, majority = (np.asarray(part).ravel() for part in (table.sum(axis=1), table.argmax(axis=1)))
    shared = np.asarray(table[np.arange(rows), majority]).ravel()
    unions = areas + np.bincount(kappa.ravel() + 1, minlength=clusters + 1)[majority] - shared
    ious = np.divide(shared, unions, out=np.zeros(rows), where=(areas > 0) & (majority > 0))
    return areas, np.where(areas > 0, majority, 0) - 1, ious
