"""How things lie to each other, in plain geometry of their splats: no model, and the numbers that it comes from.

Of thing a and thing b, with heights along ``up`` and the ground at right angles to it, all without outliers
(`liftcore.query.objects.trimmed_box`):

| relation | when |
|---|---|
| a is touching b | two of their splats touch (`touching`) |
| a is inside b | its splats lie in b's box, and b lies in AROUND of the directions from its middle |
| a is on b | b lies below COVERED of its footprint, and it touches b or begins NEAR above |
| b is under a | a is on it, or begins higher above it |
| a is beside b | their heights overlap by half, and on the ground they are less apart than the smaller is wide |

``gap`` is between the nearest centres; of on and under between heights, of beside on the ground. ``overlap`` is the
share of a's splats in b's box, of its footprint above b, or of heights.

Where it is not known which way is up (`liftcore.scene.world`, or `upright` of cameras), on, under and beside are not
told. Gaps are in metres where it is known how long a unit is, else in scene units.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.objects import trimmed_box
from liftcore.query.question import Point, Relation
from liftcore.scene.touching import touch_pairwise
from liftcore.scene.world import UNKNOWN, WorldFrame

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

NEAR = 0.15  # of its own height: what stands on something sinks in, or floats, by less
AROUND = 0.66  # of all directions, in which what surrounds a thing lies: a bowl has nothing above, a wall before it
DIRECTIONS = 128  # evenly over the sphere
NEARLY = 0.966  # cosine, 15 degrees, of which a wall is seen in 0.63 of all directions
WITHIN = 0.9  # of a thing's splats, in the box of what it is inside of
COVERED = 0.3  # of a thing's footprint, above what it stands on: a chair stands on four small places
MOST_THINGS = 64
MOST_SPLATS = 1 << 16  # of a thing that are looked at, evenly chosen
CELLS = 16  # of a footprint's side
PAIRS = 256  # of nearest splats, of which one must touch
LEVELLED = 0.002  # of each camera's weight, that its right axis does not take from up: of cameras that all look alike
LEAST_UPRIGHT = 0.5  # mean cosine of the cameras' own up with that of all: less, and photos lie on their sides


@dataclass(frozen=True)
class _Thing:
    rows: np.ndarray  # [n] i64
    places: np.ndarray  # [n, 3] f64, the third along up
    low: np.ndarray  # [3]
    high: np.ndarray

    @property
    def size(self) -> np.ndarray:
        return self.high - self.low


def relations(
    splats: Splats, members: Sequence[np.ndarray], weights: np.ndarray, world: WorldFrame = UNKNOWN
) -> tuple[Relation, ...]:
    """The relations of some things, by their places among ``members``.

    Args:
        splats: the scene. members: rows [n] i64 of the splats of each, the largest things first; the first
            MOST_THINGS are looked at. weights: [P], how much each splat counts.
        world: which way is up and how long a unit is, as far as it is known.
    """
    turn = _turn(world.up)
    things = [_thing(splats, rows, weights, turn) for rows in members[:MOST_THINGS]]
    found = list[Relation]()
    for a, b in combinations(range(len(things)), 2):
        if len(things[a].rows) and len(things[b].rows):
            found += _of_pair(splats, a, b, things[a], things[b], known=world.up is not None)
    return tuple(one.model_copy(update={"gap": world.length(one.gap)}) for one in found)


def upright(cameras: Iterable[Camera]) -> Point:
    """Which way is up where photos were taken upright, unit, in the frame of the splats.

    Cameras look down or up at things and are seldom rolled: it is the mean of their own up without what lies along
    their right axes.

    Raises:
        InvalidQuery: the cameras have no up in common.
    """
    poses = np.stack([camera.viewmat[:3, :3] for camera in cameras])
    right, own = poses[:, 0], -poses[:, 1]
    axis = np.linalg.solve(right.T @ right + LEVELLED * len(poses) * np.eye(3), own.sum(axis=0))
    axis /= max(float(np.linalg.norm(axis)), 1e-30)
    common = float((own @ axis).mean())
    if common < LEAST_UPRIGHT:
        expected, hint = "cameras that are upright", "give x,y,z, the direction against gravity"
        got = f"a mean cosine of {common:.2f} to one direction"
        raise InvalidQuery("up", expected=expected, got=got, hint=hint)
    x, y, z = axis.tolist()
    return x, y, z


def _turn(up: Point | None) -> np.ndarray:
    """[3, 3], rows are two directions on the ground and up."""
    if up is None:
        return np.eye(3)
    axis = np.array(up)
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis])


def _thing(splats: Splats, rows: np.ndarray, weights: np.ndarray, turn: np.ndarray) -> _Thing:
    rows = rows[:: -(-len(rows) // MOST_SPLATS) or 1]
    places = splats.positions(rows).astype(np.float64) @ turn.T
    if not len(rows):
        return _Thing(rows, places, np.zeros(3), np.zeros(3))
    own = weights[rows].astype(np.float64)
    low, high = map(np.array, trimmed_box(places, own if own.any() else own + 1))
    inside = ((places >= low) & (places <= high)).all(axis=1)
    return _Thing(rows[inside], places[inside], low, high)


def _of_pair(splats: Splats, a: int, b: int, one: _Thing, other: _Thing, *, known: bool) -> Iterator[Relation]:
    apart = np.maximum(one.low - other.high, other.low - one.high).clip(min=0)
    if np.linalg.norm(apart) > max(one.size.max(), other.size.max()):
        return
    gap, touches = _nearest(splats, one, other)
    if touches:
        yield Relation(node=a, other=b, relation="touching", gap=gap, overlap=None)
    for x, y, small, large in ((a, b, one, other), (b, a, other, one)):
        share = float(((small.places >= large.low) & (small.places <= large.high)).all(axis=1).mean())
        if share >= WITHIN and _around(small, large) >= AROUND:
            yield Relation(node=x, other=y, relation="inside", gap=gap, overlap=share)
            return
    if not known:
        return
    for x, y, upper, lower in ((a, b, one, other), (b, a, other, one)):
        height, covered, covering = _above(upper, lower)
        if max(covered, covering) < COVERED:
            continue
        if covered >= COVERED and (touches or height <= NEAR * upper.size[2]):
            yield Relation(node=x, other=y, relation="on", gap=height, overlap=covered)
        yield Relation(node=y, other=x, relation="under", gap=height, overlap=max(covered, covering))
        return
    common = min(one.high[2], other.high[2]) - max(one.low[2], other.low[2])
    share = common / max(min(one.size[2], other.size[2]), 1e-30)
    ground = float(np.linalg.norm(apart[:2]))
    if share >= 0.5 and ground <= min(one.size[:2].max(), other.size[:2].max()):
        yield Relation(node=a, other=b, relation="beside", gap=ground, overlap=float(min(share, 1.0)))


def _nearest(splats: Splats, one: _Thing, other: _Thing) -> tuple[float, bool]:
    """The distance of the nearest centres, and whether any of the nearest pairs of splats touch."""
    from scipy.spatial import KDTree

    distances, near = map(np.asarray, KDTree(other.places).query(one.places))
    closest = np.argsort(distances, kind="stable")[:PAIRS]
    touches = touch_pairwise(splats, one.rows[closest], other.rows[near[closest]])
    return float(distances[closest[0]]), bool(touches.any())


def _around(small: _Thing, large: _Thing) -> float:
    """In what share of DIRECTIONS from the middle of one thing some splat of another lies, to within NEARLY."""
    place = np.arange(DIRECTIONS) + 0.5
    height, angle = 1 - 2 * place / DIRECTIONS, np.pi * (1 + 5**0.5) * place  # a spiral over the sphere
    ring = np.sqrt(1 - height**2)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), height])
    offsets = large.places - (small.low + small.high) / 2
    offsets /= np.linalg.norm(offsets, axis=1, keepdims=True).clip(min=1e-30)
    return float(((offsets @ directions).max(axis=0) >= NEARLY).mean())


def _above(upper: _Thing, lower: _Thing) -> tuple[float, float, float]:
    """How far one thing begins above what of another lies below its footprint.

    Returns:
        The height, scene units; the share of its footprint above the other; that of the other's splats below it.
    """
    scale = CELLS / np.maximum(upper.size[:2], 1e-30)
    own = np.unique(((upper.places[:, :2] - upper.low[:2]) * scale).clip(0, CELLS - 1).astype(np.int64) @ (CELLS, 1))
    near = (lower.places[:, :2] - upper.low[:2]) * scale
    inside = ((near >= 0) & (near < CELLS)).all(axis=1)
    places = near[inside].astype(np.int64) @ (CELLS, 1)
    heights = lower.places[inside, 2]
    below = np.isin(places, own) & (heights <= upper.low[2] + NEAR * upper.size[2])
    if not below.any():
        return -np.inf, 0.0, 0.0
    covered, covering = np.unique(places[below]).size / own.size, float(below.sum() / len(lower.rows))
    return float(upper.low[2] - np.quantile(heights[below], 0.95)), covered, covering
