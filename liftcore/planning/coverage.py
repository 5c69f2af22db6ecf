"""Which views cover the splats, which add nothing new, and which to take when only some are.

A view's pull on a splat is its footprint's area there, as the sum of weights is about that. With ``s_jd`` the share
of splat j's area over all views that the chosen ones hold which look from the side d, views are chosen greedily for
the largest ``sum_jd sqrt(s_jd)``: the root makes the first views of a side count more than its last. Sides stand for
what is hidden: a footprint in the image may lie behind another, but some view from each side sees what can be seen.

The gain of a view only shrinks as others are chosen. So gains are looked at lazily, from the largest that was ever
found on: of 300 views a choice asks for the gain of a few, over ORDER_SPLATS splats.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from liftcore.planning.visibility import Visibility

ORDER_SPLATS = 4_096  # at most: 300 views are in order after .3 s, where 16,384 take 1 s
SIDES = 24  # directions that a splat is looked at from: the three of each octant
WELL_COVERED = 8  # views that show a splat well enough to spare another one


def view_order(seen: Visibility) -> Iterator[int]:
    """All views, the one that covers most first, then the one that adds most to it, and so on.

    Of equal views the first is taken.
    """
    step = -(-seen.areas.shape[1] // ORDER_SPLATS)
    areas, means = seen.areas[:, ::step], seen.means[::step]
    totals = areas.sum(axis=0, dtype=np.float64)
    shares = np.divide(areas, totals, out=np.zeros(areas.shape, np.float32), where=totals > 0)
    shown = [np.flatnonzero(row) for row in shares]
    added = [row[own] for row, own in zip(shares, shown, strict=True)]
    places = [SIDES * own + side_of(centre - means[own]) for centre, own in zip(seen.centres, shown, strict=True)]
    held, roots = np.zeros((2, len(means) * SIDES), np.float32)

    def gain(view: int) -> float:
        before = places[view]
        return float((np.sqrt(held[before] + added[view]) - roots[before]).sum(dtype=np.float64))

    queue = [(-gain(view), view) for view in range(len(shown))]
    heapq.heapify(queue)
    while queue:
        _, view = queue[0]
        now = (-gain(view), view)
        if len(queue) > 1 and now > min(queue[1:3]):
            heapq.heapreplace(queue, now)
            continue
        heapq.heappop(queue)
        held[places[view]] += added[view]
        roots[places[view]] = np.sqrt(held[places[view]])
        yield view


def side_of(directions: np.ndarray) -> np.ndarray:
    """Directions [n, 3] -> [n] i64, below SIDES: the octant, and the longest component in it."""
    octants = (directions > 0) @ np.array([1, 2, 4])
    return 3 * octants + np.abs(directions).argmax(axis=1)


def views_to_show(seen: Visibility, order: Sequence[int], times: int) -> int:
    """How many views of the order, one at least, show each splat ``times`` times in the mean.

    All of them, when not even they do. Splats that no view shows do not count.
    """
    in_view = seen.in_view
    wanted = times * int(in_view.any(axis=0).sum())
    held = in_view.sum(axis=1)[list(order)].cumsum()
    return min(len(order), int(np.searchsorted(held, wanted)) + 1)


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
