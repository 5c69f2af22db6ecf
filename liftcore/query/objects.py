"""How many things an answer found, and where each lies: components of the graph in which splats touch."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.scene import QueryScene, as_numpy
from liftcore.raster.base import MAX_LOG_SCALE
from liftcore.scene.quaternions import rotation_matrices

if TYPE_CHECKING:
    from liftcore.query.ask import Answer, Point
    from liftcore.scene.splats import Splats

LEAST_EVIDENCE = 0.05  # of an object, as a share of the largest's
MOST_SPLATS = 1 << 20  # that are grouped: a million take seven seconds of two cores and a gigabyte
NEIGHBOURS = 16  # that each splat looks at, the nearest by their centres
REACH = 2.0  # standard deviations to which a splat touches
_TAIL = 1e-3  # of an object's evidence that its box leaves out at each end of each axis
_PIECE = 1 << 12  # splats whose neighbours are looked at at once: what is made of them stays in the cache
_TOLD_APART = 1e-12  # of the farthest coordinate


@dataclass(frozen=True)
class FoundObject:
    """Selected splats that hang together."""

    splats: int  # how many
    share: float  # of the evidence of all selected splats
    score: float  # the mean of its splats' scores, by their evidence
    centre: "Point"  # the middle of its box, world frame, scene units
    box: "tuple[Point, Point]"  # least and greatest corner of the splats' centres, but for a thousandth at each end


@dataclass(frozen=True)
class Objects:
    """What an answer found, thing by thing."""

    found: tuple[FoundObject, ...]  # those with the most evidence first
    numbers: np.ndarray  # [P] i32, the place in ``found`` of each splat's object; -1 for none
    strays: int  # selected splats that belong to none


def objects(scene: QueryScene, answer: "Answer") -> Objects:
    """Group the selected splats of an answer into the things that they make up.

    Things are splats that touch (`touching`). What has less than a twentieth of the evidence of the largest is no
    thing but strays: single splats and specks whose scores happen to reach the threshold, anywhere in the scene. A
    query that knows how many instances there are has so many objects at most, those of the highest scores, and one
    that keeps the largest has one; all else are strays.

    Raises:
        InvalidQuery: more splats were selected than are grouped.
        InvalidLift: the splats moved or changed since the lift.
    """
    rows = np.flatnonzero(answer.selected)
    if len(rows) > MOST_SPLATS:
        expected = f"at most {MOST_SPLATS:,} splats at or above it, to make objects of them"
        raise InvalidQuery("threshold", expected=expected, got=f"{len(rows):,}", hint="name a higher threshold")
    numbers = np.full(len(answer.scores), -1, np.int32)
    if not len(rows):
        return Objects((), numbers, 0)
    evidence = scene.evidence[rows].astype(np.float64)
    weights = evidence if evidence.any() else np.ones(len(rows))
    groups = touching(scene.splats, rows)
    sums = np.bincount(groups, weights)
    order = np.argsort(-sums, kind="stable")
    kept = order[: 1 if answer.query.keep == "largest" else int((sums >= LEAST_EVIDENCE * sums.max()).sum())]
    if answer.query.instances is not None and len(kept) > answer.query.instances:
        scores = np.bincount(groups, weights * answer.scores[rows])[kept] / sums[kept]
        kept = kept[np.sort(np.argsort(-scores, kind="stable")[: answer.query.instances])]
    places = np.full(len(sums), -1, np.int32)
    places[kept] = np.arange(len(kept))
    numbers[rows] = places[groups]
    means, found = as_numpy(scene.splats.means), []
    for number in range(len(kept)):
        inside = numbers[rows] == number
        box = trimmed_box(means[rows[inside]], weights[inside])
        found.append(
            FoundObject(
                splats=int(inside.sum()),
                share=float(weights[inside].sum() / weights.sum()),
                score=float(np.average(answer.scores[rows[inside]], weights=weights[inside])),
                centre=_point(np.mean(box, axis=0)),
                box=box,
            )
        )
    return Objects(tuple(found), numbers, int((numbers[rows] < 0).sum()))


def touching(splats: "Splats", rows: np.ndarray) -> np.ndarray:
    """Put splats that touch, directly or through others, into one group.

    Two splats touch where ``|m_j - m_k| <= 2 (s_j + s_k)``, with s the standard deviation of each along the line
    between their centres, ``sqrt(d^T Sigma d)``: a rule without a length of its own, as scenes have no common unit.
    Each looks at its 16 nearest among the rows.

    Args:
        splats: the scene. rows: [n] i64, the splats to group; the others do not connect.

    Returns:
        [n] i32, the number of each row's group, from 0 in the order of their first rows.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    count = len(rows)
    if count < 2:
        return np.zeros(count, np.int32)
    means = as_numpy(splats.means)[rows].astype(np.float64)
    shapes = np.concatenate([means, _covariances(splats, rows)], axis=1)
    # Points at one place make a leaf that no search can divide: told apart by less than float32 can, they are.
    extent = float(np.abs(means).max()) or 1.0
    places = means + _TOLD_APART * extent * np.random.default_rng(0).random(means.shape)
    tree = KDTree(places)
    order = tree.indices  # leaf by leaf: splats that are looked at one after the other have the same neighbours

    def look(first: int) -> tuple[np.ndarray, np.ndarray]:
        own = order[first : first + _PIECE]
        near = np.asarray(tree.query(places[own], min(NEIGHBOURS + 1, count))[1])  # itself among them
        touch = _touch(shapes[own], shapes[near])
        return np.repeat(own, touch.sum(axis=1)), near[touch]

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        looks = list(pool.map(look, range(0, count, _PIECE)))
    pairs = tuple(np.concatenate(parts) for parts in zip(*looks, strict=True))
    graph = csr_array((np.ones(len(pairs[0]), np.int8), pairs), shape=(count, count))
    return connected_components(graph, directed=True, connection="weak")[1]


def _touch(own: np.ndarray, near: np.ndarray) -> np.ndarray:
    """[m, k] bool, which of its neighbours ``near`` [m, k, 9] each splat of ``own`` [m, 9] touches; centre, Sigma."""
    own = own[:, None]
    x, y, z = (near[..., axis] - own[..., axis] for axis in range(3))
    squares = (x * x, y * y, z * z, x * y, x * z, y * z)
    # s |d| of both sides, so that nothing is divided by a distance of zero.
    mine, theirs = np.zeros(x.shape), np.zeros(x.shape)
    for place, square in enumerate(squares, start=3):
        mine += own[..., place] * square
        theirs += near[..., place] * square
    reach = REACH * (np.sqrt(np.maximum(mine, 0.0)) + np.sqrt(np.maximum(theirs, 0.0)))
    return squares[0] + squares[1] + squares[2] <= reach


def _covariances(splats: "Splats", rows: np.ndarray) -> np.ndarray:
    """[n, 6] f64, Sigma of each splat: xx, yy, zz, and twice xy, xz, yz."""
    scales = np.exp(as_numpy(splats.log_scales)[rows].astype(np.float64).clip(-MAX_LOG_SCALE, MAX_LOG_SCALE))
    turned = rotation_matrices(as_numpy(splats.quats)[rows])[:, :, : scales.shape[1]]  # a disc has two axes
    x, y, z = (turned * scales[:, None]).transpose(1, 2, 0)
    products = (x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z)
    return np.stack([product.sum(axis=0) for product in products], axis=1)


def largest_box(splats: "Splats", rows: np.ndarray, weights: np.ndarray) -> "tuple[Point, Point]":
    """The box of one thing without its strays: `trimmed_box` of the group of touching splats with the most weight.

    Args:
        splats: the scene. rows: [n] i64, at least one; more than are grouped have the box of all. weights: [n].
    """
    means = as_numpy(splats.means)[rows]
    if len(rows) > MOST_SPLATS:
        return trimmed_box(means, weights)
    groups = touching(splats, rows)
    inside = groups == np.bincount(groups, weights).argmax()
    return trimmed_box(means[inside], weights[inside])


def trimmed_box(means: np.ndarray, weights: np.ndarray) -> "tuple[Point, Point]":
    """The corners between which all but a thousandth of the weight at each end lies, axis by axis.

    Args:
        means: [n, 3] f32, at least one. weights: [n], at least zero.
    """
    corners = np.empty((2, 3))
    for axis in range(3):
        order = np.argsort(means[:, axis])
        sums = np.cumsum(weights[order])
        ends = np.searchsorted(sums, [_TAIL * sums[-1], (1 - _TAIL) * sums[-1]])
        corners[:, axis] = means[order[np.minimum(ends, len(order) - 1)], axis]
    return _point(corners[0]), _point(corners[1])


def _point(row: np.ndarray) -> "Point":
    x, y, z = row.tolist()
    return x, y, z
