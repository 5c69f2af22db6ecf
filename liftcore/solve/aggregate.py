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


@dataclass
class KeptRegionSums:
    """Sums over the kept regions of all views, by cluster."""

    sums: np.ndarray  # [K, F] f64, of their codebook rows
    counts: np.ndarray  # [K] i64, numbers of kept regions
    regions: int = 0  # of all views, kept or not

    def add(self, codebook: Tensor, clusters: np.ndarray, mask: np.ndarray) -> None:
        """Add the kept rows [M] bool of a codebook [M, F] to their clusters [M]."""
        rows = np.flatnonzero(mask)
        np.add.at(self.sums, clusters[rows], codebook[torch.from_numpy(rows)].to(torch.float64).numpy())
        np.add.at(self.counts, clusters[rows], 1)


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
        threads: None uses the cores that this process may use. The result is bitwise identical for any number.
    """
    progress("aggregate", 0, len(views), "views")
    clustering = cluster_splats(features, total_weight, settings, threads)
    facts: dict[str, Any] = {}
    if clustering.count == 0:
        merged = torch.zeros(0, features.shape[1], dtype=features.dtype)
    elif any(views.features.is_regions(name) for name in views.names):
        region_sums = filter_regions(clustering, features.shape[1], raster, views, settings, progress)
        merged, kept_count = kept_means(region_sums, features.dtype), int(region_sums.counts.sum())
        facts = {"filter": "iou", "regions": region_sums.regions, "kept_regions": kept_count}
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
) -> KeptRegionSums:
    """Render the clusters to every lifted view and keep the regions that match one by ``aggregation_iou``."""
    region_sums = KeptRegionSums(np.zeros((clustering.count, channels)), np.zeros(clustering.count, np.int64))
    params = settings.compositing
    for number, name in enumerate(views.names):
        camera, features = views[number]
        observation = at_levels(features, settings.levels, name)
        if isinstance(observation, Regions):
            kappa = raster.strongest_labels(camera, clustering.labels, params).numpy()
            kappa = np.where(raster.row_sums(camera, params).numpy() < LEAST_LIGHT, NO_CLUSTER, kappa)
            rows = observation.codebook.shape[0]
            matches = match_regions(observation.labels.numpy(), kappa, rows, clustering.count)
            kept_rows = (matches.clusters >= 0) & (matches.ious >= settings.aggregation_iou)
            region_sums.add(observation.codebook, matches.clusters, kept_rows)
            region_sums.regions += int(matches.present.sum())
        progress("aggregate", number + 1, len(views), "views")
    return region_sums


def kept_means(region_sums: KeptRegionSums, dtype: torch.dtype) -> Tensor:
    """Return the mean of each cluster's kept rows, [K, F]; zero if there is none."""
    means = region_sums.sums / np.maximum(region_sums.counts, 1)[:, None]
    return torch.from_numpy(means).to(dtype)


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


@dataclass(frozen=True)
class RegionMatches:
    """The majority cluster of each region of a view, and their IoU."""

    clusters: np.ndarray  # [M] i64, -1 for no cluster, or if no pixel reads the region
    ious: np.ndarray  # [M] f64, 0 without a cluster
    present: np.ndarray  # [M] bool, True if any pixel reads the region


def match_regions(labels: np.ndarray, kappa: np.ndarray, rows: int, clusters: int) -> RegionMatches:
    """Match the regions of a view with clusters.

    Args:
        labels: [L, h, w] i32 in -1..rows - 1, of any size; a region is the union of its pixels on all levels.
        kappa: [H, W] i32 in -1..clusters - 1.
    """
    table = contingency(labels, kappa, rows, clusters)
    areas = np.asarray(table.sum(axis=1)).ravel()
    majority, shared = _largest(table)
    footprints = np.bincount(kappa.ravel() + 1, minlength=clusters + 1)
    unions = areas + footprints[majority] - shared
    matched = (areas > 0) & (majority > 0)
    ious = np.divide(shared, unions, out=np.zeros(rows), where=matched)
    return RegionMatches(np.where(matched, majority - 1, NO_CLUSTER), ious, areas > 0)


def contingency(labels: np.ndarray, kappa: np.ndarray, rows: int, clusters: int) -> csr_matrix:
    """Count the pixels that read a region and show a cluster, [M, K + 1] i64; the first column is no cluster."""
    height, width = kappa.shape
    levels, label_rows, label_columns = labels.shape
    y = cells_under(np.arange(height), height, label_rows)
    x = cells_under(np.arange(width), width, label_columns)
    shown_cluster = (kappa + 1).ravel()
    total = csr_matrix((rows, clusters + 1), dtype=np.int64)
    earlier_levels: list[np.ndarray] = []
    for level in range(levels):
        regions = labels[level][y[:, None], x].ravel()
        is_counted = regions >= 0
        for other in earlier_levels:
            is_counted &= regions != other  # a pixel counts once for a region on two levels
        earlier_levels.append(regions)
        ones = np.ones(int(is_counted.sum()), np.int64)
        # Equal places add up.
        total += csr_matrix((ones, (regions[is_counted], shown_cluster[is_counted])), shape=total.shape)
    return total


def _largest(table: csr_matrix) -> tuple[np.ndarray, np.ndarray]:
    """Return column and value of the largest entry of each row, the first of ties; (0, 0) for an empty row."""
    table.sort_indices()
    indices, starts, data = (np.asarray(part, np.int64) for part in (table.indices, table.indptr, table.data))
    columns, values = np.zeros(starts.size - 1, np.int64), np.zeros(starts.size - 1, np.int64)
    lengths = np.diff(starts)
    nonempty = np.flatnonzero(lengths)
    if nonempty.size:
        largest = np.maximum.reduceat(data, starts[nonempty])
        row_of_entry = np.repeat(np.arange(nonempty.size), lengths[nonempty])
        places = np.flatnonzero(data == largest[row_of_entry])
        first = places[np.unique(row_of_entry[places], return_index=True)[1]]
        columns[nonempty], values[nonempty] = indices[first], largest
    return columns, values
