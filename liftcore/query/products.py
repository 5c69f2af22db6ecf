"""Inner products of every splat's feature with a few vectors, at the speed of the memory.

float16 rows are widened one at a time into a buffer that stays in the first-level cache, so a million rows are read
once and never copied. The rows go in fixed shares over threads of our own: a thread team that meets at a barrier
after every block, as the linear algebra library's does, waits for its slowest member a thousand times a query when
the machine has other work.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.jit import vectorised

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

# A float16 shifted to float32's place is the number times 2^-112, as the exponents' biases are 127 and 15.
HALF_SCALE = 2.0**112
SIGN_AND_MAGNITUDE = np.int32(-0x70002000)  # bits 31 and 27..13, where a shifted float16 lies
LOWEST_COSINE = -1.0  # what a splat without a feature scores
SHARE_ROWS = 8_192  # rows a share; the bits of the result depend on no row but one's own


@vectorised
def _widen(halves, words):
    for c in range(halves.shape[0]):
        words[c] = (np.int32(halves[c]) << np.int32(13)) & SIGN_AND_MAGNITUDE


@vectorised
def _dot(row, direction):
    total = np.float32(0.0)
    for c in range(row.shape[0]):
        total += row[c] * direction[c]
    return total


@vectorised
def _square(row, scale):
    total = np.float32(0.0)
    for c in range(row.shape[0]):
        value = row[c] * scale
        total += value * value
    return total


@vectorised
def _cosine(product, norm):
    if norm == 0:
        return np.float32(LOWEST_COSINE)
    return min(max(product / norm, np.float32(-1.0)), np.float32(1.0))


@vectorised
def compare_halves(first, last, halves, norms, directions, cosines):
    """``cosines[j, n] = halves[j] . directions[n] / norms[j]`` for rows first..last, -1 where the norm is zero.

    Args:
        halves: [P, F] i16, the bits of float16. norms: [P] f32. directions: [n, F] f32, unit rows times HALF_SCALE.
        cosines: [P, n] f32.
    """
    words = np.empty(halves.shape[1], np.int32)
    row = words.view(np.float32)
    for j in range(first, last):
        _widen(halves[j], words)
        for n in range(directions.shape[0]):
            cosines[j, n] = _cosine(_dot(row, directions[n]), norms[j])


@vectorised
def compare_floats(first, last, floats, norms, directions, cosines):
    """The same for rows [P, F] f32 and unscaled directions."""
    for j in range(first, last):
        for n in range(directions.shape[0]):
            cosines[j, n] = _cosine(_dot(floats[j], directions[n]), norms[j])


@vectorised
def norm_halves(first, last, halves, norms):
    """``norms[j] = |halves[j]|`` for rows first..last; norms: [P] f32."""
    words = np.empty(halves.shape[1], np.int32)
    row = words.view(np.float32)
    for j in range(first, last):
        _widen(halves[j], words)
        norms[j] = np.sqrt(_square(row, np.float32(HALF_SCALE)))


@vectorised
def norm_floats(first, last, floats, norms):
    """The same for rows [P, F] f32."""
    for j in range(first, last):
        norms[j] = np.sqrt(_square(floats[j], np.float32(1.0)))


def cosines_of(features: Tensor, norms: Tensor, directions: Tensor) -> Tensor:
    """Cosines of the rows to unit vectors.

    Args:
        features: [P, F] f16 or f32, finite.
        norms: [P] f32, from `norms_of`.
        directions: [n, F] f32, unit rows.

    Returns:
        [P, n] f32 in [-1, 1]; -1 for zero rows.
    """
    rows, work, scale = (
        (_bits(features), compare_halves, HALF_SCALE)
        if features.dtype == torch.float16
        else (_floats(features), compare_floats, 1.0)
    )
    columns = np.ascontiguousarray(directions.to(torch.float32).numpy() * np.float32(scale))
    lengths = norms.contiguous().numpy()
    cosines = np.empty((features.shape[0], columns.shape[0]), np.float32)
    _over_rows(features.shape[0], lambda first, last: work(first, last, rows, lengths, columns, cosines))
    return torch.from_numpy(cosines)


def norms_of(features: Tensor) -> Tensor:
    """Euclidean norms of the rows of features [P, F] f16 or f32, as [P] f32."""
    norms = np.empty(features.shape[0], np.float32)
    if features.dtype == torch.float16:
        halves = _bits(features)
        _over_rows(len(norms), lambda first, last: norm_halves(first, last, halves, norms))
    else:
        floats = _floats(features)
        _over_rows(len(norms), lambda first, last: norm_floats(first, last, floats, norms))
    return torch.from_numpy(norms)


def _bits(features: Tensor) -> np.ndarray:
    return features.contiguous().view(torch.int16).numpy()


def _floats(features: Tensor) -> np.ndarray:
    return features.to(torch.float32).contiguous().numpy()


def _over_rows(count: int, work: Callable[[int, int], None]) -> None:
    starts = range(0, count, SHARE_ROWS)
    threads = min(len(starts), len(os.sched_getaffinity(0)))
    if threads <= 1:
        work(0, count)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda first: work(first, min(first + SHARE_ROWS, count)), starts))
