"""Otsu's split (Otsu 1979), and the stand-in where another method finds nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from liftcore.query.threshold.histogram import Histogram


def otsu(histogram: Histogram) -> tuple[float, str]:
    """The edge that maximises the variance between its sides, and a sentence about it."""
    value = histogram.edge(_split(histogram.mass))
    return value, f"Otsu's split at {value:.4g} separates the scores best into two groups."


def stand_in(histogram: Histogram, lack: str) -> tuple[float, str]:
    """Otsu's split for a method that found ``lack`` (the histogram has ...)."""
    value = histogram.edge(_split(histogram.mass))
    return value, f"The histogram has {lack}; Otsu's split at {value:.4g} stands in."


def _split(mass: np.ndarray) -> int:
    """The bin k that maximises the variance between bins 0..k-1 and k.., 1 <= k < BINS."""
    centres = np.arange(len(mass)) + 0.5
    below, first = np.cumsum(mass)[:-1], np.cumsum(mass * centres)[:-1]
    total = float((mass * centres).sum())
    spread = below * (1 - below)
    # One score among very many leaves a side without mass, up to rounding: no split is there.
    between = np.where(spread > 0, (total * below - first) ** 2 / np.where(spread > 0, spread, 1.0), 0.0)
    # Empty bins between two groups tie: the middle of the best ones keeps clear of both.
    best = np.flatnonzero(between >= between.max() * (1 - 1e-9))
    return int(best[len(best) // 2]) + 1
