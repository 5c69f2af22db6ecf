"""Where a score becomes a yes: thresholds from the scores alone.

No ground truth and no other phrase enters, and no count of instances unless the user gives one. All sizes are shares
of the scores, so that the resolution of a view does not matter, and all positions are shares of their range, so that
thresholds move with the scores: ``threshold(a s + b) = a threshold(s) + b`` for a > 0, up to rounding.

| method | the threshold | file |
|---|---|---|
| `auto` | where the share found changes least, in log-odds; not below ``least`` | `steady.py` |
| `valley` | the paper's appendix: from the top, the first local maximum, then the minimum before it | `valley.py` |
| `paper` | the paper's main text, literally: the largest peak, then the adjacent smaller valley | `valley.py` |
| `otsu` | the split with the largest variance between its sides | `otsu.py` |
| `stability` | the least sensitive stretch of a sweep (Occam's LGS) | `stability.py` |
| a number | itself (`fixed`) | |
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.errors import InvalidQuery
from liftcore.query.threshold.histogram import count
from liftcore.query.threshold.otsu import otsu
from liftcore.query.threshold.stability import stability
from liftcore.query.threshold.steady import steady
from liftcore.query.threshold.valley import paper, valley

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

    from liftcore.query.threshold.histogram import Histogram

METHODS: dict[str, Callable[[Histogram], tuple[float, str]]] = {
    "auto": steady,
    "valley": valley,
    "paper": paper,
    "otsu": otsu,
    "stability": stability,
}
MOST_INSTANCES = 100  # more hills than a histogram can show


@dataclass(frozen=True)
class Threshold:
    """A threshold and how it came about."""

    value: float  # scores at or above it answer the query
    method: str  # auto, valley, paper, otsu, stability or fixed
    explanation: str  # one sentence for the user


def check_method(method: str | float, instances: int | None = None) -> None:
    """Refuse a method that `find_threshold` does not know, before any work is done.

    Raises:
        InvalidQuery: an unknown method, a number that is not finite, or instances that no method can count.
    """
    if isinstance(method, int | float):
        if not math.isfinite(method):
            raise InvalidQuery("threshold", expected="a finite number", got=str(method))
    elif method not in METHODS:
        raise InvalidQuery("threshold", expected=f"a number or one of {', '.join(METHODS)}", got=repr(method))
    if instances is None:
        return
    if not 1 <= instances <= MOST_INSTANCES:
        raise InvalidQuery("instances", expected=f"1 to {MOST_INSTANCES}", got=str(instances))
    if method not in ("auto", "valley"):
        hint = "leave the threshold out, or the instances"
        raise InvalidQuery("instances", expected="threshold auto or valley", got=f"threshold {method}", hint=hint)


def find_threshold(
    scores: Tensor,
    method: str | float = "auto",
    weights: Tensor | None = None,
    instances: int | None = None,
    least: float = -math.inf,
) -> Threshold:
    """A threshold on scores by one of the methods above.

    Degenerate maps have a defined answer. No scores at all give infinity: nothing is found. Equal scores give
    that score: all of them answer alike. Scores without what a method looks for fall back to Otsu's split, and the
    explanation says so.

    Args:
        scores: [n] f32, finite.
        method: one of ``METHODS``, or a number to use as it is.
        weights: [n] f32, how much each score counts, at least zero: the evidence of splats; None = equally, as the
            pixels of a view do.
        instances: how many things the user says there are: the valley is then the one below as many hills, counted
            from the top. With it ``auto`` takes the valley. Only the user can know it; None = not said.
        least: ``auto`` takes no lower score, unless too few lie above it.

    Raises:
        InvalidQuery: what `check_method` refuses, or scores that are not finite.
    """
    check_method(method, instances)
    if isinstance(method, int | float):
        return Threshold(float(method), "fixed", f"The threshold {method:.4g} was given.")
    if scores.numel() == 0:
        return Threshold(math.inf, method, "There are no scores: nothing can be found.")
    low, high = (float(value) for value in torch.aminmax(scores))
    if not (math.isfinite(low) and math.isfinite(high)):
        raise InvalidQuery("scores", expected="finite values", got="NaN or infinity")
    histogram = count(scores, low, high, weights)
    if histogram is None:
        return Threshold(low, method, f"All scores are {low:.4g}: the histogram has no valley.")
    if instances is not None:
        value, explanation = valley(histogram, instances)
    else:
        value, explanation = steady(histogram, least) if method == "auto" else METHODS[method](histogram)
    value = min(max(value, low), high)
    share = f"{_share_above(histogram, value):.1%} of the {'pixels' if weights is None else 'evidence'}"
    return Threshold(value, method, f"{explanation.removesuffix('.')}; {share} at or above {value:.4g}.")


def _share_above(histogram: Histogram, value: float) -> float:
    """The share of the mass at or above a value, as if it lay evenly in each bin."""
    above = np.append(histogram.above(), 0.0)
    return float(np.interp((value - histogram.low) / histogram.width, np.arange(len(above)), above))
