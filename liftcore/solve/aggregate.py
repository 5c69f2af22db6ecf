"""Post-Lifting Aggregation (paper, Post Aggregation Filtering): one feature a cluster.

The paper's way, where features make the clusters (``aggregation_clusters=hdbscan``):

1. Cluster the splats by their lifted features (`liftcore.solve.clusters`).
2. Show the clusters in every lifted view: ``kappa = argmax(A onehot(cluster))``. Unclustered splats are a class, to
   which rays belong that the scene fills by less than half: what is left of their light tells no cluster.
3. Keep the regions whose IoU with their majority cluster's footprint reaches tau (`filter_regions`).
4. A cluster's feature is the mean of its kept regions' codebook rows, and its splats take it.

Where masks make the clusters (``graph``), these are the objects that other views keep together
(`liftcore.solve.objects`): they need no footprint to confirm them. As on grids, which have no regions to filter, a
cluster's feature is the mean of its splats' features, weighted by total weight.

Splats in no cluster, and those of clusters without a kept region, keep their own features, or with
``aggregation_resolve`` are solved for again from the kept regions alone, if these have most of their weight.

**The guard** (``aggregation_guard``) lets no thing vanish in a cluster that is mostly another: a splat takes a
cluster's feature only where that explains what the views say of it at least as well as its own does. With e, c_jm,
p_jv, c and the weights W' of the reweighting (`liftcore.solve.reweight`), which asks other views for each word::

    sum_m W'_jm max(0, cos(e_m, e_cluster))  >=  sum_m W'_jm ((1 - p_jv) c_jm + p_jv c)

**How it splits**, where masks make the clusters: a cluster's feature is a sum over splats, taken by pieces
(`cluster_sums`); whether a splat takes it is a function of its row of W and its own feature (`guard`, `spread`).
HDBSCAN's sample and the footprints of clusters need all features in one place.
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
from liftcore.solve.clusters import BLOCK, NO_CLUSTER, RESOLUTION, Clustering, cluster_splats, parted
from liftcore.solve.codebook import TABLE_BYTES, Codebook
from liftcore.solve.directions import RegionDirections
from liftcore.solve.objects import RegionObjects
from liftcore.solve.reweight import reweighted
from liftcore.solve.sums import PieceSums, added, piece_sums
from liftcore.values.levels import at_levels
from liftcore.values.lift_views import LiftViews
from liftcore.values.region_weights import RegionWeights, run_each
from liftcore.values.settings import LiftSettings
from liftcore.values.views import Regions, ViewFeatures, cells_under

MASKS_MADE = {"filter": "none: masks made the clusters"}
LEAST_KEPT = 0.5  # of a splat's weight, in regions that were kept, for it to be solved for again
LEAST_LIGHT = 0.5  # of a ray, that splats must take for it to show a cluster: as for masks of answers


@dataclass(frozen=True)
class Aggregation:
    """Clusters and their features."""

    clusters: Tensor  # [P] i32, -1 = in no cluster
    cluster_features: Tensor  # [K, F] like the features; a zero row where the splats keep their own
    facts: dict[str, Any]  # for the certificate
    own: Tensor  # [P] bool, the splats that kept their own features
    kept: tuple[np.ndarray | None, ...]  # [M_v] bool a view, the regions that were kept; None = no regions to filter


@dataclass
class KeptRegions:
    """What the kept regions of all views add up to."""

    sums: np.ndarray  # [K, F] f64, of their codebook rows
    counts: np.ndarray  # [K] i64, how many they are
    regions: int = 0  # of all views, kept or not
    masks: dict[str, np.ndarray] = field(default_factory=dict)  # view -> [M] bool, which codebook rows are kept

    def add(self, codebook: Tensor, clusters: np.ndarray, kept: np.ndarray) -> None:
        """Add the kept rows [M] bool of a codebook [M, F] to their clusters [M]."""
        rows = np.flatnonzero(kept)
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
    things: RegionObjects | None = None,
    judged: tuple[RegionWeights, RegionDirections, Tensor] | None = None,
) -> tuple[Tensor, Aggregation]:
    """Lifted features with those of clusters; they are changed in place.

    Args:
        features: [P, F] f16 or f32; rows of splats that take their cluster's feature are overwritten with it, and the
            same tensor is returned.
        total_weight: [P] f64, sums of plain weights.
        views: that were lifted.
        threads: None takes the cores that this process may use. The number changes no bit.
        things: the clusters; None: those of features.
        judged: what the guard asks: reweighted W on the CPU, directions of its regions, and how well the splats' own
            features explain them, [P] f32 (`Agreement`); None: there is no guard.
    """
    names = views.names
    progress("aggregate", 0, len(names), "views")
    if things is not None:
        clustering = Clustering(torch.from_numpy(things.labels), things.count, {"clustered_by": "graph"})
    else:
        clustering = cluster_splats(features, total_weight, settings, threads)
        if settings.aggregation_clusters != "hdbscan":
            clustering = parted(clustering, splats, settings.aggregation_cluster_size, threads)
    masks: dict[str, np.ndarray] = {}
    if clustering.count == 0:
        merged, facts = torch.zeros(0, features.shape[1], dtype=features.dtype), {}
    elif things is not None:
        merged, facts = weighted_means(features, total_weight, clustering, threads), MASKS_MADE
    elif any(views.features.is_regions(name) for name in names):
        kept = filter_regions(clustering, features.shape[1], raster, views, settings, progress)
        merged, masks = kept_means(kept, features.dtype), kept.masks
        facts = {"filter": "iou", "regions": kept.regions, "kept_regions": int(kept.counts.sum())}
    else:
        merged = weighted_means(features, total_weight, clustering, threads)
        facts = {"filter": "none: grids have no regions"}
    taken, guarded = with_feature(clustering.labels, merged), None
    if judged is not None and clustering.count:
        guarded = guard(taken, clustering.labels, merged, *judged, threads)
        taken = taken & ~guarded
    features = spread(features, clustering.labels, merged, taken)
    progress("aggregate", len(names), len(names), "views")
    facts = facts | aggregation_facts(clustering, merged, taken, guarded)
    kept = tuple(masks.get(name) for name in names)
    return features, Aggregation(clustering.labels, merged, facts, ~taken, kept)


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
    """X, solved again from the kept regions alone for splats that took no cluster's feature; and their share of all.

    Only those most of whose weight lies in kept regions: it is their neighbours' regions that reach the others.

    Args:
        X: [P, F], changed in place. W: reweighted, on the CPU. sums: [P] f64, of rows of W as it was weighed.
        means: [P, 3] of the splats.
    """
    if all(rows is None for rows in aggregation.kept):
        return X, {"resolved": 0.0}
    counted = [
        torch.ones(view.rows.shape[0], dtype=torch.float32) if rows is None else torch.from_numpy(rows).float()
        for view, rows in zip(codebook.views, aggregation.kept, strict=True)
    ]
    fewer = reweighted(W, torch.cat(counted).index_select(0, W.region))
    most = fewer.row_sums().numpy()
    chosen = aggregation.own & torch.from_numpy((most > 0) & (most >= LEAST_KEPT * sums))
    solve_rows(X, torch.nonzero(chosen)[:, 0], fewer, codebook, progress, means=means, threads=threads)
    return X, {"resolved": float(chosen.float().mean())}


def aggregation_facts(
    clustering: Clustering, merged: Tensor, taken: Tensor, guarded: Tensor | None
) -> dict[str, Any]:
    """What the certificate says of clusters, and of the splats that took a feature or were kept from it [P] bool."""
    facts = clustering_facts(clustering, merged) | {"changed": float(taken.float().mean())}
    return facts if guarded is None else facts | {"guarded": float(guarded.float().mean())}


def clustering_facts(clustering: Clustering, merged: Tensor) -> dict[str, Any]:
    """What the certificate says of the clusters."""
    return {
        "clusters": clustering.count,
        "clusters_with_feature": int((merged != 0).any(dim=1).sum()),
        "unclustered_share": float((clustering.labels == NO_CLUSTER).float().mean()),
        **clustering.facts,
    }


def guard(
    taken: Tensor,
    labels: Tensor,
    merged: Tensor,
    W: RegionWeights,
    directions: RegionDirections,
    own: Tensor,
    threads: int | None = None,
) -> Tensor:
    """Which of the splats that are to take a feature it would explain worse than their own does: [n] bool.

    Args:
        taken: [n] bool, those that are to take one. labels, merged: of `explained_by`. W: reweighted, of the same
            block of splats. own: [n] f32, what their own features explain.
    """
    explained = explained_by(W, directions, labels, merged, threads)
    return taken & (explained < own - RESOLUTION)  # what differs by less is one vector in float16


@one_thread()
def explained_by(
    W: RegionWeights, directions: RegionDirections, labels: Tensor, merged: Tensor, threads: int | None = None
) -> Tensor:
    """``sum_m W_jm max(0, cos(e_m, e_k)) / sum_m W_jm`` of each splat j and its cluster k: [P] f32, 0 without one.

    Args:
        W: on the CPU. labels: [P] i32, -1 for none. merged: [K, F], the clusters' features.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    told, own, regions = np.zeros(labels.shape[0], np.float32), directions.of(merged), directions.totals.shape[0]
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))
    blocks, step = W.blocks(), max(TABLE_BYTES // (4 * max(regions, 1)), 1)
    for begin in range(0, own.shape[0], step):
        chosen = own[begin : begin + step]
        cosines = torch.zeros(chosen.shape[0], regions, dtype=torch.float32)
        for columns in directions.slices():
            cosines += chosen[:, columns] @ directions.table(columns).T
        given = indptr, region, weight, labels.numpy(), begin, cosines.numpy(), told
        run_each(explain, [(first, last, *given) for first, last in blocks], threads)
    return torch.from_numpy(told)


@kernel
def explain(first, last, indptr, region, weight, labels, begin, cosines, told):
    """`explained_by` of splats ``first..last``, for the clusters from ``begin`` on whose cosines are given."""
    for j in range(first, last):
        k = labels[j] - begin
        if 0 <= k < cosines.shape[0]:
            whole, said = 0.0, 0.0
            for n in range(indptr[j], indptr[j + 1]):
                whole += weight[n]
                said += weight[n] * max(cosines[k, region[n]], 0.0)
            told[j] = said / whole if whole > 0.0 else 0.0


def filter_regions(
    clustering: Clustering,
    channels: int,
    raster: Raster,
    views: LiftViews,
    settings: LiftSettings,
    progress: Progress,
) -> KeptRegions:
    """Render the clusters to every lifted view and keep the regions that match one by ``aggregation_iou``."""
    kept = KeptRegions(np.zeros((clustering.count, channels)), np.zeros(clustering.count, np.int64))
    params = settings.render_params
    for number, name in enumerate(views.names):
        camera, given = views[number]
        observation = masks_of(given, settings, name)
        if isinstance(observation, Regions):
            kappa = raster.strongest_labels(camera, clustering.labels, params).numpy()
            kappa = np.where(raster.row_sums(camera, params).numpy() < LEAST_LIGHT, NO_CLUSTER, kappa)
            rows = observation.codebook.shape[0]
            matches = match_regions(observation.labels.numpy(), kappa, rows, clustering.count)
            reliable = (matches.clusters >= 0) & (matches.ious >= settings.aggregation_iou)
            kept.add(observation.codebook, matches.clusters, reliable)
            kept.masks[name] = reliable
            kept.regions += int(matches.present.sum())
        progress("aggregate", number + 1, len(views), "views")
    return kept


def masks_of(observation: ViewFeatures, settings: LiftSettings, view: str) -> ViewFeatures:
    """The masks that are filtered: those of one level where it was lifted alone, else all.

    Composite regions are pieces of masks; no cluster's footprint would match them.
    """
    return at_levels(observation, "rows" if settings.levels == "composite" else settings.levels, view)


def kept_means(kept: KeptRegions, dtype: torch.dtype) -> Tensor:
    """[K, F]: the mean of each cluster's kept rows; zero where there is none."""
    means = kept.sums / np.maximum(kept.counts, 1)[:, None]
    return torch.from_numpy(means).to(dtype)


def weighted_means(
    features: Tensor, total_weight: np.ndarray, clustering: Clustering, threads: int | None = None
) -> Tensor:
    """[K, F]: the mean of the features of each cluster's splats, weighted by their total weight."""
    sums = cluster_sums(features, total_weight, clustering.labels.numpy(), clustering.count, threads)
    return cluster_means(added(sums, (features.shape[1] + 1, clustering.count)), features.dtype)


def cluster_sums(
    features: Tensor, total_weight: np.ndarray, labels: np.ndarray, count: int, threads: int | None = None
) -> Iterator[PieceSums]:
    """Yield what a block of splats adds to its clusters, at every piece: [F + 1, K], weighted features, total weight.

    Args:
        features: [n, F] f16 or f32. total_weight: [n]. labels: [n] i32 below the count, -1 for none.
    """

    def add(first: int, last: int, table: np.ndarray) -> None:
        for begin in range(first, last, BLOCK):
            own = begin + np.flatnonzero(labels[begin : min(begin + BLOCK, last)] >= 0)
            clusters, weights = labels[own], total_weight[own]
            shares = csr_matrix((weights, (clusters, np.arange(own.size))), shape=(count, own.size))
            table[:-1] += (shares @ features[torch.from_numpy(own)].to(torch.float32).numpy()).T
            table[-1] += np.bincount(clusters, weights, minlength=count)

    return piece_sums(add, labels.size, (features.shape[1] + 1, count), threads)


def cluster_means(sums: np.ndarray, dtype: torch.dtype) -> Tensor:
    """[K, F], from the sums [F + 1, K] f64 of all splats (`cluster_sums`)."""
    means = np.divide(sums[:-1], sums[-1], out=np.zeros_like(sums[:-1]), where=sums[-1] > 0)
    return torch.from_numpy(means.T).to(dtype).contiguous()


def with_feature(labels: Tensor, merged: Tensor) -> Tensor:
    """[P] bool: the splats whose cluster has a feature."""
    known = torch.cat([(merged != 0).any(dim=1), torch.zeros(1, dtype=torch.bool)])  # the last is for -1
    return known[labels.long()]


def spread(features: Tensor, labels: Tensor, merged: Tensor, taken: Tensor) -> Tensor:
    """The features, changed in place: splats that are to take one [P] bool have their clusters'."""
    for first in range(0, features.shape[0], BLOCK):
        rows = first + torch.nonzero(taken[first : first + BLOCK])[:, 0]
        features[rows] = merged[labels[rows].long()]
    return features


@dataclass(frozen=True)
class RegionMatches:
    """The cluster that each region of a view shows most, and how well they match."""

    clusters: np.ndarray  # [M] i64, -1 where it is none, or where no pixel reads the region
    ious: np.ndarray  # [M] f64, 0 there
    present: np.ndarray  # [M] bool, whether any pixel reads the region


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
    """[M, K + 1] i64: pixels of the image that read a region and show a cluster; the first column is for none."""
    height, width = kappa.shape
    levels, label_rows, label_columns = labels.shape
    y = cells_under(np.arange(height), height, label_rows)
    x = cells_under(np.arange(width), width, label_columns)
    shown = (kappa + 1).ravel()
    total = csr_matrix((rows, clusters + 1), dtype=np.int64)
    read: list[np.ndarray] = []
    for level in range(levels):
        own = labels[level][y[:, None], x].ravel()
        counted = own >= 0
        for other in read:
            counted &= own != other  # a region on two levels counts a pixel once
        read.append(own)
        ones = np.ones(int(counted.sum()), np.int64)
        total += csr_matrix((ones, (own[counted], shown[counted])), shape=total.shape)  # equal places add up
    return total


def _largest(table: csr_matrix) -> tuple[np.ndarray, np.ndarray]:
    """Column and value of the largest entry of each row, the first of equal ones; (0, 0) for an empty row."""
    table.sort_indices()
    indices, starts, data = (np.asarray(part, np.int64) for part in (table.indices, table.indptr, table.data))
    columns, values = np.zeros(starts.size - 1, np.int64), np.zeros(starts.size - 1, np.int64)
    lengths = np.diff(starts)
    filled = np.flatnonzero(lengths)
    if filled.size:
        largest = np.maximum.reduceat(data, starts[filled])
        row_of_entry = np.repeat(np.arange(filled.size), lengths[filled])
        places = np.flatnonzero(data == largest[row_of_entry])
        first = places[np.unique(row_of_entry[places], return_index=True)[1]]
        columns[filled], values[filled] = indices[first], largest
    return columns, values
