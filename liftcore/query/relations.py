"""Spatial relations of objects, from the geometry of their splats alone, with the measures that decide them.

Of objects a and b, with heights along ``up`` and the ground at right angles to it, all without outliers
(`liftcore.query.objects.trimmed_box`):

| relation | when |
|---|---|
| a is touching b | two of their splats touch (`touching`) |
| a is inside b | its splats lie in b's box, and b lies in AROUND of the directions from its middle |
| a is on b | b lies below COVERED_SHARE of a's footprint, and a touches b or begins at most NEAR above it |
| b is under a | a is on it, or begins higher above it |
| a is beside b | their heights overlap by half, and their distance on the ground is at most the smaller one's width |

``gap`` is the distance of the nearest centres; for on and under that of heights, for beside that on the ground.
``overlap`` is the share of a's splats in b's box, of its footprint above b, or of heights.

Without an up axis (`liftcore.scene.world`, or `upright` of cameras) there are no relations on, under and beside. Gaps
are in metres if the length of a unit is known, else in scene units.
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

NEAR = 0.15  # of its own height: an object sinks into its support, or floats above it, by less
AROUND = 0.66  # of all directions, that a container covers: a bowl is open above, a wall is on one side alone
DIRECTIONS = 128  # evenly over the sphere
NEARLY = 0.966  # cosine, 15 degrees; with it a wall covers 0.63 of all directions
WITHIN = 0.9  # of an object's splats, in the box of its container
COVERED_SHARE = 0.3  # of an object's footprint, above its support: a chair stands on four small legs
MOST_OBJECTS = 64
MOST_SPLATS = 1 << 16  # of an object that are compared, evenly spaced rows
CELLS = 16  # of a footprint's side
PAIRS = 256  # of nearest splats, of which one must touch
LEVELLED = 0.002  # regularisation of the up axis, a share of each camera: for cameras of the same orientation
LEAST_UPRIGHT = 0.5  # least mean cosine of the cameras' up axes to the common one; less if photos lie on their sides


@dataclass(frozen=True)
class _Placement:
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
    """Find the relations of some objects, by their indices in ``members``.

    Args:
        splats: the scene. members: rows [n] i64 of the splats of each, the largest objects first; the first
            MOST_OBJECTS are compared. weights: [P] of the splats.
        world: up axis and length unit, as far as they are known.
    """
    rotation = _rotation_to(world.up)
    placements = [_place_object(splats, rows, weights, rotation) for rows in members[:MOST_OBJECTS]]
    pairs = list[Relation]()
    for a, b in combinations(range(len(placements)), 2):
        if len(placements[a].rows) and len(placements[b].rows):
            pairs += _of_pair(splats, a, b, placements[a], placements[b], has_up=world.up is not None)
    return tuple(relation.model_copy(update={"gap": world.length(relation.gap)}) for relation in pairs)


def upright(cameras: Iterable[Camera]) -> Point:
    """Estimate the up axis from photos that were taken upright, unit, in the frame of the splats.

    Cameras are pitched but seldom rolled: so it is the mean of their up axes without the components along their
    right axes.

    Raises:
        InvalidQuery: the cameras have no up in common.
    """
    poses = np.stack([camera.viewmat[:3, :3] for camera in cameras])
    right, ups = poses[:, 0], -poses[:, 1]
    axis = np.linalg.solve(right.T @ right + LEVELLED * len(poses) * np.eye(3), ups.sum(axis=0))
    axis /= max(float(np.linalg.norm(axis)), 1e-30)
    common = float((ups @ axis).mean())
    if common < LEAST_UPRIGHT:
        expected, hint = "cameras that are upright", "give x,y,z, the direction against gravity"
        got = f"a mean cosine of {common:.2f} to one direction"
        raise InvalidQuery("up", expected=expected, got=got, hint=hint)
    x, y, z = axis.tolist()
    return x, y, z


def _rotation_to(up: Point | None) -> np.ndarray:
    """Return the rotation [3, 3] to axes of the world: its rows are two directions on the ground, and up."""
    if up is None:
        return np.eye(3)
    axis = np.array(up)
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis])


def _place_object(splats: Splats, rows: np.ndarray, weights: np.ndarray, rotation: np.ndarray) -> _Placement:
    rows = rows[:: -(-len(rows) // MOST_SPLATS) or 1]
    places = splats.positions(rows).astype(np.float64) @ rotation.T
    if not len(rows):
        return _Placement(rows, places, np.zeros(3), np.zeros(3))
    member_weights = weights[rows].astype(np.float64)
    low, high = map(np.array, trimmed_box(places, member_weights if member_weights.any() else member_weights + 1))
    inside = ((places >= low) & (places <= high)).all(axis=1)
    return _Placement(rows[inside], places[inside], low, high)


def _of_pair(
    splats: Splats, a: int, b: int, first: _Placement, second: _Placement, *, has_up: bool
) -> Iterator[Relation]:
    gaps = np.maximum(first.low - second.high, second.low - first.high).clip(min=0)
    if np.linalg.norm(gaps) > max(first.size.max(), second.size.max()):
        return
    gap, touches = _nearest(splats, first, second)
    if touches:
        yield Relation(node=a, other=b, relation="touching", gap=gap, overlap=None)
    for x, y, small, large in ((a, b, first, second), (b, a, second, first)):
        share = float(((small.places >= large.low) & (small.places <= large.high)).all(axis=1).mean())
        if share >= WITHIN and _around(small, large) >= AROUND:
            yield Relation(node=x, other=y, relation="inside", gap=gap, overlap=share)
            return
    if not has_up:
        return
    for x, y, upper, lower in ((a, b, first, second), (b, a, second, first)):
        height, covered_share, covering_share = _above(upper, lower)
        if max(covered_share, covering_share) < COVERED_SHARE:
            continue
        if covered_share >= COVERED_SHARE and (touches or height <= NEAR * upper.size[2]):
            yield Relation(node=x, other=y, relation="on", gap=height, overlap=covered_share)
        yield Relation(node=y, other=x, relation="under", gap=height, overlap=max(covered_share, covering_share))
        return
    common = min(first.high[2], second.high[2]) - max(first.low[2], second.low[2])
    share = common / max(min(first.size[2], second.size[2]), 1e-30)
    ground = float(np.linalg.norm(gaps[:2]))
    if share >= 0.5 and ground <= min(first.size[:2].max(), second.size[:2].max()):
        yield Relation(node=a, other=b, relation="beside", gap=ground, overlap=float(min(share, 1.0)))


def _nearest(splats: Splats, first: _Placement, second: _Placement) -> tuple[float, bool]:
    """Return the distance of the nearest centres, and True if one of the nearest pairs of splats touches."""
    from scipy.spatial import KDTree

    distances, near = map(np.asarray, KDTree(second.places).query(first.places))
    closest = np.argsort(distances, kind="stable")[:PAIRS]
    touches = touch_pairwise(splats, first.rows[closest], second.rows[near[closest]])
    return float(distances[closest[0]]), bool(touches.any())


def _around(small: _Placement, large: _Placement) -> float:
    """Return the share of DIRECTIONS from the middle of one object in which another has a splat, to within NEARLY."""
    place = np.arange(DIRECTIONS) + 0.5
    height, angle = 1 - 2 * place / DIRECTIONS, np.pi * (1 + 5**0.5) * place  # a spiral over the sphere
    ring = np.sqrt(1 - height**2)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), height])
    offsets = large.places - (small.low + small.high) / 2
    offsets /= np.linalg.norm(offsets, axis=1, keepdims=True).clip(min=1e-30)
    return float(((offsets @ directions).max(axis=0) >= NEARLY).mean())


def _above(upper: _Placement, lower: _Placement) -> tuple[float, float, float]:
    """Measure the height of one object above the part of another that is below its footprint.

    Returns:
        The height, scene units; the share of its footprint above the other; that of the other's splats below it.
    """
    scale = CELLS / np.maximum(upper.size[:2], 1e-30)
    cells = np.unique(
        ((upper.places[:, :2] - upper.low[:2]) * scale).clip(0, CELLS - 1).astype(np.int64) @ (CELLS, 1)
    )
    near = (lower.places[:, :2] - upper.low[:2]) * scale
    inside = ((near >= 0) & (near < CELLS)).all(axis=1)
    places = near[inside].astype(np.int64) @ (CELLS, 1)
    heights = lower.places[inside, 2]
    below = np.isin(places, cells) & (heights <= upper.low[2] + NEAR * upper.size[2])
    if not below.any():
        return -np.inf, 0.0, 0.0
    covered_share, covering_share = np.unique(places[below]).size / cells.size, float(below.sum() / len(lower.rows))
    return float(upper.low[2] - np.quantile(heights[below], 0.95)), covered_share, covering_share
