"""Scores counted in bins, and the shape of what was counted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, overload

import numpy as np
import torch

from liftcore.jit import kernel

if TYPE_CHECKING:
    from torch import Tensor

BINS = 300  # a multiple of the sweep's 100 steps (`stability.py`)
SMOOTHING = BINS / 64  # bins, standard deviation of the Gaussian that removes a histogram's ripples
LEAST_SHARE = 3e-4  # of the scores: less than this above a threshold is stray (SAM drops masks this small)


@dataclass(frozen=True)
class Histogram:
    """Scores counted in equal bins between their least and their greatest."""

    mass: np.ndarray  # [BINS] f64, sums to one
    low: float  # the left edge of the first bin
    width: float  # of a bin

    @overload
    def edge(self, position: float) -> float: ...
    @overload
    def edge(self, position: np.ndarray) -> np.ndarray: ...
    def edge(self, position: float | np.ndarray) -> float | np.ndarray:
        """The left edge of a bin, or of each; position + 0.5 is its middle."""
        return self.low + position * self.width

    def smoothed(self) -> np.ndarray:
        """[BINS] f64, the mass after a Gaussian of SMOOTHING bins, mirrored at both ends."""
        reach = math.ceil(4 * SMOOTHING)
        offsets = np.arange(-reach, reach + 1)
        weights = np.exp(-0.5 * (offsets / SMOOTHING) ** 2)
        padded = np.pad(self.mass, reach, mode="symmetric")
        return np.convolve(padded, weights / weights.sum(), mode="valid")

    def above(self) -> np.ndarray:
        """[BINS] f64, the share of the scores in each bin or above it."""
        return np.cumsum(self.mass[::-1])[::-1]


@kernel
def count_weighted(scores, weights, low, bins_a_unit, mass):
    """Add each weight [n] f32 to its score's bin of ``mass`` [BINS] f64; scores [n] f32 from ``low`` up."""
    for k in range(scores.shape[0]):
        place = int((scores[k] - low) * bins_a_unit)
        mass[min(max(place, 0), mass.shape[0] - 1)] += weights[k]


def count(scores: Tensor, low: float, high: float, weights: Tensor | None) -> Histogram | None:
    """The histogram of scores [n] between their least and their greatest.

    Args:
        scores: [n] f32, finite. low, high: their least and greatest.
        weights: [n] f32, how much each counts; None = equally.

    Returns:
        None where the scores differ by their last bits, or weigh nothing: no histogram worth the name.
    """
    width = (high - low) / BINS
    if not width > 4 * np.spacing(np.float32(max(abs(low), abs(high)))):
        return None
    if weights is None:
        mass = torch.histc(scores.to(torch.float32), BINS, low, high).to(torch.float64).numpy()
    else:
        mass = np.zeros(BINS)
        values, shares = (part.to(torch.float32).flatten().numpy() for part in (scores, weights))
        count_weighted(values, shares, low, 1.0 / width, mass)
    total = mass.sum()
    return Histogram(mass / total, low, width) if total > 0 else None


def extrema(curve: np.ndarray) -> tuple[list[int], list[int]]:
    """Local maxima (ends count) and the minima between each two of them; a plateau counts at its middle."""
    starts = np.flatnonzero(np.concatenate([[True], curve[1:] != curve[:-1]]))
    levels = curve[starts]
    middles = (starts + np.append(starts[1:], len(curve)) - 1) // 2
    rises = np.concatenate([[True], levels[1:] > levels[:-1]])
    falls = np.append(levels[1:] < levels[:-1], True)
    peaks = [int(place) for place in middles[rises & falls]]
    valleys = [int(place) for place in middles[1:-1][(~rises & ~falls)[1:-1]]]
    return peaks, valleys


def longest_run(chosen: np.ndarray) -> tuple[int, int] | None:
    """First and last place of the longest run of True in [n] bool, the first of equals; None without any."""
    padded = np.concatenate([[False], chosen, [False]]).astype(np.int8)
    firsts, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
    if len(firsts) == 0:
        return None
    longest = int(np.argmax(ends - firsts))
    return int(firsts[longest]), int(ends[longest]) - 1
