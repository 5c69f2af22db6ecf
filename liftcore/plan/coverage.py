"""Which views cover the splats, which add nothing new, and which to take when only some are.

A view's pull on a splat is its footprint's area there, as the sum of weights is about that. With ``s_jd`` the share
of splat j's area over all views that the chosen ones hold which look from the side d, views are chosen greedily for
the largest ``sum_jd sqrt(s_jd)``: the root makes the first views of a side count more than its last. Sides stand for
what is hidden: a footprint in the image may lie behind another, but some view from each side sees what can be seen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.plan.visibility import SIDES

if TYPE_CHECKING:
    from liftcore.plan.visibility import Visibility

WELL_COVERED = 8  # views that show a splat well enough to spare another one


def choose_views(seen: Visibility, times: int) -> list[int]:
    """Views, ascending, that show each splat ``times`` times in the mean; all views when not even they do.

    Splats that no view shows do not count. Of equal views the first is taken.
    """
    in_view = seen.in_view
    wanted = times * int(in_view.any(axis=0).sum())
    totals = seen.areas.sum(axis=0, dtype=np.float64)
    shares = np.divide(seen.areas, totals, out=np.zeros(seen.areas.shape, np.float32), where=totals > 0)
    held = np.zeros((shares.shape[1], SIDES), np.float32)
    every = np.arange(shares.shape[1])
    left = list(range(shares.shape[0]))
    chosen: list[int] = []
    while left and (not chosen or int(in_view[chosen].sum()) < wanted):
        best = left.pop(int(np.argmax([_gain(held[every, seen.sides[view]], shares[view]) for view in left])))
        held[every, seen.sides[best]] += shares[best]
        chosen.append(best)
    return sorted(chosen)


def _gain(held: np.ndarray, added: np.ndarray) -> float:
    return float((np.sqrt(held + added) - np.sqrt(held)).sum(dtype=np.float64))


def spare_views(seen: Visibility) -> list[int]:
    """Views that could all be left out together: every splat they show is shown by WELL_COVERED others that stay.

    They are looked for from the one that shows the fewest splats on.
    """
    in_view = seen.in_view
    times = in_view.sum(axis=0)
    spare = []
    for view in np.argsort(in_view.sum(axis=1), kind="stable"):
        own = in_view[view]
        if own.sum() == 0 or int(times[own].min()) > WELL_COVERED:
            spare.append(int(view))
            times = times - own
    return sorted(spare)
