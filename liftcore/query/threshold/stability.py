"""A sweep for the threshold at which the mask is least sensitive, after the evaluation of Occam's LGS.

As there: the scores are stretched to 0..1, thresholds run in steps of 0.01, the slope of the share found passes a
median filter of five, and stable are slopes below 0.4 with a share of 0.005 to 0.9, over five steps at least.
Different here: the released code compares label levels and takes the least sensitive one. We have one map, so the
least sensitive stable stretch of the sweep counts, and its middle is the threshold.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.query.threshold.otsu import stand_in

if TYPE_CHECKING:
    from liftcore.query.threshold.histogram import Histogram

STEPS = 100
MOST_SLOPE = 0.4  # of the share found, over a stretch of the scores to 0..1
SHARES = (0.005, 0.9)
FILTER = 5  # steps
LEAST_STEPS = 5


def stability(histogram: Histogram) -> tuple[float, str]:
    """The middle of the sweep's least sensitive stable stretch, and a sentence about it."""
    every = len(histogram.mass) // STEPS
    shares = histogram.above()[every::every]  # at thresholds 0.01..0.99 of the range
    around = np.pad(np.abs(np.gradient(shares, 1 / STEPS)), FILTER // 2, mode="edge")
    slopes = np.median(np.lib.stride_tricks.sliding_window_view(around, FILTER), axis=1)
    stable = (slopes < MOST_SLOPE) & (shares >= SHARES[0]) & (shares <= SHARES[1])
    stretches = [
        run for run in np.split(np.arange(len(stable)), np.flatnonzero(np.diff(stable)) + 1)
        if stable[run[0]] and len(run) >= LEAST_STEPS
    ]  # fmt: skip
    if not stretches:
        return stand_in(histogram, "no stretch over which the share found is stable")
    run = min(stretches, key=lambda run: float(slopes[run].mean()))
    first, last = (histogram.edge((place + 1) * every) for place in (run[0], run[-1]))
    value = (first + last) / 2
    return value, f"The share found is stable from {first:.4g} to {last:.4g}, and its middle is taken."
