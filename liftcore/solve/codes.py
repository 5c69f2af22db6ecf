"""Codes of features: each splat takes the mean feature of a group of splats with nearly its own, two bytes a splat.

Features of masks are mixtures of few region vectors, and most of what differs within a thing is noise. So groups of
like splats lose nothing that is asked for. Groups are cut in two, those that vary most first, in principal directions
of a sample, and their number doubles until a held-out part of the sample loses little by it; the cuts then place all
splats. Samples are evenly spaced rows and products have fixed shapes, so that codes depend on no number of threads.

A splat counts by the root of its total weight. By the weight itself groups follow the few splats near to cameras
(`tabletop`, grids: accuracy .919, by the root .922, exact .923); without it they follow the noise of splats that few
rays meet.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from liftcore.runtime.cores import cores
from liftcore.runtime.one_thread import one_thread
from liftcore.solve.clusters import principal_axes

MOST_CODES = 8_192
LEAST_CODES = 512  # where as many features differ: mixtures at borders are few, and would go first
LEAST_SPLATS = 4_096  # with a feature
SAMPLE = 1 << 17  # splats of which groups are made
HELD_OUT = 8  # each eighth of them measures the loss, and makes no group
CHANNELS = 64  # principal directions in which groups are cut
ROUNDS = 3  # of 2-means that place a cut
SMALL_LOSS = 0.01  # 1 - cosine about the mean, of held-out splats by weight, from which there are no more groups
MOST_LOSS = 0.045  # likewise, with which features stay exact
LEAST_SAVED = 2  # times smaller that codes and codebook must be than features
BLOCK = 8_192  # rows converted to float32 at once


@dataclass(frozen=True)
class Codes:
    """Features as codes over a codebook."""

    code: np.ndarray  # [P] u16, 0 without a feature
    codebook: np.ndarray  # [K, F] of the features' type, the first row zero
    loss: float  # of held-out splats


@dataclass(frozen=True)
class _Cut:
    """A cut of each of n groups in two, by a hyperplane."""

    normals: np.ndarray  # [n, D] f32
    offsets: np.ndarray  # [n] f32; infinite for a group that stays
    numbers: np.ndarray  # [n] i32, of the groups beyond the hyperplanes

    def place(self, rows: np.ndarray, groups: np.ndarray) -> np.ndarray:
        """Return the new groups [m] i32 of rows [m, D]."""
        beyond = np.einsum("md,md->m", rows, self.normals[groups]) > self.offsets[groups]
        return np.where(beyond, self.numbers[groups], groups)


def code_features(features: np.ndarray, has_feature: np.ndarray, total_weight: np.ndarray) -> Codes | str:
    """Code features, or explain in a sentence why they are to stay exact.

    Args:
        features: [P, F] f16 or f32. has_feature: [P] bool. total_weight: [P] f32.
    """
    rows = np.flatnonzero(has_feature)
    rows = rows[:: -(-len(rows) // SAMPLE) or 1]
    most_groups = min(MOST_CODES - 1, len(features) // LEAST_SAVED - 1)  # one is zero
    if len(rows) < LEAST_SPLATS:
        return f"Features are exact: {len(rows)} splats with a feature are too few to share codes."
    root_weights = has_feature * np.sqrt(np.maximum(total_weight, np.float32(1e-6)))
    unit, weights = _unit(features[rows]), root_weights[rows]
    with one_thread():
        centre = (weights @ unit / weights.sum()).astype(np.float32)
        axes = principal_axes(unit[::HELD_OUT] - centre, CHANNELS)
    points, offsets = _points(features, rows, centre, axes), unit - centre
    training = np.where(np.arange(len(rows)) % HELD_OUT > 0, weights, np.float32(0.0))
    cuts, groups, loss = list[_Cut](), np.zeros(len(rows), np.int32), 1.0
    while (loss > SMALL_LOSS or groups.max() < LEAST_CODES) and (
        cut := _cut(points, training, groups, most_groups)
    ) is not None:
        cuts, groups = [*cuts, cut], cut.place(points, groups)
        loss = _loss(offsets, training, weights, groups)
    if loss > MOST_LOSS:
        return f"Features are exact: as codes their mean cosine about the scene's mean would be {1 - loss:.3f}."
    code, count = np.zeros(len(features), np.uint16), int(groups.max()) + 2

    def place(block: np.ndarray) -> None:
        groups, points = np.zeros(len(block), np.int32), _points(features, block, centre, axes)
        for cut in cuts:
            groups = cut.place(points, groups)
        code[block] = groups + 1

    _over_blocks(place, np.flatnonzero(has_feature))
    sums = np.zeros((count, features.shape[1]))  # of all splats: a sample has ten a group
    for first in range(0, len(code), BLOCK):
        block = slice(first, first + BLOCK)
        sums += _sums(code[block], root_weights[block], features[block].astype(np.float32), count)
    codebook = sums / np.maximum(np.bincount(code, root_weights, count), 1e-30)[:, None]
    return Codes(code, codebook.astype(features.dtype), float(loss))


def _cut(points: np.ndarray, weights: np.ndarray, groups: np.ndarray, most_groups: int) -> _Cut | None:
    """Cut the groups [n] i32 of points [n, D] that vary most, to at most some number; None if none can be cut."""
    count, channels = int(groups.max()) + 1, points.shape[1]
    masses = np.maximum(np.bincount(groups, weights, count), 1e-30)[:, None]
    means = (_sums(groups, weights, points) / masses).astype(np.float32)
    variances = _sums(groups, weights, np.square(points - means[groups])) / masses
    spreads = (variances * masses).sum(axis=1)
    widest = np.argsort(-spreads, kind="stable")[: most_groups - count]
    widest = widest[spreads[widest] > 0]
    if not widest.size:
        return None
    numbers, offsets = np.arange(count, dtype=np.int32), np.full(count, np.inf, np.float32)
    numbers[widest] = count + np.arange(widest.size)
    axes = variances.argmax(axis=1)
    beyond = points[np.arange(len(points)), axes[groups]] > means[groups, axes[groups]]
    normals, middles = np.zeros((count, channels), np.float32), offsets
    for _ in range(ROUNDS):
        sides = 2 * groups + beyond
        totals = np.maximum(np.bincount(sides, weights, 2 * count), 1e-30)[:, None]
        centres = (_sums(sides, weights, points, 2 * count) / totals).reshape(count, 2, channels)
        normals = (centres[:, 1] - centres[:, 0]).astype(np.float32)
        middles = np.einsum("nd,nd->n", normals, centres.mean(axis=1)).astype(np.float32)
        beyond = np.einsum("nd,nd->n", points, normals[groups]) > middles[groups]
    is_cut = numbers >= count
    return _Cut(normals, np.where(is_cut, middles, np.float32(np.inf)), numbers)


def _loss(offsets: np.ndarray, training: np.ndarray, weights: np.ndarray, groups: np.ndarray) -> float:
    """Return 1 - the mean cosine of held-out offsets [n, F] from the centre with the means of their groups."""
    means = _sums(groups, training, offsets)
    means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-30)
    held_out = offsets[::HELD_OUT]
    along = np.einsum("nf,nf->n", held_out, means[groups[::HELD_OUT]].astype(np.float32))
    cosines = along / np.maximum(np.linalg.norm(held_out, axis=1), 1e-30)
    return 1 - float(np.average(cosines, weights=weights[::HELD_OUT]))


def _sums(groups: np.ndarray, weights: np.ndarray, values: np.ndarray, count: int | None = None) -> np.ndarray:
    """Return the sums [K, D] of weighted values [n, D] of each group, in their type."""
    count, number = int(groups.max()) + 1 if count is None else count, len(groups)
    return csr_array((weights, groups, np.arange(number + 1)), shape=(number, count)).T @ values


def _points(features: np.ndarray, rows: np.ndarray, centre: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the unit features of rows [n] about the centre along the axes, [n, D] f32."""
    points = np.empty((len(rows), axes.shape[1]), np.float32)

    def project(block: np.ndarray) -> None:
        points[block] = (_unit(features[rows[block]]) - centre) @ axes

    with one_thread():
        _over_blocks(project, np.arange(len(rows)))
    return points


def _over_blocks(work: Callable[[np.ndarray], None], rows: np.ndarray) -> None:
    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(work, [rows[first : first + BLOCK] for first in range(0, len(rows), BLOCK)]))


def _unit(rows: np.ndarray) -> np.ndarray:
    wide = rows.astype(np.float32)
    return wide / np.maximum(np.linalg.norm(wide, axis=1, keepdims=True), np.float32(1e-30))
