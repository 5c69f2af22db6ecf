"""How many things an answer found, and where each lies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.touching import touching

if TYPE_CHECKING:
    from liftcore.query.ask import Answer, Point
    from liftcore.query.scene import QueryScene

LEAST_EVIDENCE = 0.05  # of an object, as a share of the largest's
MOST_SPLATS = 1 << 20  # that are grouped: a million take seven seconds of two cores and a gigabyte
_TAIL = 1e-3  # of an object's evidence that its box leaves out at each end of each axis


@dataclass(frozen=True)
class FoundObject:
    """Selected splats that hang together."""

    splats: int  # how many
    share: float  # of the evidence of all selected splats
    score: float  # the mean of its splats' scores, by their evidence
    centre: Point  # the middle of its box, world frame, scene units
    box: tuple[Point, Point]  # least and greatest corner of the splats' centres, but for a thousandth at each end


@dataclass(frozen=True)
class Objects:
    """What an answer found, thing by thing."""

    found: tuple[FoundObject, ...]  # those with the most evidence first
    numbers: np.ndarray  # [P] i32, the place in ``found`` of each splat's object; -1 for none
    strays: int  # selected splats that belong to none


def objects(scene: QueryScene, answer: Answer) -> Objects:
    """Group the selected splats of an answer into the things that they make up.

    Things are splats that touch (`touching`). What has less than a twentieth of the evidence of the largest is no
    thing but strays: single splats and specks whose scores happen to reach the threshold, anywhere in the scene. A
    query that keeps the largest has one object, and all else are strays.

    Raises:
        InvalidQuery: more splats were selected than are grouped.
        InvalidLift: the splats moved or changed since the lift.
    """
    rows = np.flatnonzero(answer.selected.numpy())
    if len(rows) > MOST_SPLATS:
        raise InvalidQuery(
            "threshold",
            expected=f"at most {MOST_SPLATS:,} splats at or above it, to make objects of them",
            got=f"{len(rows):,}",
            hint="name a higher threshold",
        )
    numbers = np.full(len(answer.scores), -1, np.int32)
    if not len(rows):
        return Objects((), numbers, 0)
    evidence = scene.lift.evidence.numpy()[rows].astype(np.float64)
    weights = evidence if evidence.any() else np.ones(len(rows))
    groups = touching(scene.splats, rows)
    sums = np.bincount(groups, weights)
    order = np.argsort(-sums, kind="stable")
    large = 1 if answer.query.keep == "largest" else int((sums >= LEAST_EVIDENCE * sums.max()).sum())
    places = np.full(len(sums), -1, np.int32)
    places[order[:large]] = np.arange(large)
    numbers[rows] = places[groups]
    means, scores = scene.splats.means.numpy(), answer.scores.numpy()
    found = []
    for number in range(large):
        inside = numbers[rows] == number
        low, high = _box(means[rows[inside]], weights[inside])
        found.append(
            FoundObject(
                splats=int(inside.sum()),
                share=float(weights[inside].sum() / weights.sum()),
                score=float(np.average(scores[rows[inside]], weights=weights[inside])),
                centre=_point((low + high) / 2),
                box=(_point(low), _point(high)),
            )
        )
    return Objects(tuple(found), numbers, int((numbers[rows] < 0).sum()))


def _box(means: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[3], [3] f64, between what a thousandth of the weight lies below and above, axis by axis."""
    corners = np.empty((2, 3))
    for axis in range(3):
        order = np.argsort(means[:, axis])
        sums = np.cumsum(weights[order])
        ends = np.searchsorted(sums, [_TAIL * sums[-1], (1 - _TAIL) * sums[-1]])
        corners[:, axis] = means[order[np.minimum(ends, len(order) - 1)], axis]
    return corners[0], corners[1]


def _point(row: np.ndarray) -> Point:
    x, y, z = row.tolist()
    return x, y, z
