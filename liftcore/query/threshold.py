"""Where a score becomes a yes: thresholds from the histogram alone.

No ground truth and no count of instances enters. All sizes are shares of the histogram's mass, so that the
resolution of a view does not matter, and all positions are shares of its range, so that thresholds move with
the scores: ``threshold(a s + b) = a threshold(s) + b`` for a > 0, up to rounding.

| method | the threshold |
|---|---|
| `valley`, `auto` | the appendix: from the top down, the first local maximum, then the minimum before it |
| `paper` | the main text, literally: the largest peak, then the adjacent smaller valley above it |
| `otsu` | the split with the largest variance between its sides |
| a number | itself (`fixed`) |

The paper gives no numbers for the smoothing, the least peak and the depth of a valley: ours were tuned on the masks
of one scene (tabletop with its hard features), so expect less elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.errors import InvalidQuery
from liftcore.jit import kernel

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

METHODS = ("auto", "valley", "paper", "otsu")
BINS = 256
SMOOTHING = 4.0  # bins, standard deviation of the Gaussian that removes a histogram's ripples
LEAST_PEAK = 3e-4  # of the mass: what lies above a valley must be at least this to count as found
DEPTH = 0.6  # a valley must fall to this share of its peak, else it is a ripple


@dataclass(frozen=True)
class Threshold:
    """A threshold and how it came about."""

    value: float  # scores at or above it answer the query
    method: str  # auto, valley, paper, otsu or fixed
    explanation: str  # one sentence for the user


@dataclass(frozen=True)
class Histogram:
    """Scores counted in equal bins between their least and their greatest."""

    mass: np.ndarray  # [BINS] f64, sums to one
    low: float  # the left edge of the first bin
    width: float  # of a bin

    def edge(self, position: int) -> float:
        """The left edge of a bin."""
        return self.low + position * self.width

    def smoothed(self, deviation: float) -> np.ndarray:
        """[BINS] f64, the mass after a Gaussian of that many bins, mirrored at both ends."""
        reach = math.ceil(4 * deviation)
        offsets = np.arange(-reach, reach + 1)
        kernel = np.exp(-0.5 * (offsets / deviation) ** 2)
        padded = np.pad(self.mass, reach, mode="symmetric")
        return np.convolve(padded, kernel / kernel.sum(), mode="valid")


@kernel
def count_weighted(scores, weights, low, bins_a_unit, mass):
    """Add each weight [n] f32 to its score's bin of ``mass`` [BINS] f64; scores [n] f32 from ``low`` up."""
    for k in range(scores.shape[0]):
        place = int((scores[k] - low) * bins_a_unit)
        mass[min(max(place, 0), mass.shape[0] - 1)] += weights[k]


def find_threshold(scores: Tensor, method: str | float, weights: Tensor | None = None) -> Threshold:
    """A threshold on scores by one of the methods above.

    Degenerate maps have a defined answer. No scores at all give infinity: nothing is found. Equal scores give
    that score: all of them answer alike. A histogram without the valley that a method looks for falls back to
    Otsu's split, and the explanation says so.

    Args:
        scores: [n] f32, finite.
        method: one of ``METHODS``, or a number to use as it is.
        weights: [n] f32, how much each score counts, at least zero; None = equally.

    Raises:
        InvalidQuery: an unknown method, or a fixed threshold or scores that are not finite.
    """
    if isinstance(method, int | float):
        return _fixed(float(method))
    if method not in METHODS:
        raise InvalidQuery("threshold", expected=f"a number or one of {', '.join(METHODS)}", got=repr(method))
    if scores.numel() == 0:
        return Threshold(math.inf, method, "There are no scores: nothing can be found.")
    low, high = (float(value) for value in torch.aminmax(scores))
    if not (math.isfinite(low) and math.isfinite(high)):
        raise InvalidQuery("scores", expected="finite values", got="NaN or infinity")
    histogram = _count(scores, low, high, weights)
    if histogram is None:
        return Threshold(low, method, f"All scores are {low:.4g}: the histogram has no valley.")
    value, explanation = _METHODS[method](histogram)
    return Threshold(min(max(value, low), high), method, explanation)


def _fixed(value: float) -> Threshold:
    if not math.isfinite(value):
        raise InvalidQuery("threshold", expected="a finite number", got=str(value))
    return Threshold(value, "fixed", f"The threshold {value:.4g} was given.")


def _count(scores: Tensor, low: float, high: float, weights: Tensor | None) -> Histogram | None:
    width = (high - low) / BINS
    # Scores that differ by their last bits have no histogram worth the name.
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


def _valley(histogram: Histogram) -> tuple[float, str]:
    smooth = histogram.smoothed(SMOOTHING)
    above = np.cumsum(histogram.mass[::-1])[::-1]
    peaks, valleys = _extrema(smooth)
    for peak in reversed(peaks):
        lower = [valley for valley in valleys if valley < peak]
        if not lower:
            break
        valley = lower[-1]
        if above[valley] >= LEAST_PEAK and smooth[valley] <= DEPTH * smooth[peak]:
            value = histogram.edge(valley)
            return value, (
                f"From the top down, the histogram's first hill lies at {histogram.edge(peak):.4g} and the "
                f"valley before it at {value:.4g}; {above[valley]:.1%} lies above."
            )
    return _fallback(histogram, "no hill with a valley before it")


def _paper(histogram: Histogram) -> tuple[float, str]:
    smooth = histogram.smoothed(SMOOTHING)
    peaks, valleys = _extrema(smooth)
    peak = max(peaks, key=lambda place: smooth[place])
    for valley in valleys:
        if valley > peak and smooth[valley] < smooth[peak]:
            value = histogram.edge(valley)
            return value, (
                f"The histogram's largest peak lies at {histogram.edge(peak):.4g} and the next valley above "
                f"it at {value:.4g}."
            )
    return _fallback(histogram, "no valley above its largest peak")


def _otsu(histogram: Histogram) -> tuple[float, str]:
    value = histogram.edge(_otsu_split(histogram.mass))
    return value, f"Otsu's split at {value:.4g} separates the scores best into two groups."


def _fallback(histogram: Histogram, lack: str) -> tuple[float, str]:
    value = histogram.edge(_otsu_split(histogram.mass))
    return value, f"The histogram has {lack}; Otsu's split at {value:.4g} stands in."


def _otsu_split(mass: np.ndarray) -> int:
    """The bin k that maximises the variance between bins 0..k-1 and k.. (Otsu 1979), 1 <= k < BINS."""
    centres = np.arange(len(mass)) + 0.5
    below, first = np.cumsum(mass)[:-1], np.cumsum(mass * centres)[:-1]
    total = float((mass * centres).sum())
    between = (total * below - first) ** 2 / np.maximum(below * (1 - below), 1e-300)
    # Empty bins between two groups tie: the middle of the best ones keeps clear of both.
    best = np.flatnonzero(between >= between.max() * (1 - 1e-9))
    return int(best[len(best) // 2]) + 1


def _extrema(curve: np.ndarray) -> tuple[list[int], list[int]]:
    """Local maxima (ends count) and the minima between each two of them; a plateau counts at its middle."""
    starts = np.flatnonzero(np.concatenate([[True], curve[1:] != curve[:-1]]))
    levels = curve[starts]
    middles = (starts + np.append(starts[1:], len(curve)) - 1) // 2
    rises = np.concatenate([[True], levels[1:] > levels[:-1]])
    falls = np.append(levels[1:] < levels[:-1], True)
    peaks = [int(place) for place in middles[rises & falls]]
    valleys = [int(place) for place in middles[1:-1][(~rises & ~falls)[1:-1]]]
    return peaks, valleys


_METHODS: dict[str, Callable[[Histogram], tuple[float, str]]] = {
    "auto": _valley,
    "valley": _valley,
    "paper": _paper,
    "otsu": _otsu,
}
