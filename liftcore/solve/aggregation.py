"""Post-Lifting Aggregation (paper, Post Aggregation Filtering): one feature a cluster, from the regions it confirms.

1. Cluster the splats by their lifted features (`clustering`).
2. Show the clusters in every lifted view: ``kappa = argmax(A onehot(cluster))``, unclustered splats being a class.
3. Keep the regions whose IoU with their majority cluster's footprint reaches tau (`region_filter`).
4. A cluster's feature is the mean of its kept regions' codebook rows, and its splats take it.

Splats in no cluster, and those of clusters without a kept region, keep their own features, or with
``aggregation_resolve`` are solved for again from the kept regions alone, if these have most of their weight. Grids
have no regions to filter: where no view has any, a cluster's feature is the mean of its splats' features, weighted by
evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.sparse import csr_matrix

from liftcore.features.levels import at_levels
from liftcore.features.views import Regions
from liftcore.solve.clustering import BLOCK, NO_CLUSTER, Clustering, cluster_splats
from liftcore.solve.totals import row_totals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from liftcore.features.pack import Views
    from liftcore.features.views import ViewFeatures
    from liftcore.progress import Progress
    from liftcore.raster.base import Raster
    from liftcore.scene.cameras import Cameras
    from liftcore.settings import LiftSettings
    from liftcore.solve.view_weights import WeightStore


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
    evidence: np.ndarray,
    views: tuple[Raster, Cameras, Views, Sequence[str]],
    settings: LiftSettings,
    progress: Progress,
    threads: int | None = None,
) -> Aggregation:
    """Aggregate lifted features, in place.

    Args:
        features: [P, F] f16 or f32; rows of splats whose cluster has a feature are overwritten with it.
        evidence: [P] f64, sums of plain weights.
        views: the raster, the cameras, the packs and the names of the lifted views.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    names = views[3]
    progress("aggregate", 0, len(names), "views")
    clustering = cluster_splats(features, evidence, settings, threads)
    region_views = [name for name in names if views[2].is_regions(name)]
    masks: dict[str, np.ndarray] = {}
    if clustering.count == 0:
        merged, facts = torch.zeros(0, features.shape[1], dtype=features.dtype), {}
    elif region_views:
        kept = filter_regions(clustering, features.shape[1], views, settings, progress)
        merged, masks = kept_means(kept, features.dtype), kept.masks
        facts = {"filter": "iou", "regions": kept.regions, "kept_regions": int(kept.counts.sum())}
    else:
        merged = evidence_means(features, evidence, clustering)
        facts = {"filter": "none: grids have no regions"}
    taken = spread(features, clustering.labels, merged)
    progress("aggregate", len(names), len(names), "views")
    facts = clustering_facts(clustering, merged) | facts | {"changed": float(taken.float().mean())}
    return Aggregation(clustering.labels, merged, facts, ~taken, tuple(masks.get(name) for name in names))


def clustering_facts(clustering: Clustering, merged: Tensor) -> dict[str, Any]:
    """What the certificate says of the clusters."""
    return {
        "clusters": clustering.count,
        "clusters_with_feature": int((merged != 0).any(dim=1).sum()),
        "unclustered_share": float((clustering.labels == NO_CLUSTER).float().mean()),
        "sample": clustering.sample,
        "smallest_in_sample": clustering.smallest,
        "sample_noise_share": clustering.sample_noise,
    }


def filter_regions(
    clustering: Clustering,
    channels: int,
    views: tuple[Raster, Cameras, Views, Sequence[str]],
    settings: LiftSettings,
    progress: Progress,
) -> KeptRegions:
    """Render the clusters to every lifted view and keep the regions that match one by ``aggregation_iou``."""
    raster, cameras, packs, names = views
    kept = KeptRegions(np.zeros((clustering.count, channels)), np.zeros(clustering.count, np.int64))
    walk = settings.render_params
    for number, name in enumerate(names):
        observation = masks_of(packs[name], settings, name)
        if isinstance(observation, Regions):
            kappa = raster.strongest_labels(cameras[name], clustering.labels, walk).numpy()
            rows = observation.codebook.shape[0]
            matches = match_regions(observation.labels.numpy(), kappa, rows, clustering.count)
            reliable = (matches.clusters >= 0) & (matches.ious >= settings.aggregation_iou)
            kept.add(observation.codebook, matches.clusters, reliable)
            kept.masks[name] = reliable
            kept.regions += int(matches.present.sum())
        progress("aggregate", number + 1, len(names), "views")
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


def evidence_means(features: Tensor, evidence: np.ndarray, clustering: Clustering) -> Tensor:
    """[K, F]: the mean of the features of each cluster's splats, weighted by their evidence."""
    labels = clustering.labels.numpy()
    sums, totals = np.zeros((clustering.count, features.shape[1])), np.zeros(clustering.count)
    for first in range(0, labels.size, BLOCK):
        own = np.flatnonzero(labels[first : first + BLOCK] >= 0)
        clusters, weights = labels[first + own], evidence[first + own]
        shares = csr_matrix((weights, (clusters, np.arange(own.size))), shape=(clustering.count, own.size))
        sums += shares @ features[torch.from_numpy(first + own)].to(torch.float32).numpy()
        totals += np.bincount(clusters, weights, minlength=clustering.count)
    means = np.divide(sums, totals[:, None], out=sums, where=totals[:, None] > 0)
    return torch.from_numpy(means).to(features.dtype)


def spread(features: Tensor, labels: Tensor, merged: Tensor) -> Tensor:
    """Give every splat its cluster's feature, where there is one; which splats took one, [P] bool."""
    filled = torch.cat([(merged != 0).any(dim=1), torch.zeros(1, dtype=torch.bool)])  # the last is label -1
    taken = filled[labels.long()]
    for first in range(0, features.shape[0], BLOCK):
        rows = first + torch.nonzero(taken[first : first + BLOCK])[:, 0]
        features[rows] = merged[labels[rows].long()]
    return taken


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
    y = (2 * np.arange(height) + 1) * label_rows // (2 * height)
    x = (2 * np.arange(width) + 1) * label_columns // (2 * width)
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


def kept_columns(store: WeightStore, kept: Sequence[np.ndarray | None], count: int) -> tuple[WeightStore, np.ndarray]:
    """The weights of the kept regions alone, and their sums a splat, [P] f64.

    Args:
        store: W of every view. It stays as it is; the result shares its columns, so it must stay open.
        kept: [M_v] bool of every view, which codebook rows count; None keeps a view whole.
        count: P.
    """
    fewer, denominators = store.blank(), np.zeros(count)
    for weights, target, rows in zip(store, fewer, kept, strict=True):
        counts = torch.ones_like(target.weights) if rows is None else torch.from_numpy(rows)[weights.columns.long()]
        torch.mul(weights.weights, counts, out=target.weights)
        denominators[weights.splats.numpy()] += row_totals(target)
    return fewer, denominators
