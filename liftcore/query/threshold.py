"""Thresholds on scores, from the scores alone.

No ground truth and no other phrase is used, and no count of instances unless the user gives one. All sizes are shares
of the scores, so that the resolution of a view does not matter. All positions are shares of their range, so that a
threshold is equivariant: ``threshold(a s + b) = a threshold(s) + b`` for a > 0, up to rounding.

| method | the threshold |
|---|---|
| `auto` | where the selected share changes least, in log-odds; not below ``least`` |
| `paper` | *Splat Feature Solver*, main text, literally: the largest peak, then the adjacent smaller valley |
| a number | itself (`fixed`) |
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from liftcore.errors import InvalidQuery
from liftcore.query.question import Threshold

BINS = 300
SMOOTHING = BINS / 64  # bins, standard deviation of the Gaussian that removes a histogram's ripples
LEAST_SHARE = 3e-4  # of the scores: a smaller share above a threshold is noise (SAM drops masks this small)
LEAST_DEVIATIONS, LEAST_GAP = 3.0, 0.25  # of a valley's depth, and of the range: less may be one hill by chance
MOST_SHARE = 0.8  # queries that select four fifths of a scene are rare; .5 to .9 give equal results (docs/method.md)


@dataclass(frozen=True)
class Histogram:
    """Histogram of scores in equal bins between the lowest and the highest."""

    mass: np.ndarray  # [BINS] f64, sums to one
    low: float  # the left edge of the first bin
    width: float  # of a bin

    def edge(self, position: float) -> float:
        """Return the left edge of a bin; position + 0.5 gives its middle."""
        return self.low + position * self.width

    def smoothed(self) -> np.ndarray:
        """Return the mass after a Gaussian of SMOOTHING bins, mirrored at both ends, [BINS] f64."""
        reach = math.ceil(4 * SMOOTHING)
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SMOOTHING) ** 2)
        return np.convolve(np.pad(self.mass, reach, mode="symmetric"), weights / weights.sum(), mode="valid")

    def above(self) -> np.ndarray:
        """Return the share of the scores in each bin or above it, [BINS] f64."""
        return np.cumsum(self.mass[::-1])[::-1]


Result = tuple[float, str, bool]  # a threshold, its explanation, and True if the method has a clear result


def find_threshold(
    scores: ArrayLike, method: str | float = "auto", weights: ArrayLike | None = None, least: float = -math.inf
) -> Threshold:
    """Find a threshold on scores by one of the methods above.

    Degenerate inputs have a defined result. Without scores it is infinity: nothing is selected. Equal scores give
    that score: a query then selects nothing, or all (`explain_no_selection`).

    Args:
        scores: [n] f32, finite.
        method: auto or paper, or a number to use as it is.
        weights: [n] f32, weight of each score, at least zero: the total weight of splats; None: equal ones, as of the
            pixels of a view.
        least: ``auto`` takes no lower score, unless too few lie above it.
    """
    if isinstance(method, int | float):
        return Threshold(value=float(method), method="fixed", explanation=f"The threshold {method:.4g} was given.")
    values = np.asarray(scores, np.float32).ravel()
    if values.size == 0:
        sentence = "There are no scores: nothing can be found."
        return Threshold(value=math.inf, method=method, explanation=sentence, clear=False)
    low, high = float(values.min()), float(values.max())
    if not (math.isfinite(low) and math.isfinite(high)):
        raise InvalidQuery("scores", expected="finite values", got="NaN or infinity")
    histogram = _count(values, low, high, weights)
    if histogram is None:
        sentence = f"All scores are {low:.4g}: the histogram has no valley."
        return Threshold(value=low, method=method, explanation=sentence, clear=False)
    value, explanation, clear = steady(histogram, least) if method == "auto" else paper(histogram)
    value = min(max(value, low), high)
    above = np.append(histogram.above(), 0.0)
    share = float(np.interp((value - low) / histogram.width, np.arange(len(above)), above))
    sentence = f"{share:.1%} of the {'pixels' if weights is None else 'total weight'} at or above {value:.4g}"
    explanation = f"{explanation.removesuffix('.')}; {sentence}."
    return Threshold(value=value, method=method, explanation=explanation, clear=clear)


def explain_equal_scores(low: float, high: float) -> str:
    """Explain that scores from low to high select nothing as they differ in their last bits alone; "" if not so."""
    if (high - low) / BINS > 4 * np.spacing(np.float32(max(abs(low), abs(high)))):
        return ""
    return f"All scores are {high:.4g}: nothing stands apart, so nothing is selected."


def explain_no_selection(scores: np.ndarray) -> str:
    """Explain that scores [n] f32 of a query select nothing at any threshold, such as all zeros; "" if not so."""
    if not scores.size:
        return "There are no scores: nothing can be found."
    low, high = float(scores.min()), float(scores.max())
    if high == 0 and low < 0:
        return "No score is above zero: nothing is similar to the query, so nothing is selected."
    return explain_equal_scores(low, high)


def has_one_mode(scores: np.ndarray, value: float, weights: np.ndarray | None, count: float | None = None) -> bool:
    """Return True if no valley of the scores [n] f32 at a threshold is told from chance, and no wide gap lies there.

    The counts in the valley and in the hills on both sides are compared, each under the width of the smoothing.

    Args:
        weights: [n], of the scores; None: equal ones.
        count: of splats that have the scores; None: the effective one of the weights, ``(sum w)^2 / sum w^2``.
    """
    if count is None:
        count = len(scores) if weights is None else float(weights.sum() ** 2 / max(np.square(weights).sum(), 1e-30))
    low, high = float(scores.min()), float(scores.max())
    histogram = _count(scores, low, high, weights)
    if histogram is None:
        return True
    expected = histogram.smoothed() * count * 2 * math.sqrt(math.pi) * SMOOTHING
    place = min(int((value - low) / histogram.width), BINS - 1)
    left, right = int(expected[: place + 1].argmax()), place + int(expected[place:].argmax())
    hill, valley = min(expected[left], expected[right]), expected[left : right + 1].min()
    filled_bins = np.flatnonzero(histogram.mass)
    gap = filled_bins[filled_bins > place].min(initial=BINS) - filled_bins[filled_bins <= place].max(initial=0)
    return gap < LEAST_GAP * BINS and hill - valley < LEAST_DEVIATIONS * math.sqrt(hill + valley)


def _count(scores: np.ndarray, low: float, high: float, weights: ArrayLike | None) -> Histogram | None:
    """Return the histogram of scores; None if they differ in their last bits alone, or all weights are zero."""
    if explain_equal_scores(low, high):
        return None
    width = (high - low) / BINS
    places = np.minimum(((scores.astype(np.float64) - low) * (1.0 / width)).astype(np.int32), BINS - 1)
    shares = None if weights is None else np.asarray(weights).ravel()
    mass = np.bincount(places, shares, BINS).astype(np.float64)
    total = mass.sum()
    return Histogram(mass / total, low, width) if total > 0 else None


def steady(histogram: Histogram, least: float = -math.inf) -> Result:
    """Find the score at which the log-odds of the selected share fall least, at least ``least`` if enough lie above.

    Let ``S(t)`` be the share of the scores at or above t. As t rises across a hill of the histogram, S loses the
    hill's scores; between hills it loses few. The right valley need not be the deepest one: the hill of a small
    object has low valleys on both sides. So the slope of the share's log-odds is minimised, which measures a loss
    relative to the rest on either side:

        t* = argmin_t  -d/dt log(S / (1 - S)) = argmin_t  p(t) / (S(t) (1 - S(t)))

    with p the smoothed density. Inside a hill and in its tails the log-odds fall steeply, whatever the hill's size,
    and between two hills they are flat. Nothing is tuned: the smoothing removes ripples (half or twice of it changes
    little), and the least share keeps a few noisy scores from being an object.

    The log-odds are symmetric in a share and its rest. So with clean features the widest gap may separate one
    dissimilar object from all others. Thresholds that select at most MOST_SHARE come first; the others are tried if
    no hill lies above any of these, as when the target fills the scene.
    """
    density = histogram.smoothed()
    density = density / density.sum()
    density[density <= LEAST_SHARE / len(density)] = 0.0  # a few scores all over the range count as none
    above = np.cumsum(density[::-1])[::-1] - density / 2  # at the middles of the bins
    valid = np.minimum(above, 1 - above) >= LEAST_SHARE  # never all False: no smoothed bin has a fifth of all
    high = valid & (histogram.low + (np.arange(len(density)) + 0.5) * histogram.width >= least)
    floor = f"Above {least:g} the" if high.any() and not high[valid].all() else "The"
    valid = high if high.any() else valid
    slope = np.full(len(density), np.inf)
    slope[valid] = density[valid] / (above[valid] * (1 - above[valid]))
    for among in (valid & (above <= MOST_SHARE), valid):
        if not among.any():
            continue
        # Empty stretches tie at zero: the middle of the widest is farthest from both its sides.
        run = max(_runs(among & (slope <= slope[among].min() * (1 + 1e-9))), key=len)
        if run[0] > 0 and slope[run[0] - 1] < slope[run[0]]:
            continue  # it lies on the slope of a hill that reaches below MOST_SHARE
        place = int(run[0] + run[-1]) // 2
        value = histogram.edge(place + 0.5)
        sentence = f"{floor} share found changes least, in log-odds, around {value:.4g}"
        if density[place] < density[place:].max():
            return value, f"{sentence}.", True
    # Over a single hill the log-odds are flattest near its middle, which has no meaning.
    lack = "but no hill of the histogram lies above it: take it with care, or name a threshold"
    return value, f"{sentence}, {lack}.", False


def paper(histogram: Histogram) -> Result:
    """Find the largest peak, then the adjacent smaller valley above it; without one Otsu's split (Otsu 1979)."""
    smooth = histogram.smoothed()
    peak = int(smooth.argmax())
    rises = peak + np.flatnonzero(np.diff(smooth[peak:]) > 0)
    if rises.size:
        equal_bins = int((smooth[peak : rises[0] + 1][::-1] > smooth[rises[0]]).argmax())
        value = histogram.edge(int(rises[0]) - equal_bins // 2)  # the middle of a flat valley
        lies = f"lies at {histogram.edge(peak):.4g} and the next valley above it at {value:.4g}"
        return value, f"The histogram's largest peak {lies}.", True
    value = histogram.edge(_split(histogram.mass))
    lack = "no valley above its largest peak"
    return value, f"The histogram has {lack}; Otsu's split at {value:.4g} stands in.", False


def _split(mass: np.ndarray) -> int:
    """Return the bin k that maximises the variance between bins 0..k-1 and k.., 1 <= k < BINS."""
    centres = np.arange(len(mass)) + 0.5
    below, first = np.cumsum(mass)[:-1], np.cumsum(mass * centres)[:-1]
    total = float((mass * centres).sum())
    spread = below * (1 - below)
    # One score among very many leaves a side without mass, up to rounding: that is no split.
    between = np.where(spread > 0, (total * below - first) ** 2 / np.where(spread > 0, spread, 1.0), 0.0)
    # Empty bins between two groups tie: the middle of the best ones is farthest from both.
    best = np.flatnonzero(between >= between.max() * (1 - 1e-9))
    return int(best[len(best) // 2]) + 1


def _runs(mask: np.ndarray) -> list[np.ndarray]:
    """Return the indices of each run of True in [n] bool."""
    runs = np.split(np.arange(len(mask)), np.flatnonzero(np.diff(mask)) + 1)
    return [run for run in runs if mask[run[0]]]
