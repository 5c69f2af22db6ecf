"""How many things an answer found, and where each lies: components of the graph in which splats touch."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.opened import OpenedLift
from liftcore.query.question import Answer, Box, FoundObject, Objects, Point
from liftcore.query.selection import MOSTLY_SELECTED, PARTLY_SELECTED
from liftcore.query.terms import SplatSet
from liftcore.scene.touching import touching

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats
    from liftcore.scene.world import WorldFrame

LEAST_EVIDENCE = 0.05  # of an object, as a share of the largest's
LEAST_OF_FRAGMENT = 0.25  # the same of a fragment of another thing, where the largest is a thing itself, and in one
MOST_SPLATS = 1 << 20  # that are grouped: a million take seven seconds of two cores and a gigabyte
_TAIL = 1e-3  # of an object's evidence that its box leaves out at each end of each axis


def objects(scene: OpenedLift, answer: Answer) -> Objects:
    """Group the selected splats of an answer into the things that they make up.

    Things are splats that touch (`touching`). What has less than a twentieth of the evidence of the largest is no
    thing but strays: single splats and specks whose scores happen to reach the threshold, anywhere in the scene. So
    are groups of fewer splats than the query's ``min_size``. Where the largest is most of a thing of the region
    graph, a group that is less than a third of another one needs a quarter: features leak from a thing to what stands
    behind it. A query that knows how many instances there are has so many objects at most, those of the highest
    scores, and one that keeps the largest has one; all else are strays.

    Of a query of sets each set is a thing, and none of its splats is a stray; one of several sets is of the first.

    Raises:
        InvalidQuery: more splats were selected than are grouped.
        InvalidLift: the splats moved or changed since the lift.
    """
    rows = np.flatnonzero(answer.selected)
    sets = answer.query.splat_sets
    if len(rows) > MOST_SPLATS and not sets:
        expected = f"at most {MOST_SPLATS:,} splats at or above it, to make objects of them"
        raise InvalidQuery("threshold", expected=expected, got=f"{len(rows):,}", hint="name a higher threshold")
    numbers = np.full(len(answer.scores), -1, np.int32)
    if not len(rows):
        return Objects.of((), numbers, 0, scene.world)
    weights = scene.splat_weights(answer.query.weigh)[rows].astype(np.float64)
    weights = weights if weights.any() else np.ones(len(rows))
    groups = _set_numbers(scene, sets)[rows] if sets else touching(scene.splats, rows)
    sums = np.bincount(groups, weights)
    order = np.argsort(-sums, kind="stable")
    order = order[np.bincount(groups)[order] >= answer.query.min_size]
    kept = order if sets else _without_leaks(scene, rows, groups, sums, order)
    kept = kept[:1] if answer.query.keep == "largest" else kept
    if answer.query.instances is not None and len(kept) > answer.query.instances:
        scores = np.bincount(groups, weights * answer.scores[rows])[kept] / sums[kept]
        kept = kept[np.sort(np.argsort(-scores, kind="stable")[: answer.query.instances])]
    places = np.full(len(sums), -1, np.int32)
    places[kept] = np.arange(len(kept))
    numbers[rows] = places[groups]
    found = []
    for number in range(len(kept)):
        inside = numbers[rows] == number
        own, mine = rows[inside], weights[inside]
        mine = mine if mine.any() else np.ones(len(own))
        box = object_box(scene.splats, own, mine) if sets else trimmed_box(scene.splats.positions(own), mine)
        found.append(
            FoundObject(
                splats=int(inside.sum()),
                share=float(weights[inside].sum() / weights.sum()),
                score=float(np.average(answer.scores[own], weights=mine)),
                centre=_point(np.mean(box, axis=0)),
                box=box,
                size=size_of(scene.world, box),
            )
        )
    return Objects.of(found, numbers, int((numbers[rows] < 0).sum()), scene.world)


def _without_leaks(
    scene: OpenedLift, rows: np.ndarray, groups: np.ndarray, sums: np.ndarray, order: np.ndarray
) -> np.ndarray:
    """The groups that are objects, of those in order of their evidence.

    Args:
        rows: [n] i64, selected splats. groups: [n] i64, the group of each. sums: [g] f64, their evidence.
        order: [k] i64, groups, the largest first.
    """
    large = order[sums[order] >= LEAST_EVIDENCE * sums.max()]
    small = sums[large] < LEAST_OF_FRAGMENT * sums.max()
    if scene.object is None or not small.any():
        return large
    own = scene.object
    sizes = np.bincount(own + 1)

    def counts_of(group: int) -> np.ndarray:
        """[1 + objects] i64, how many splats of a group are of no thing, and of each."""
        return np.bincount(own[rows[groups == group]] + 1, minlength=len(sizes))

    def is_fragment(group: int) -> bool:
        """True of a group with too little of each thing that it is of; what leaks beside one does not hide it."""
        counts = counts_of(group)
        holds = (counts >= PARTLY_SELECTED * counts.sum()) & (counts >= PARTLY_SELECTED * sizes)
        return bool(counts.argmax()) and not holds[1:].any()

    first = counts_of(large[0])
    if not first.argmax() or first.max() < MOSTLY_SELECTED * sizes[first.argmax()]:
        return large
    return large[[not (few and is_fragment(group)) for group, few in zip(large, small, strict=True)]]


def _set_numbers(scene: OpenedLift, sets: Sequence[SplatSet]) -> np.ndarray:
    """[P] i32, the place of the first set that holds a splat; -1 of none."""
    from liftcore.query.selections import set_members

    numbers = np.full(len(scene.features), -1, np.int32)
    for place, one in reversed(list(enumerate(sets))):
        numbers[set_members(scene, one)] = place
    return numbers


def object_box(splats: "Splats", rows: np.ndarray, weights: np.ndarray) -> Box:
    """The box of one thing without its strays: `trimmed_box` of its large groups of touching splats.

    A group is large with a quarter of the weight of the largest one, as each side of two things that were joined.

    Args:
        splats: the scene. rows: [n] i64, at least one; more than are grouped have the box of all. weights: [n].
    """
    means = splats.positions(rows)
    if len(rows) > MOST_SPLATS:
        return trimmed_box(means, weights)
    groups = touching(splats, rows)
    sums = np.bincount(groups, weights)
    inside = (sums >= LEAST_OF_FRAGMENT * sums.max())[groups]
    return trimmed_box(means[inside], weights[inside])


def trimmed_box(means: np.ndarray, weights: np.ndarray) -> Box:
    """The corners between which all but a thousandth of the weight at each end lies, axis by axis.

    Args:
        means: [n, 3] f32 or f64, at least one. weights: [n], at least zero.
    """
    corners = np.empty((2, 3))
    for axis in range(3):
        order = np.argsort(means[:, axis])
        sums = np.cumsum(weights[order])
        ends = np.searchsorted(sums, [_TAIL * sums[-1], (1 - _TAIL) * sums[-1]])
        corners[:, axis] = means[order[np.minimum(ends, len(order) - 1)], axis]
    return Box(_point(corners[0]), _point(corners[1]))


def size_of(world: "WorldFrame", box: Box) -> Point:
    """The sides of a box, in metres where it is known how long these are."""
    return _point(np.array([world.length(high - low) for low, high in zip(*box, strict=True)]))


def _point(row: np.ndarray) -> Point:
    x, y, z = row.tolist()
    return x, y, z
