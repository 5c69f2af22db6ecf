"""Clusters of splats by feature: principal components, HDBSCAN on a sample, the nearest centre for all.

A splat's **direction** is its unit feature less the scene's mean of these, made unit again: features of one encoder
lie in a narrow cone, and the angle at the cone's axis tells objects apart where the angle at the origin does not.
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
from liftcore.scene.splats import Splats
from liftcore.scene.touching import touching
from liftcore.values.settings import LiftSettings

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
    facts: Mapping[str, Any]  # for the certificate: what found them, and on how much


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
    features: Tensor, total_weight: np.ndarray, settings: LiftSettings, threads: int | None = None
) -> Clustering:
    """Cluster splats by feature.

    Args:
        features: [P, F] f16 or f32; zero rows belong to no cluster.
        total_weight: [P], sums of plain weights; splats are drawn for the sample with odds ``min(total_weight, 1)``.
        settings: the ``aggregation_*`` knobs and the seed.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    count = features.shape[0]
    known = nonzero_rows(features)
    odds = np.where(known, np.minimum(total_weight, ENOUGH_EVIDENCE), 0.0)
    rows = draw(odds, settings.aggregation_sample, settings.seed)
    share = rows.size / max(int((odds > 0).sum()), 1)
    smallest = max(2 * settings.aggregation_neighbours, 2, round(settings.aggregation_cluster_size * share))
    facts: dict[str, Any] = {"clustered_by": "hdbscan", "sample": rows.size, "smallest_in_sample": smallest}
    none = torch.full((count,), NO_CLUSTER, dtype=torch.int32)
    nothing = Clustering(none, 0, facts | {"sample_noise_share": 1.0})
    if rows.size < 2 * smallest:
        return nothing
    sample = features[torch.from_numpy(rows)]
    directions = directions_of(sample, settings.aggregation_channels)
    if directions is None:
        return nothing
    with one_thread():
        points = directions.coordinates(sample)
    found = hdbscan_labels(points, smallest, settings.aggregation_neighbours, settings.seed)
    clusters = int(found.max()) + 1
    if clusters == 0:
        return nothing
    labels = assign(features, known, directions, cluster_balls(points, found, clusters), threads)
    facts["sample_noise_share"] = float((found < 0).mean())
    return Clustering(torch.from_numpy(labels), clusters, facts)


def parted(found: Clustering, splats: Splats, smallest: int, threads: int | None = None) -> Clustering:
    """Each cluster's groups of splats that touch, as clusters of their own; no cluster where they are fewer.

    Masks show one thing: of two that look alike, neither's mask matches the footprint of both.
    """
    before, count = found.labels.numpy(), 0
    labels = np.full(before.size, NO_CLUSTER, np.int32)
    for cluster in range(found.count):
        rows = np.flatnonzero(before == cluster)
        groups = touching(splats, rows, threads)
        kept = np.bincount(groups) >= smallest
        numbers = np.where(kept, count + np.cumsum(kept) - 1, NO_CLUSTER)
        labels[rows] = numbers[groups]
        count += int(kept.sum())
    return Clustering(torch.from_numpy(labels), count, {**found.facts, "clustered_by": "touching"})


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


def require_hdbscan() -> None:
    """See before the work that features can be clustered.

    Raises:
        Unavailable: the package hdbscan is not installed.
    """
    if find_spec("hdbscan") is None:
        expected = "the package hdbscan, for clusters of features"
        hint = "pip install 'splatlift[aggregation]', or take aggregation_clusters=graph where views have masks"
        raise Unavailable("aggregation", expected=expected, got="none", hint=hint)


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

    with one_thread(), ThreadPoolExecutor(threads or cores()) as pool:
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
    with one_thread():
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
