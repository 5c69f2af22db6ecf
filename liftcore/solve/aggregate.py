"""Post-Lifting Aggregation (paper, Post Aggregation Filtering): one feature per cluster.

The method of the paper, with clusters of features (``aggregation_clusters=hdbscan``):

1. Cluster the splats by their lifted features (`liftcore.solve.clusters`).
2. Render the clusters to every lifted view: ``kappa = argmax(A onehot(cluster))``. Unclustered splats are a class,
   which also has all rays whose row sum is below one half.
3. Keep the regions whose IoU with their majority cluster's footprint reaches tau (`filter_regions`).
4. A cluster's feature is the mean of its kept regions' codebook rows; its splats take this feature.

With clusters of masks (``graph``), clusters are the objects of `liftcore.solve.objects`, which need no filter by
footprints. As for grids, which have no regions to filter, a cluster's feature is the mean of its splats' features,
weighted by total weight.

Splats without a cluster, and those of clusters without a kept region, keep their own features, or with
``aggregation_resolve`` are solved again from the kept regions alone, if these have most of their weight.

**The guard** (``aggregation_guard``) prevents an object from vanishing in a cluster of mostly another object: a splat
takes a cluster's feature only if this explains its views at least as well as its own feature. With e, c_jm, p_jv, c
and the weights W' of the reweighting (`liftcore.solve.reweight`)::

    sum_m W'_jm max(0, cos(e_m, e_cluster))  >=  sum_m W'_jm ((1 - p_jv) c_jm + p_jv c)

**Blocks of splats**, with clusters of masks: a cluster's feature is a sum over splats, by pieces (`cluster_sums`);
the assignment of a splat is a function of its row of W and its own feature (`guard`, `assign_features`). HDBSCAN's
sample and the footprints of clusters need all features in one process.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from liftcore.raster.base import Raster
from liftcore.runtime.jit import kernel
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress
from liftcore.scene.splats import Splats
from liftcore.solve.closed_form import solve_rows
from liftcore.solve.clusters import BLOCK, NO_CLUSTER, RESOLUTION, Clustering, cluster_splats, split_by_touch
from liftcore.solve.codebook import TABLE_BYTES, Codebook
from liftcore.solve.directions import RegionDirections
from liftcore.solve.objects import RegionObjects
from liftcore.solve.reweight import scale_weights
from liftcore.solve.sums import PieceSums, piece_sums, sum_pieces
from liftcore.values.levels import at_levels
from liftcore.values.lift_views import LiftViews
from liftcore.values.region_weights import RegionWeights, run_each
from liftcore.values.settings import LiftSettings
from liftcore.values.views import Regions, ViewFeatures, cells_under

MASKS_MADE = {"filter": "none: masks made the clusters"}
LEAST_KEPT = 0.5  # of a splat's weight, in kept regions, for it to be solved again
LEAST_LIGHT = 0.5  # row sum from which a ray shows a cluster, as for masks of answers


@dataclass(frozen=True)
class Aggregation:
    """Clusters and their features."""

    clusters: Tensor  # [P] i32, -1 = no cluster
    cluster_features: Tensor  # [K, F] like the features; zero rows of clusters without a feature
    facts: dict[str, Any]  # for the diagnostics
    unclustered_mask: Tensor  # [P] bool, splats with their own features
    kept_regions: tuple[np.ndarray | None, ...]  # [M_v] bool per view; None = no regions to filter


@dataclass
class KeptRegionSums:
    """Sums over the kept regions of all views, by cluster."""

    sums: np.ndarray  # [K, F] f64, of their codebook rows
    counts: np.ndarray  # [K] i64, numbers of kept regions
    regions: int = 0  # of all views, kept or not
    masks: dict[str, np.ndarray] = field(default_factory=dict)  # view -> [M] bool, kept codebook rows

    def add(self, codebook: Tensor, clusters: np.ndarray, mask: np.ndarray) -> None:
        """Add the kept rows [M] bool of a codebook [M, F] to their clusters [M]."""
        rows = np.flatnonzero(mask)
        np.add.at(self.sums, clusters[rows], codebook[torch.from_numpy(rows)].to(torch.float64).numpy())
        np.add.at(self.counts, clusters[rows], 1)


def aggregate(
    features: Tensor,
    total_weight: np.ndarray,
    splats: Splats,
    raster: Raster,
    views: LiftViews,
    settings: LiftSettings,
    progress: Progress,
    threads: int | None = None,
    *,
    objects: RegionObjects | None = None,
    guard_inputs: tuple[RegionWeights, RegionDirections, Tensor] | None = None,
) -> tuple[Tensor, Aggregation]:
    """Cluster the splats and assign the features of clusters, in place.

    Args:
        features: [P, F] f16 or f32; rows of splats that take their cluster's feature are overwritten with it, and the
            same tensor is returned.
        total_weight: [P] f64, sums of unscaled weights.
        views: the lifted views.
        threads: None uses the cores that this process may use. The result is bitwise identical for any number.
        objects: the clusters; None: clusters of features.
        guard_inputs: reweighted W on the CPU, directions of its regions, and the feature consistency [P] f32 of the
            splats (`Reweighting`); None: no guard.
    """
    names = views.names
    progress("aggregate", 0, len(names), "views")
    if objects is not None:
        clustering = Clustering(torch.from_numpy(objects.labels), objects.count, {"clustered_by": "graph"})
    else:
        clustering = cluster_splats(features, total_weight, settings, threads)
        if settings.aggregation_clusters != "hdbscan":
            clustering = split_by_touch(clustering, splats, settings.aggregation_cluster_size, threads)
    masks: dict[str, np.ndarray] = {}
    if clustering.count == 0:
        merged, facts = torch.zeros(0, features.shape[1], dtype=features.dtype), {}
    elif objects is not None:
        merged, facts = weighted_means(features, total_weight, clustering, threads), MASKS_MADE
    elif any(views.features.is_regions(name) for name in names):
        region_sums = filter_regions(clustering, features.shape[1], raster, views, settings, progress)
        merged, masks = kept_means(region_sums, features.dtype), region_sums.masks
        kept_count = int(region_sums.counts.sum())
        facts = {"filter": "iou", "regions": region_sums.regions, "kept_regions": kept_count}
    else:
        merged = weighted_means(features, total_weight, clustering, threads)
        facts = {"filter": "none: grids have no regions"}
    assigned, rejected = with_feature(clustering.labels, merged), None
    if guard_inputs is not None and clustering.count:
        rejected = guard(assigned, clustering.labels, merged, *guard_inputs, threads)
        assigned = assigned & ~rejected
    features = assign_features(features, clustering.labels, merged, assigned)
    progress("aggregate", len(names), len(names), "views")
    facts = facts | aggregation_facts(clustering, merged, assigned, rejected)
    kept_regions = tuple(masks.get(name) for name in names)
    return features, Aggregation(clustering.labels, merged, facts, ~assigned, kept_regions)


def solve_from_kept_regions(
    X: Tensor,
    aggregation: Aggregation,
    W: RegionWeights,
    codebook: Codebook,
    sums: np.ndarray,
    progress: Progress,
    *,
    means: Tensor,
    threads: int | None = None,
) -> tuple[Tensor, dict[str, Any]]:
    """Solve again from the kept regions alone for splats without a cluster's feature; return X and their share of
    all.

    Only for splats with most of their weight in kept regions: the others would take regions of their neighbours.

    Args:
        X: [P, F], changed in place. W: reweighted, on the CPU. sums: [P] f64, of rows of W before reweighting.
        means: [P, 3] of the splats.
    """
    if all(rows is None for rows in aggregation.kept_regions):
        return X, {"resolved": 0.0}
    region_factors = [
        torch.ones(view.rows.shape[0], dtype=torch.float32) if rows is None else torch.from_numpy(rows).float()
        for view, rows in zip(codebook.views, aggregation.kept_regions, strict=True)
    ]
    kept_W = scale_weights(W, torch.cat(region_factors).index_select(0, W.region))
    kept_sums = kept_W.row_sums().numpy()
    selected = aggregation.unclustered_mask & torch.from_numpy((kept_sums > 0) & (kept_sums >= LEAST_KEPT * sums))
    solve_rows(X, torch.nonzero(selected)[:, 0], kept_W, codebook, progress, means=means, threads=threads)
    return X, {"resolved": float(selected.float().mean())}


def aggregation_facts(
    clustering: Clustering, merged: Tensor, assigned: Tensor, rejected: Tensor | None
) -> dict[str, Any]:
    """Return the facts of clusters, and of the splats that took a feature or were rejected by the guard [P] bool."""
    facts = clustering_facts(clustering, merged) | {"changed": float(assigned.float().mean())}
    return facts if rejected is None else facts | {"guarded": float(rejected.float().mean())}


def clustering_facts(clustering: Clustering, merged: Tensor) -> dict[str, Any]:
    """Return the facts of the clusters, for the diagnostics."""
    return {
        "clusters": clustering.count,
        "clusters_with_feature": int((merged != 0).any(dim=1).sum()),
        "unclustered_share": float((clustering.labels == NO_CLUSTER).float().mean()),
        **clustering.facts,
    }


def guard(
    candidates: Tensor,
    labels: Tensor,
    merged: Tensor,
    W: RegionWeights,
    directions: RegionDirections,
    own_consistency: Tensor,
    threads: int | None = None,
) -> Tensor:
    """Return a mask [n] bool of the candidates whose views the cluster's feature explains worse than their own
    feature.

    Args:
        candidates: [n] bool, splats whose cluster has a feature. labels, merged: of `cluster_consistency`.
        W: reweighted, of the same block of splats. own_consistency: [n] f32, consistency of their own features.
    """
    consistency = cluster_consistency(W, directions, labels, merged, threads)
    return candidates & (consistency < own_consistency - RESOLUTION)  # a smaller difference is rounding to float16


@one_thread()
def cluster_consistency(
    W: RegionWeights, directions: RegionDirections, labels: Tensor, merged: Tensor, threads: int | None = None
) -> Tensor:
    """Return ``sum_m W_jm max(0, cos(e_m, e_k)) / sum_m W_jm`` of each splat j and its cluster k: [P] f32, 0 if none.

    Args:
        W: on the CPU. labels: [P] i32, -1 for none. merged: [K, F], the clusters' features.
        threads: None uses the cores that this process may use. The result is bitwise identical for any number.
    """
    result, cluster_directions, regions = (
        np.zeros(labels.shape[0], np.float32),
        directions.of(merged),
        directions.totals.shape[0],
    )
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))
    blocks, step = W.blocks(), max(TABLE_BYTES // (4 * max(regions, 1)), 1)
    for begin in range(0, cluster_directions.shape[0], step):
        block = cluster_directions[begin : begin + step]
        cosines = torch.zeros(block.shape[0], regions, dtype=torch.float32)
        for columns in directions.slices():
            cosines += block[:, columns] @ directions.table(columns).T
        arrays = indptr, region, weight, labels.numpy(), begin, cosines.numpy(), result
        run_each(add_consistency, [(first, last, *arrays) for first, last in blocks], threads)
    return torch.from_numpy(result)


@kernel
def add_consistency(first, last, indptr, region, weight, labels, begin, cosines, result):
    """Compute `cluster_consistency` of splats ``first..last``, for the clusters of ``cosines``, from ``begin`` on."""
    for j in range(first, last):
        k = labels[j] - begin
        if 0 <= k < cosines.shape[0]:
            total, agreeing = 0.0, 0.0
            for n in range(indptr[j], indptr[j + 1]):
                total += weight[n]
                agreeing += weight[n] * max(cosines[k, region[n]], 0.0)
            result[j] = agreeing / total if total > 0.0 else 0.0


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
    params = settings.render_params
    for number, name in enumerate(views.names):
        camera, features = views[number]
        observation = masks_of(features, settings, name)
        if isinstance(observation, Regions):
            kappa = raster.strongest_labels(camera, clustering.labels, params).numpy()
            kappa = np.where(raster.row_sums(camera, params).numpy() < LEAST_LIGHT, NO_CLUSTER, kappa)
            rows = observation.codebook.shape[0]
            matches = match_regions(observation.labels.numpy(), kappa, rows, clustering.count)
            kept_rows = (matches.clusters >= 0) & (matches.ious >= settings.aggregation_iou)
            region_sums.add(observation.codebook, matches.clusters, kept_rows)
            region_sums.masks[name] = kept_rows
            region_sums.regions += int(matches.present.sum())
        progress("aggregate", number + 1, len(views), "views")
    return region_sums


def masks_of(observation: ViewFeatures, settings: LiftSettings, view: str) -> ViewFeatures:
    """Return the masks to filter: those of one level if it was lifted alone, else all.

    Composite regions are pieces of masks, which match no cluster's footprint.
    """
    return at_levels(observation, "rows" if settings.levels == "composite" else settings.levels, view)


def kept_means(region_sums: KeptRegionSums, dtype: torch.dtype) -> Tensor:
    """Return the mean of each cluster's kept rows, [K, F]; zero if there is none."""
    means = region_sums.sums / np.maximum(region_sums.counts, 1)[:, None]
    return torch.from_numpy(means).to(dtype)


def weighted_means(
    features: Tensor, total_weight: np.ndarray, clustering: Clustering, threads: int | None = None
) -> Tensor:
    """Return the mean of the features of each cluster's splats, [K, F], weighted by their total weight."""
    sums = cluster_sums(features, total_weight, clustering.labels.numpy(), clustering.count, threads)
    return cluster_means(sum_pieces(sums, (features.shape[1] + 1, clustering.count)), features.dtype)


def cluster_sums(
    features: Tensor, total_weight: np.ndarray, labels: np.ndarray, count: int, threads: int | None = None
) -> Iterator[PieceSums]:
    """Yield the sums of a block's clusters per piece: [F + 1, K], features weighted by total weight, and total
    weight.

    Args:
        features: [n, F] f16 or f32. total_weight: [n]. labels: [n] i32 below the count, -1 for none.
    """

    def add(first: int, last: int, table: np.ndarray) -> None:
        for begin in range(first, last, BLOCK):
            rows = begin + np.flatnonzero(labels[begin : min(begin + BLOCK, last)] >= 0)
            clusters, weights = labels[rows], total_weight[rows]
            shares = csr_matrix((weights, (clusters, np.arange(rows.size))), shape=(count, rows.size))
            table[:-1] += (shares @ features[torch.from_numpy(rows)].to(torch.float32).numpy()).T
            table[-1] += np.bincount(clusters, weights, minlength=count)

    return piece_sums(add, labels.size, (features.shape[1] + 1, count), threads)


def cluster_means(sums: np.ndarray, dtype: torch.dtype) -> Tensor:
    """Return the clusters' features [K, F] from the sums [F + 1, K] f64 of all splats (`cluster_sums`)."""
    means = np.divide(sums[:-1], sums[-1], out=np.zeros_like(sums[:-1]), where=sums[-1] > 0)
    return torch.from_numpy(means.T).to(dtype).contiguous()


def with_feature(labels: Tensor, merged: Tensor) -> Tensor:
    """Return a mask [P] bool of the splats whose cluster has a feature."""
    has_feature = torch.cat([(merged != 0).any(dim=1), torch.zeros(1, dtype=torch.bool)])  # the last is for -1
    return has_feature[labels.long()]


def assign_features(features: Tensor, labels: Tensor, merged: Tensor, assigned: Tensor) -> Tensor:
    """Overwrite the features of the assigned splats [P] bool by those of their clusters, in place."""
    for first in range(0, features.shape[0], BLOCK):
        rows = first + torch.nonzero(assigned[first : first + BLOCK])[:, 0]
        features[rows] = merged[labels[rows].long()]
    return features


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
