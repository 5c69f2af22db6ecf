"""Codes of features: each splat takes the mean feature of a group of splats with nearly its own, two bytes a splat.

Features of masks are mixtures of few region vectors, and most of what differs within a thing is noise. So groups of
like splats lose nothing that is asked for. Groups are cut in two, those that vary most first, in principal directions
of a sample, and their number doubles until a held-out part of the sample loses little by it; each cut places all
splats. Samples are evenly spaced rows and products have fixed shapes, so that codes depend on no number of threads.

A splat counts by the root of its total weight. By the weight itself groups follow the few splats near to cameras
(`tabletop`, grids: accuracy .919, by the root .922, exact .923); without it they follow the noise of splats that few
rays meet.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array

from liftcore.runtime.cores import cores
from liftcore.runtime.memory import zeros
from liftcore.runtime.one_thread import one_thread
from liftcore.solve.clusters import principal_axes
from liftcore.values.lift_file import byte_steps
from liftcore.values.region_weights import MEMORY_LIMIT

MOST_CODES = 8_192
LEAST_CODES = 512  # where as many features differ: mixtures at borders are few, and would go first
LEAST_SPLATS = 4_096  # with a feature
SAMPLE = 1 << 17  # splats of which groups are made
HELD_OUT = 8  # each eighth of them measures the loss, and makes no group
CHANNELS = 48  # principal directions in which groups are cut
ROUNDS = 3  # of 2-means that place a cut
SMALL_LOSS = 0.01  # 1 - cosine about the mean, of held-out splats by weight, from which there are no more groups
MOST_LOSS = (
    0.02  # likewise, with which features stay exact: maps vary within things (`plush` at .034: fidelity -.008)
)
MOST_LOSS_OF_MASKS = 0.045  # likewise: what differs within things is noise (`tabletop` at .038: phrases +.0001)
LEAST_SAVED = 2  # times smaller that codes and codebook must be than features
BLOCK = 4_096  # rows converted to float32 at once: larger copies are mapped anew each time


@dataclass(frozen=True)
class Codes:
    """Features as codes over a codebook."""

    code: np.ndarray  # [P] u16, 0 without a feature
    codebook: np.ndarray  # [K, F] of the features' type, the first row zero; f16 are multiples of `byte_steps`
    loss: float  # of held-out splats


def code_features(
    features: np.ndarray, has_feature: np.ndarray, total_weight: np.ndarray, of_masks: bool
) -> Codes | str:
    """Code features, or explain in a sentence why they are to stay exact.

    Args:
        features: [P, F] f16 or f32. has_feature: [P] bool. total_weight: [P] f32. of_masks: True if views had masks.
    """
    rows = np.flatnonzero(has_feature)
    sample = slice(None, None, -(-len(rows) // SAMPLE) or 1)
    most_groups = min(MOST_CODES - 1, len(features) // LEAST_SAVED - 1)  # one is zero
    if len(rows[sample]) < LEAST_SPLATS:
        return f"Features are exact: {len(rows)} splats with a feature are too few to share codes."
    root_weights = has_feature * np.sqrt(np.maximum(total_weight, np.float32(1e-6)))
    weights, centre = root_weights[rows[sample]], np.zeros(features.shape[1], np.float32)
    units = np.empty((len(weights), len(centre)), np.float16)  # float32 would be most of the memory here
    with one_thread():
        for block in _blocks(len(units)):
            units[block] = _unit(features[rows[sample][block]])
            centre += weights[block] @ _wide(units[block]) / weights.sum()
        axes = principal_axes(_wide(units[::HELD_OUT]) - centre, CHANNELS)
    points = _points(features, rows, centre, axes)
    training = np.where(np.arange(len(weights)) % HELD_OUT > 0, weights, np.float32(0.0))
    groups, number, loss = np.zeros(len(rows), np.int32), 1, 1.0
    while loss > SMALL_LOSS:
        groups = _cut(points, groups, sample, training, most_groups)
        previous, number = number, int(groups.max()) + 1
        if number == previous or number >= LEAST_CODES:
            loss = _loss(units, centre, training, weights, groups[sample])
        if number == previous:
            break
    if loss > (MOST_LOSS_OF_MASKS if of_masks else MOST_LOSS):
        return f"Features are exact: as codes their mean cosine about the scene's mean would be {1 - loss:.3f}."
    del units, points  # most of the memory here
    present = np.bincount(groups) > 0  # a cut may leave nothing on one side
    code, number = np.zeros(len(features), np.uint16), int(np.count_nonzero(present))
    code[rows] = np.cumsum(present)[groups]
    sums = np.zeros((number + 1, features.shape[1]))  # of all splats: a sample has ten a group
    for block in _blocks(len(code)):
        sums += _sums(code[block], root_weights[block], _wide(features[block]), number + 1)
    sums /= np.maximum(np.bincount(code, root_weights, number + 1), 1e-30)[:, None]
    codebook = sums.astype(np.float32)
    if features.dtype == np.float16:  # the file has bytes of these: 1 - cosine about the mean grows by .0001 to .0004
        steps = byte_steps(codebook)
        codebook = (np.clip(np.round(codebook / steps), -127, 127) + 0.0) * steps  # + 0, as bytes have no -0
    return Codes(code, codebook.astype(features.dtype), float(loss))


def _cut(points: np.ndarray, groups: np.ndarray, sample: slice, weights: np.ndarray, most_groups: int) -> np.ndarray:
    """Cut the groups [n] i32 of points [n, D] that vary most, to at most some number, and return the new ones.

    Args:
        sample: of the points, by which groups are cut. weights: of the sample, zero for what is held out.
    """
    inside, within, count, channels = points[sample].copy(), groups[sample], int(groups.max()) + 1, points.shape[1]
    masses = np.maximum(np.bincount(within, weights, count), 1e-30)[:, None]
    means = (_sums(within, weights, inside, count) / masses).astype(np.float32)
    variances = _sums(within, weights, np.square(inside - means[within]), count)
    spreads = variances.sum(axis=1)
    widest = np.argsort(-spreads, kind="stable")[: most_groups - count]
    widest = widest[spreads[widest] > 0]
    numbers = np.arange(count, dtype=np.int32)
    numbers[widest] = count + np.arange(widest.size)
    normals = np.eye(channels, dtype=np.float32)[variances.argmax(axis=1)]
    middles = (normals * means).sum(axis=1)
    for _ in range(ROUNDS):
        sides = 2 * within + _beyond(inside, within, normals, middles)
        totals = np.maximum(np.bincount(sides, weights, 2 * count), 1e-30)[:, None]
        centres = (_sums(sides, weights, inside, 2 * count) / totals).reshape(count, 2, channels)
        normals = (centres[:, 1] - centres[:, 0]).astype(np.float32)
        middles = np.einsum("nd,nd->n", normals, centres.mean(axis=1)).astype(np.float32)
    return np.where(_beyond(points, groups, normals, middles), numbers[groups], groups)


def _beyond(points: np.ndarray, groups: np.ndarray, normals: np.ndarray, middles: np.ndarray) -> np.ndarray:
    """Return the points [n, D] beyond the hyperplanes of their groups, [n] bool."""
    beyond = np.empty(len(points), np.bool_)
    for block in _blocks(len(points)):
        along = np.einsum("nd,nd->n", points[block], normals[groups[block]])
        beyond[block] = along > middles[groups[block]]
    return beyond


def _loss(
    units: np.ndarray, centre: np.ndarray, training: np.ndarray, weights: np.ndarray, groups: np.ndarray
) -> float:
    """Return 1 - the mean cosine of held-out units [n, F] f16 about the centre with the means of their groups."""
    count = int(groups.max()) + 1
    means = np.zeros((count, len(centre)), np.float32)
    for block in _blocks(len(units)):
        means += _sums(groups[block], training[block], _wide(units[block]) - centre, count)
    means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-30)
    held_out = _wide(units[::HELD_OUT]) - centre
    along = np.einsum("nf,nf->n", held_out, means[groups[::HELD_OUT]].astype(np.float32))
    cosines = along / np.maximum(np.linalg.norm(held_out, axis=1), 1e-30)
    return 1 - float(np.average(cosines, weights=weights[::HELD_OUT]))


def _sums(groups: np.ndarray, weights: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Return the sums [K, D] of weighted values [n, D] of each of K groups, in their type."""
    return csr_array((weights, groups, np.arange(len(groups) + 1)), shape=(len(groups), count)).T @ values


def _points(features: np.ndarray, rows: np.ndarray, centre: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the unit features of rows [n] about the centre along the axes, [n, D] f32."""
    shape = len(rows), axes.shape[1]
    in_file = 4 * len(rows) * axes.shape[1] > MEMORY_LIMIT
    points = zeros(shape, torch.float32, name="codes", in_file=in_file).numpy()

    def project(block: slice) -> None:
        np.subtract(_unit(features[rows[block]]) @ axes, centre @ axes, out=points[block])

    with one_thread(), ThreadPoolExecutor(cores()) as pool:
        list(pool.map(project, _blocks(len(rows))))
    return points


def _blocks(count: int) -> Iterator[slice]:
    return (slice(first, first + BLOCK) for first in range(0, count, BLOCK))


def _unit(rows: np.ndarray) -> np.ndarray:
    wide = _wide(rows)
    wide /= np.maximum(np.sqrt(np.einsum("nf,nf->n", wide, wide)), np.float32(1e-30))[:, None]
    return wide


def _wide(rows: np.ndarray) -> np.ndarray:
    """Return rows as new ones of float32; torch takes a fifth of NumPy's time."""
    return torch.from_numpy(rows).to(torch.float32, copy=True).numpy()
