"""Objects of an answer with their boxes: components of the graph of touching splats."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.question import Answer, Box, Objects, Point, SelectedObject
from liftcore.query.scene import Scene
from liftcore.query.selection import MOSTLY_SELECTED, PARTLY_SELECTED
from liftcore.query.terms import SplatSet
from liftcore.scene.touching import touching

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats
    from liftcore.scene.world import WorldFrame

LEAST_OBJECT_WEIGHT = 0.05  # of an object, as a share of the largest's
LEAST_OF_FRAGMENT = 0.25  # the same of a fragment of another object, and of a group in the box of one object
MOST_SPLATS = 1 << 20  # that are grouped: a million take seven seconds of two cores and a gigabyte
_TAIL = 1e-3  # of an object's total weight that its box leaves out at each end of each axis


def objects(scene: Scene, answer: Answer) -> Objects:
    """Group the selected splats of an answer into objects, once for an answer.

    An object is a group of touching splats (`touching`). A group with less than a twentieth of the total weight of
    the largest is unassigned: single splats and small groups anywhere in the scene whose scores happen to reach the
    threshold. So are groups of fewer splats than the query's ``min_size``. If the largest group is most of an object
    of the region graph, a group that is less than a third of another one needs a quarter: features leak from an
    object to what is behind it. A query with a number of instances has at most so many objects, those of the highest
    scores, and one that keeps the largest has one; all other splats are unassigned.

    Of a query of sets, each set is an object, and all of its splats are assigned; one of several sets to the first.

    Raises:
        InvalidQuery: more splats were selected than are grouped.
        InvalidLift: the splats moved or changed since the lift.
    """
    if answer._objects is None or answer._objects.world != scene.world:
        answer._objects = _grouped(scene, answer)
    return answer._objects


def _grouped(scene: Scene, answer: Answer) -> Objects:
    rows = np.flatnonzero(answer.selected)
    sets = answer.query.splat_sets
    if len(rows) > MOST_SPLATS and not sets:
        expected = f"at most {MOST_SPLATS:,} splats at or above it, to make objects of them"
        raise InvalidQuery("threshold", expected=expected, got=f"{len(rows):,}", hint="name a higher threshold")
    numbers = np.full(len(answer.scores), -1, np.int32)
    if not len(rows):
        return Objects.of((), numbers, 0, scene.world)
    weights = scene.weights_of(rows)
    groups = _set_numbers(scene, sets)[rows] if sets else touching(scene.splats, rows)
    sums = np.bincount(groups, weights)
    order = np.argsort(-sums, kind="stable")
    order = order[np.bincount(groups)[order] >= answer.query.min_size]
    object_groups = order if sets else _without_leaks(scene, rows, groups, sums, order)
    object_groups = object_groups[:1] if answer.query.keep == "largest" else object_groups
    if answer.query.instances is not None and len(object_groups) > answer.query.instances:
        scores = np.bincount(groups, weights * answer.scores[rows])[object_groups] / sums[object_groups]
        object_groups = object_groups[np.sort(np.argsort(-scores, kind="stable")[: answer.query.instances])]
    places = np.full(len(sums), -1, np.int32)
    places[object_groups] = np.arange(len(object_groups))
    numbers[rows] = places[groups]
    summaries = []
    for number in range(len(object_groups)):
        inside = numbers[rows] == number
        members, member_weights = rows[inside], scene.weights_of(rows[inside])
        box = (
            object_box(scene.splats, members, member_weights)
            if sets
            else trimmed_box(scene.splats.positions(members), member_weights)
        )
        summaries.append(
            SelectedObject(
                splats=int(inside.sum()),
                share=float(weights[inside].sum() / weights.sum()),
                score=float(np.average(answer.scores[members], weights=member_weights)),
                centre=point_of(np.mean([*box], axis=0)),
                box=box,
                size=size_of(scene.world, box),
            )
        )
    return Objects.of(summaries, numbers, int((numbers[rows] < 0).sum()), scene.world)


def _without_leaks(
    scene: Scene, rows: np.ndarray, groups: np.ndarray, sums: np.ndarray, order: np.ndarray
) -> np.ndarray:
    """Return the groups that are objects, of groups in order of their total weight.

    Args:
        rows: [n] i64, selected splats. groups: [n] i64, the group of each. sums: [g] f64, their total weight.
        order: [k] i64, groups, the largest first.
    """
    large = order[sums[order] >= LEAST_OBJECT_WEIGHT * sums.max()]
    small = sums[large] < LEAST_OF_FRAGMENT * sums.max()
    if scene.object is None or not small.any():
        return large
    labels = scene.object
    sizes = np.bincount(labels + 1)

    def counts_of(group: int) -> np.ndarray:
        """Count the splats of a group of no object and of each, [1 + objects] i64."""
        return np.bincount(labels[rows[groups == group]] + 1, minlength=len(sizes))

    def is_fragment(group: int) -> bool:
        """Return True for a group with too small a part of each object that it belongs to."""
        counts = counts_of(group)
        holds = (counts >= PARTLY_SELECTED * counts.sum()) & (counts >= PARTLY_SELECTED * sizes)
        return bool(counts.argmax()) and not holds[1:].any()

    first = counts_of(large[0])
    if not first.argmax() or first.max() < MOSTLY_SELECTED * sizes[first.argmax()]:
        return large
    return large[[not (few and is_fragment(group)) for group, few in zip(large, small, strict=True)]]


def _set_numbers(scene: Scene, sets: Sequence[SplatSet]) -> np.ndarray:
    """Return the index of the first set that contains a splat, [P] i32; -1 for none."""
    numbers = np.full(len(scene.features), -1, np.int32)
    for place, members in reversed(list(enumerate(sets))):
        numbers[scene.set_members(members)] = place
    return numbers


def object_box(splats: "Splats", rows: np.ndarray, weights: np.ndarray) -> Box:
    """Compute the box of one object: `trimmed_box` of its splats without `is_outlier`."""
    inside = ~is_outlier(splats, rows, weights)
    return trimmed_box(splats.positions(rows[inside]), weights[inside])


def is_outlier(splats: "Splats", rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the splats of an object that are apart from its large groups of touching splats, [n] bool.

    A group is large with a quarter of the weight of the largest one, such as each of two objects that were merged.

    Args:
        splats: the scene. rows: [n] i64, at least one; above MOST_SPLATS none is apart. weights: [n].
    """
    if len(rows) > MOST_SPLATS:
        return np.zeros(len(rows), np.bool_)
    groups = touching(splats, rows)
    sums = np.bincount(groups, weights)
    return (sums < LEAST_OF_FRAGMENT * sums.max())[groups]


def trimmed_box(means: np.ndarray, weights: np.ndarray) -> Box:
    """Compute the corners of a box that leaves out a thousandth of the weight at each end of each axis.

    Args:
        means: [n, 3] f32 or f64, at least one. weights: [n], at least zero.
    """
    corners = np.empty((2, 3))
    for axis in range(3):
        order = np.argsort(means[:, axis])
        sums = np.cumsum(weights[order])
        ends = np.searchsorted(sums, [_TAIL * sums[-1], (1 - _TAIL) * sums[-1]])
        corners[:, axis] = means[order[np.minimum(ends, len(order) - 1)], axis]
    return Box(point_of(corners[0]), point_of(corners[1]))


def size_of(world: "WorldFrame", box: Box) -> Point:
    """Return the sides of a box, in metres if the length of a unit is known, else in scene units."""
    return point_of(np.array([world.length(high - low) for low, high in zip(*box, strict=True)]))


def point_of(row: np.ndarray) -> Point:
    """Return a row [3] as a point."""
    x, y, z = row.tolist()
    return x, y, z
