"""The paper's thresholds: a valley of the histogram, as its appendix and as its main text describe it.

The paper gives no numbers for the smoothing, the least hill and the depth of a valley: these were tuned on the masks
of one scene (tabletop with its hard features), and other scenes and features get less from them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.query.threshold.histogram import LEAST_SHARE, extrema
from liftcore.query.threshold.otsu import stand_in

if TYPE_CHECKING:
    from liftcore.query.threshold.histogram import Histogram

DEPTH = 0.6  # a valley must fall to this share of its peak, else it is a ripple


def valley(histogram: Histogram, instances: int = 1) -> tuple[float, str]:
    """From the top down, the first hill, or the one that makes it ``instances``, then the valley before it.

    The paper's code counts the instances in the ground truth; here the user may, else it is one. Where there are
    fewer hills, the lowest one is taken.
    """
    hills = _hills(histogram, instances)
    if not hills:
        return stand_in(histogram, "no hill with a valley before it")
    peak, place = hills[-1]
    value = histogram.edge(place)
    which = "first hill" if instances == 1 else f"hill {len(hills)}"
    lack = "" if len(hills) == instances else f" (there are no {instances})"
    return value, (
        f"From the top down, the histogram's {which}{lack} lies at {histogram.edge(peak):.4g} and the valley "
        f"before it at {value:.4g}."
    )


def paper(histogram: Histogram) -> tuple[float, str]:
    """The largest peak, then the adjacent smaller valley above it."""
    smooth = histogram.smoothed()
    peaks, valleys = extrema(smooth)
    peak = max(peaks, key=lambda place: smooth[place])
    for place in valleys:
        if place > peak and smooth[place] < smooth[peak]:
            value = histogram.edge(place)
            return value, (
                f"The histogram's largest peak lies at {histogram.edge(peak):.4g} and the next valley above "
                f"it at {value:.4g}."
            )
    return stand_in(histogram, "no valley above its largest peak")


def _hills(histogram: Histogram, most: int) -> list[tuple[int, int]]:
    """At most so many hills with the valley before each, from the top down: what is deep and large enough."""
    smooth, above = histogram.smoothed(), histogram.above()
    peaks, valleys = extrema(smooth)
    hills: list[tuple[int, int]] = []
    for peak in reversed(peaks):
        place = max((place for place in valleys if place < peak), default=None)
        if place is None or len(hills) == most:
            break
        if above[place] >= LEAST_SHARE and smooth[place] <= DEPTH * smooth[peak]:
            hills.append((peak, place))
    return hills
