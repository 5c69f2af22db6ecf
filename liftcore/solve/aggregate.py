"""Post-Lifting Aggregation (paper, Post Aggregation Filtering): one feature a cluster, from the regions it confirms.

1. Cluster the splats by their lifted features: principal components, HDBSCAN on a sample, the nearest centre for all.
2. Show the clusters in every lifted view: ``kappa = argmax(A onehot(cluster))``, unclustered splats being a class.
3. Keep the regions whose IoU with their majority cluster's footprint reaches tau (`filter_regions`).
4. A cluster's feature is the mean of its kept regions' codebook rows, and its splats take it.

Splats in no cluster, and those of clusters without a kept region, keep their own features, or with
``aggregation_resolve`` are solved for again from the kept regions alone, if these have most of their weight. Grids
have no regions to filter: where no view has any, a cluster's feature is the mean of its splats' features, weighted by
evidence.

A splat's **direction** is its unit feature less the scene's mean of these, made unit again: features of one encoder
lie in a narrow cone, and the angle at the cone's axis tells objects apart where the angle at the origin does not.
"""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from liftcore.features.levels import at_levels
from liftcore.features.views import Regions, ViewFeatures, cells_under
from liftcore.progress import Progress
from liftcore.raster.base import Raster
from liftcore.settings import LiftSettings
from liftcore.solve.geometry import LiftViews

NO_CLUSTER = -1
BLOCK = 8_192  # rows widened to float32 at once; fixed, so that products have one shape on any machine
ENOUGH_EVIDENCE = 1.0  # a splat that adds up to a whole ray is drawn with full odds, a fainter one with less
REACH = 1.5  # a cluster takes splats up to so many times the distance from its centre
REACH_SHARE = 0.9  # within which this share of its own sample lies: HDBSCAN's clusters have stragglers
RESOLUTION = 1e-3  # of float16 unit vectors: nearer ones count as equal


@dataclass(frozen=True)
class Clustering:
    """Which cluster each splat belongs to, and how that was found."""

    labels: Tensor  # [P] i32, -1 = in no cluster
    count: int  # K
    sample: int  # splats that HDBSCAN saw
    smallest: int  # the fewest of them that make a cluster
    sample_noise: float  # share of them that HDBSCAN left out


@dataclass(frozen=True)
class Directions:
    """How features become coordinates: ``unit(unit(x) - centre) axes``."""

    centre: np.ndarray  # [F] f32, mean of unit features
    axes: np.ndarray  # [F, D] f32, orthonormal

    def coordinates(self, rows: Tensor) -> np.ndarray:
        """[n, F] f16 or f32 -> [n, D] f32; a feature at the centre has no direction and becomes zero."""
        return self.of(rows) @ self.axes

    def of(self, rows: Tensor) -> np.ndarray:
        """[n, F] -> [n, F] f32, the directions themselves."""
        return _unit(_unit(rows.to(torch.float32).numpy()) - self.centre, RESOLUTION)


def cluster_splats(
    features: Tensor, evidence: np.ndarray, settings: LiftSettings, threads: int | None = None
) -> Clustering:
    """Cluster splats by feature.

    Args:
        features: [P, F] f16 or f32; zero rows belong to no cluster.
        evidence: [P], sums of plain weights; splats are drawn for the sample with odds ``min(evidence, 1)``.
        settings: the ``aggregation_*`` knobs and the seed.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    count = features.shape[0]
    known = nonzero_rows(features)
    odds = np.where(known, np.minimum(evidence, ENOUGH_EVIDENCE), 0.0)
    rows = draw(odds, settings.aggregation_sample, settings.seed)
    share = rows.size / max(int((odds > 0).sum()), 1)
    smallest = max(2 * settings.aggregation_neighbours, 2, round(settings.aggregation_cluster_size * share))
    nothing = Clustering(torch.full((count,), NO_CLUSTER, dtype=torch.int32), 0, rows.size, smallest, 1.0)
    if rows.size < 2 * smallest:
        return nothing
    sample = features[torch.from_numpy(rows)]
    directions = directions_of(sample, settings.aggregation_channels)
    if directions is None:
        return nothing
    with one_blas_thread():
        points = directions.coordinates(sample)
    found = hdbscan_labels(points, smallest, settings.aggregation_neighbours, settings.seed)
    clusters = int(found.max()) + 1
    if clusters == 0:
        return nothing
    labels = assign(features, known, directions, cluster_balls(points, found, clusters), threads)
    return Clustering(torch.from_numpy(labels), clusters, rows.size, smallest, float((found < 0).mean()))


def nonzero_rows(features: Tensor) -> np.ndarray:
    """[P] bool: whether any channel differs from zero."""
    known = np.zeros(features.shape[0], bool)
    for first in range(0, features.shape[0], BLOCK):
        known[first : first + BLOCK] = (features[first : first + BLOCK] != 0).any(dim=1).numpy()
    return known


def draw(odds: np.ndarray, size: int, seed: int) -> np.ndarray:
    """Ascending rows [<= size] i64, drawn with the given odds [P], each once (Efraimidis and Spirakis 2006)."""
    possible = np.flatnonzero(odds > 0)
    if possible.size <= size:
        return possible
    draws = np.random.default_rng(seed).exponential(size=odds.size)[possible]
    order = np.argsort(draws / odds[possible], kind="stable")
    return np.sort(possible[order[:size]])


def directions_of(sample: Tensor, channels: int) -> Directions | None:
    """The centre and the principal axes of a sample [n, F]; None when all its unit features are equal."""
    unit = _unit(sample.to(torch.float32).numpy())
    centre = unit.mean(axis=0, dtype=np.float64).astype(np.float32)
    offsets = unit - centre
    if np.abs(offsets).max() < RESOLUTION:
        return None
    directions = _unit(offsets, RESOLUTION)
    return Directions(centre, principal_axes(directions - directions.mean(axis=0), channels))


def hdbscan_labels(points: np.ndarray, smallest: int, neighbours: int, seed: int) -> np.ndarray:
    """HDBSCAN's labels [n] i64 of points [n, D], -1 = noise (Campello, Moulavi and Sander 2013).

    Equal points would have infinite density, so each moves by the resolution of float16 first, seeded.
    """
    import hdbscan

    shift = np.random.default_rng(seed).normal(size=points.shape)
    shift *= RESOLUTION / max(np.sqrt(points.shape[1]), 1.0)
    # Prim's algorithm is exact, and its time depends on n alone; Boruvka's, the default, is up to twice as slow here.
    model = hdbscan.HDBSCAN(
        min_cluster_size=smallest, min_samples=neighbours, algorithm="prims_kdtree", core_dist_n_jobs=1
    )
    return model.fit(points.astype(np.float64) + shift).labels_


def cluster_balls(points: np.ndarray, labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres [K, D] f32 of the clusters, and the squared distance [K] f32 up to which each takes splats."""
    centres = np.zeros((count, points.shape[1]), np.float32)
    reaches = np.zeros(count, np.float32)
    for k in range(count):
        members = points[labels == k]
        centres[k] = members.mean(axis=0, dtype=np.float64)
        squares = ((members - centres[k]) ** 2).sum(axis=1)
        reaches[k] = REACH**2 * np.quantile(squares, REACH_SHARE, method="higher")
    return centres, reaches


def assign(
    features: Tensor,
    known: np.ndarray,
    directions: Directions,
    balls: tuple[np.ndarray, np.ndarray],
    threads: int | None = None,
) -> np.ndarray:
    """[P] i32: the cluster with the nearest centre, or -1 beyond its reach.

    Args:
        features: [P, F]. known: [P] bool, splats that may belong to a cluster. balls: of `cluster_balls`.
    """
    centres, reaches = balls
    halves = (centres * centres).sum(axis=1) / 2
    labels = np.full(features.shape[0], NO_CLUSTER, np.int32)

    def assign_block(first: int) -> None:
        block = slice(first, first + BLOCK)
        points = directions.coordinates(features[block])
        nearest = (points @ centres.T - halves).argmax(axis=1)
        distances = ((points - centres[nearest]) ** 2).sum(axis=1)
        inside = known[block] & (distances <= reaches[nearest])
        labels[block][inside] = nearest[inside]

    with one_blas_thread(), ThreadPoolExecutor(threads or len(os.sched_getaffinity(0))) as pool:
        list(pool.map(assign_block, range(0, features.shape[0], BLOCK)))
    return labels


def _unit(rows: np.ndarray, floor: float = 0.0) -> np.ndarray:
    """Rows [n, F] f32 of length one; those not longer than the floor become zero."""
    # The largest entry goes out first: the square of a small or large float32 is none.
    largest = np.abs(rows).max(axis=1, keepdims=True)
    scaled = np.divide(rows, largest, out=np.zeros_like(rows), where=largest > 0)
    lengths = np.sqrt(np.einsum("nf,nf->n", scaled, scaled))[:, None]
    return np.divide(scaled, lengths, out=np.zeros_like(rows), where=lengths * largest > floor)


EXACT_CHANNELS = 1_024  # up to here all eigenvectors at once; beyond, the cost grows with the cube of F
_OVERSAMPLE = 16  # more directions than asked for, so that the last ones are found well too
_ITERATIONS = 6
_SEED = 0


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Products of NumPy on one thread each: their sums have one order then, whatever the machine's cores."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield


def principal_axes(centred: np.ndarray, count: int) -> np.ndarray:
    """The directions of the largest variance.

    All eigenvectors of the covariance where F is small; subspace iteration from a seeded start (Halko, Martinsson
    and Tropp 2011) where it is not. Signs are fixed: the largest entry of an axis is positive.

    Args:
        centred: [n, F] f32, a sample without its mean.
        count: how many axes at most.

    Returns:
        [F, min(count, F)] f32, orthonormal columns, the largest variance first.
    """
    channels = centred.shape[1]
    count = min(count, channels)
    with one_blas_thread():
        if channels <= EXACT_CHANNELS:
            covariance = (centred.T @ centred).astype(np.float64)
            axes = np.linalg.eigh(covariance)[1][:, ::-1][:, :count]
        else:
            axes = _subspace(centred, count)
    rows = np.abs(axes).argmax(axis=0)
    return (axes * np.sign(axes[rows, np.arange(count)])).astype(np.float32)


def _subspace(centred: np.ndarray, count: int) -> np.ndarray:
    width = min(count + _OVERSAMPLE, centred.shape[1])
    start = np.random.default_rng(_SEED).standard_normal((centred.shape[1], width)).astype(np.float32)
    basis = np.linalg.qr(start)[0]
    for _ in range(_ITERATIONS):
        basis = np.linalg.qr(centred.T @ (centred @ basis))[0]
    shown = (centred @ basis).astype(np.float64)
    turn = np.linalg.eigh(shown.T @ shown)[1][:, ::-1][:, :count]
    return basis @ turn


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
    raster: Raster,
    views: LiftViews,
    settings: LiftSettings,
    progress: Progress,
    threads: int | None = None,
) -> Aggregation:
    """Aggregate lifted features, in place.

    Args:
        features: [P, F] f16 or f32; rows of splats whose cluster has a feature are overwritten with it.
        evidence: [P] f64, sums of plain weights.
        views: that were lifted.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    names = views.names
    progress("aggregate", 0, len(names), "views")
    clustering = cluster_splats(features, evidence, settings, threads)
    region_views = [name for name in names if views.features.is_regions(name)]
    masks: dict[str, np.ndarray] = {}
    if clustering.count == 0:
        merged, facts = torch.zeros(0, features.shape[1], dtype=features.dtype), {}
    elif region_views:
        kept = filter_regions(clustering, features.shape[1], raster, views, settings, progress)
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
