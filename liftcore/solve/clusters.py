"""Clusters of splats by feature: principal components, HDBSCAN on a sample, the nearest centre for all.

A splat's **direction** is its unit feature minus the scene's mean of these, normalised: features of one encoder lie
in a narrow cone, and the angle at the cone's axis separates objects where the angle at the origin does not.
"""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import Unavailable
from liftcore.runtime.cores import cores
from liftcore.runtime.one_thread import one_thread
from liftcore.values.settings import LiftSettings

NO_CLUSTER = -1
SAMPLE = 10_000  # splats that HDBSCAN clusters; every other splat joins the nearest cluster
CHANNELS = 50  # principal components that HDBSCAN sees
NEIGHBOURS = 10  # on which the density at a splat depends (HDBSCAN's min_samples)
BLOCK = 8_192  # rows converted to float32 at once; fixed, so that products have one shape on any machine
FULL_ODDS_WEIGHT = 1.0  # total weight, in rays, from which a splat has full odds to be sampled
REACH = 1.5  # a cluster takes splats up to this multiple of the distance from its centre
REACH_SHARE = 0.9  # within which this share of its sample lies, as HDBSCAN's clusters have outliers
RESOLUTION = 1e-3  # of float16 unit vectors: nearer ones count as equal


@dataclass(frozen=True)
class Clustering:
    """Clusters of splats, with facts of the clustering."""

    labels: Tensor  # [P] i32, -1 = no cluster
    count: int  # K
    facts: Mapping[str, Any]  # for the diagnostics: the method and its sample


@dataclass(frozen=True)
class Directions:
    """The map from features to coordinates, ``unit(unit(x) - centre) axes``."""

    centre: np.ndarray  # [F] f32, mean of unit features
    axes: np.ndarray  # [F, D] f32, orthonormal

    def coordinates(self, rows: Tensor) -> np.ndarray:
        """Map features [n, F] f16 or f32 to [n, D] f32; a feature at the centre has no direction and becomes zero."""
        return self.of(rows) @ self.axes

    def of(self, rows: Tensor) -> np.ndarray:
        """Return the directions [n, F] f32 of features [n, F]."""
        return _unit(_unit(rows.to(torch.float32).numpy()) - self.centre, RESOLUTION)


def cluster_splats(
    features: Tensor, total_weight: np.ndarray, settings: LiftSettings, threads: int | None = None
) -> Clustering:
    """Cluster splats by feature.

    Args:
        features: [P, F] f16 or f32; zero rows belong to no cluster.
        total_weight: [P], sums of unscaled weights; splats are sampled with odds ``min(total_weight, 1)``.
        settings: the ``aggregation_*`` settings and the seed.
    """
    count = features.shape[0]
    has_feature = nonzero_rows(features)
    odds = np.where(has_feature, np.minimum(total_weight, FULL_ODDS_WEIGHT), 0.0)
    rows = draw(odds, SAMPLE, settings.seed)
    share = rows.size / max(int((odds > 0).sum()), 1)
    smallest = max(2 * NEIGHBOURS, round(settings.aggregation_cluster_size * share))
    facts: dict[str, Any] = {"sample": rows.size, "smallest_in_sample": smallest}
    none = torch.full((count,), NO_CLUSTER, dtype=torch.int32)
    no_clusters = Clustering(none, 0, facts | {"sample_noise_share": 1.0})
    if rows.size < 2 * smallest:
        return no_clusters
    sample = features[torch.from_numpy(rows)]
    directions = directions_of(sample, CHANNELS)
    if directions is None:
        return no_clusters
    with one_thread():
        points = directions.coordinates(sample)
    sample_labels = hdbscan_labels(points, smallest, settings.seed)
    clusters = int(sample_labels.max()) + 1
    if clusters == 0:
        return no_clusters
    labels = nearest_clusters(
        features, has_feature, directions, cluster_balls(points, sample_labels, clusters), threads
    )
    facts["sample_noise_share"] = float((sample_labels < 0).mean())
    return Clustering(torch.from_numpy(labels), clusters, facts)


def nonzero_rows(features: Tensor) -> np.ndarray:
    """Return a mask [P] bool of rows with a nonzero channel."""
    mask = np.zeros(features.shape[0], bool)
    for first in range(0, features.shape[0], BLOCK):
        mask[first : first + BLOCK] = (features[first : first + BLOCK] != 0).any(dim=1).numpy()
    return mask


def draw(odds: np.ndarray, size: int, seed: int) -> np.ndarray:
    """Sample rows [<= size] i64, ascending, by odds [P], without replacement (Efraimidis and Spirakis 2006)."""
    possible = np.flatnonzero(odds > 0)
    if possible.size <= size:
        return possible
    draws = np.random.default_rng(seed).exponential(size=odds.size)[possible]
    order = np.argsort(draws / odds[possible], kind="stable")
    return np.sort(possible[order[:size]])


def directions_of(sample: Tensor, channels: int) -> Directions | None:
    """Return the centre and the principal axes of a sample [n, F]; None if all its unit features are equal."""
    unit = _unit(sample.to(torch.float32).numpy())
    centre = unit.mean(axis=0, dtype=np.float64).astype(np.float32)
    offsets = unit - centre
    if np.abs(offsets).max() < RESOLUTION:
        return None
    directions = _unit(offsets, RESOLUTION)
    return Directions(centre, principal_axes(directions - directions.mean(axis=0), channels))


def require_hdbscan() -> None:
    """Check that features can be clustered.

    Raises:
        Unavailable: the package hdbscan is not installed.
    """
    if find_spec("hdbscan") is None:
        expected = "the package hdbscan, for clusters of features"
        hint = "pip install 'splatlift[aggregation]', or set aggregation=false"
        raise Unavailable("aggregation", expected=expected, got="none", hint=hint)


def hdbscan_labels(points: np.ndarray, smallest: int, seed: int) -> np.ndarray:
    """Return HDBSCAN's labels [n] i64 of points [n, D], -1 = noise (Campello, Moulavi and Sander 2013).

    Equal points would have infinite density, so seeded noise of float16's resolution is added first.
    """
    import hdbscan

    shift = np.random.default_rng(seed).normal(size=points.shape)
    shift *= RESOLUTION / max(np.sqrt(points.shape[1]), 1.0)
    # Prim's algorithm is exact, and its time depends on n alone; Boruvka's, the default, is up to twice as slow.
    model = hdbscan.HDBSCAN(
        min_cluster_size=smallest, min_samples=NEIGHBOURS, algorithm="prims_kdtree", core_dist_n_jobs=1
    )
    return model.fit(points.astype(np.float64) + shift).labels_


def cluster_balls(points: np.ndarray, labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the clusters' centres [K, D] f32, and the squared distance [K] f32 up to which each takes splats."""
    centres = np.zeros((count, points.shape[1]), np.float32)
    reaches = np.zeros(count, np.float32)
    for k in range(count):
        members = points[labels == k]
        centres[k] = members.mean(axis=0, dtype=np.float64)
        squares = ((members - centres[k]) ** 2).sum(axis=1)
        reaches[k] = REACH**2 * np.quantile(squares, REACH_SHARE, method="higher")
    return centres, reaches


def nearest_clusters(
    features: Tensor,
    eligible: np.ndarray,
    directions: Directions,
    balls: tuple[np.ndarray, np.ndarray],
    threads: int | None = None,
) -> np.ndarray:
    """Return the cluster with the nearest centre, [P] i32, or -1 beyond its reach.

    Args:
        features: [P, F]. eligible: [P] bool, splats that may belong to a cluster. balls: of `cluster_balls`.
    """
    centres, reaches = balls
    halves = (centres * centres).sum(axis=1) / 2
    labels = np.full(features.shape[0], NO_CLUSTER, np.int32)

    def assign_block(first: int) -> None:
        block = slice(first, first + BLOCK)
        points = directions.coordinates(features[block])
        nearest = (points @ centres.T - halves).argmax(axis=1)
        distances = ((points - centres[nearest]) ** 2).sum(axis=1)
        inside = eligible[block] & (distances <= reaches[nearest])
        labels[block][inside] = nearest[inside]

    with one_thread(), ThreadPoolExecutor(threads or cores()) as pool:
        list(pool.map(assign_block, range(0, features.shape[0], BLOCK)))
    return labels


def _unit(rows: np.ndarray, floor: float = 0.0) -> np.ndarray:
    """Normalise rows [n, F] f32; rows not longer than the floor become zero."""
    # Divide by the largest entry first: squares of small or large float32 numbers underflow or overflow.
    largest = np.abs(rows).max(axis=1, keepdims=True)
    scaled = np.divide(rows, largest, out=np.zeros_like(rows), where=largest > 0)
    lengths = np.sqrt(np.einsum("nf,nf->n", scaled, scaled))[:, None]
    return np.divide(scaled, lengths, out=np.zeros_like(rows), where=lengths * largest > floor)


def principal_axes(centred: np.ndarray, count: int) -> np.ndarray:
    """Return the directions of the largest variance: eigenvectors of the covariance, at a cost of the cube of F.

    Signs are fixed: the largest entry of an axis is positive.

    Args:
        centred: [n, F] f32, a sample without its mean.
        count: the number of axes, at most.

    Returns:
        [F, min(count, F)] f32, orthonormal columns, the largest variance first.
    """
    count = min(count, centred.shape[1])
    with one_thread():
        axes = np.linalg.eigh((centred.T @ centred).astype(np.float64))[1][:, ::-1][:, :count]
    rows = np.abs(axes).argmax(axis=0)
    return (axes * np.sign(axes[rows, np.arange(count)])).astype(np.float32)
