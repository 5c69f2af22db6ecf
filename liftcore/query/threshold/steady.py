"""The automatic threshold: where the share found is steadiest.

Let ``S(t)`` be the share of the scores at or above t. Raising t past a hill of the histogram loses its scores,
between hills it loses hardly any. The valley wanted is not the deepest one: a small object's hill is low on both
sides. So the share's log-odds are watched, which count a loss against what is left on either side:

    t* = argmin_t  -d/dt log(S / (1 - S)) = argmin_t  p(t) / (S(t) (1 - S(t)))

with p the smoothed density. Inside a hill and in its tails the log-odds fall steeply, whatever the hill's size, and
between two hills they lie flat. Nothing is tuned: the smoothing takes away ripples (half of it or twice it changes
little), and the least share keeps stray scores from being an object.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.query.threshold.histogram import LEAST_SHARE, longest_run

if TYPE_CHECKING:
    from liftcore.query.threshold.histogram import Histogram


def steady(histogram: Histogram, least: float = -np.inf) -> tuple[float, str]:
    """The score at which the log-odds of the share found fall least, and a sentence about it.

    Args:
        histogram: of the scores.
        least: no lower score is taken, unless too few lie above it.
    """
    density = histogram.smoothed()
    density = density / density.sum()
    above = np.cumsum(density[::-1])[::-1] - density / 2  # at the middles of the bins
    counted = np.minimum(above, 1 - above) >= LEAST_SHARE  # some are: no smoothed bin has more than a fifth of all
    high = counted & (histogram.edge(np.arange(len(density)) + 0.5) >= least)
    floor = f"Above {least:g} the" if high.any() and not high[counted].all() else "The"
    counted = high if high.any() else counted
    slope = np.full(len(density), np.inf)
    slope[counted] = density[counted] / (above[counted] * (1 - above[counted]))
    # Empty stretches tie at zero: the middle of the widest keeps clear of both its sides.
    run = longest_run(slope <= slope.min() * (1 + 1e-9))
    assert run is not None
    place = sum(run) // 2
    value = histogram.edge(place + 0.5)
    found = f"{floor} share found changes least, in log-odds, around {value:.4g}"
    if density[place] < density[place:].max():
        return value, f"{found}."
    # Over one hill the log-odds are steadiest near its middle, which means nothing.
    return value, f"{found}, but no hill of the histogram lies above it: take it with care, or name a threshold."
