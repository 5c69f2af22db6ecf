"""The objects of a lift and their parts, one by one: where each lies, how large it is, what shows it, and its name.

Objects are found at lift time by masks alone (`liftcore.solve.objects`); the lift keeps one number a splat. They are
numbered from 0, the one with the most evidence first, the same for the same lift. An object's feature is the mean of
its splats' unit features by evidence. Its name is the nearest word, however far that is; the cosine says how far.

Parts and groups are numbered after the objects. Their features are what their own masks say, without those of their
parts (`liftcore.solve.objects.NodeVectors`): a splat's feature is the sum of what all levels say.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.objects import size_of, thing_box
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.query.question import ListedObjects, Point, SceneNode, SceneObject, SceneTree
from liftcore.query.relations import relations as related
from liftcore.query.relations import upright
from liftcore.query.scores import cosines, norms_of
from liftcore.runtime.one_line import one_line
from liftcore.scene.origin import MAP_REACH
from liftcore.scene.world import UNKNOWN, WorldFrame
from liftcore.text import check_texts

MOST_WORDS = 65_536  # of a vocabulary: their vectors take 130 MB at 512 channels
NO_TREE = "this lift holds no tree: it was made before lifts had one; lift again"
NONE_FOUND = "no object: masks of three views never keep the same splats together"
_BLOCK = 1 << 14  # rows of features widened at once


@dataclass(frozen=True)
class Catalogue:
    """All objects of a lift."""

    objects: tuple[SceneObject, ...]
    explanation: str
    """why there are as many as there are"""
    features: np.ndarray
    """[N, F] f32, unit means; zero where no splat has a feature"""
    world: WorldFrame = UNKNOWN
    """which way is up and how long a unit is, by which sizes are told"""

    def __repr__(self) -> str:
        some = ", ".join(f"{one.name or one.id}: {one.splats}" for one in self.objects)
        return one_line(self, f"{len(self.objects)} objects", f"features={list(self.features.shape)}", some or "none")

    def listed(self, first: int = 0, last: int | None = None, *, features: bool = False) -> Iterator[SceneObject]:
        """The objects from a place to another; with ``features`` each has its mean feature."""
        rows = zip(self.objects[first:last], self.features[first:last], strict=True)
        return (one.model_copy(update={"feature": tuple(row.tolist())}) if features else one for one, row in rows)

    def summary(self, *, features: bool = False) -> ListedObjects:
        """All of them, as JSON has them."""
        things = tuple(self.listed(features=features))
        facts = {"explanation": self.explanation, "count": len(things), "objects": things}
        return ListedObjects(**facts, world=self.world, unit=self.world.unit)


def catalogue(scene: OpenedLift, words: Sequence[str] = (), vectors: Any = None) -> Catalogue:
    """The objects of a lift, named by the nearest of some words.

    Args:
        scene: an opened lift. words: n. vectors: [n, F], torch or numpy, their text vectors.

    Raises:
        InvalidQuery: words without vectors, too many, or vectors that are no directions of the lift's space.
        InvalidLift: the splats moved or changed since the lift.
    """
    if scene.object is None or scene.object_views is None:
        return Catalogue((), scene.lack_of_objects(), np.zeros((0, scene.channels), np.float32), scene.world)
    number = len(scene.object_views)
    features = object_features(scene)
    named, ids = _named(features, words, vectors), np.arange(number)
    facts = _described(scene, ids, scene.object, ids, scene.object_views, named)
    count = "1 object" if len(facts) == 1 else f"{len(facts)} objects"
    told = f"{count}, which masks of three or more views keep together" if facts else NONE_FOUND
    things = tuple(SceneObject(**one) for one in facts)
    return Catalogue(things, told, features[[one["id"] for one in facts]], scene.world)


def tree(
    scene: OpenedLift,
    words: Sequence[str] = (),
    vectors: Any = None,
    *,
    relations: bool = False,
    up: Point | Literal["cameras"] | None = None,
) -> SceneTree:
    """The objects of a lift with their parts and groups, named by the nearest of some words.

    Args:
        scene, words, vectors: as of `catalogue`. relations, up: as of `Scene.tree`.

    Raises:
        InvalidQuery, InvalidLift: as `catalogue`; or the cameras have no up in common.
        InvalidInput: up has no direction.
    """
    measured: dict[str, Any] = {"world": scene.world, "unit": scene.world.unit}
    if scene.object is None or scene.object_views is None:
        return SceneTree(explanation=scene.lack_of_objects(), count=0, nodes=(), **measured)
    if scene.node is None or scene.node_parents is None or scene.node_views is None:
        return SceneTree(explanation=NO_TREE, count=0, nodes=(), **measured)
    assert scene.node_confidence is not None and scene.node_features is not None
    objects, parents = len(scene.object_views), scene.node_parents
    features = np.concatenate([object_features(scene), scene.node_features[objects:].astype(np.float32)])
    order = np.array(sorted(range(len(parents)), key=lambda node: (len(scene.node_path(node)), node)), np.int64)
    place = np.empty(len(parents) + 1, np.int64)
    place[order], place[-1] = np.arange(len(parents)), -1
    splats, above = place[scene.node], place[parents[order]]
    named = _named(features[order], words, vectors)
    facts = _described(scene, order, splats, above, scene.node_views[order], named)
    nodes, listed = [], {int(order[one["id"]]): one for one in facts}
    for node, one in sorted(listed.items()):
        path = scene.node_path(node)
        under = [part for part in np.flatnonzero(parents == node).tolist() if part in listed]
        more = {"id": node, "kind": scene.node_kind(node), "path": path, "parts": tuple(under)}
        parent = int(parents[node]) if parents[node] >= 0 else None
        confidence = float(scene.node_confidence[node])
        nodes.append(SceneNode(**one | more, parent=parent, confidence=confidence))
    explanation = _counts(nodes) if nodes else NONE_FOUND
    answer = SceneTree(explanation=explanation, count=len(nodes), nodes=tuple(nodes), **measured)
    if not relations:
        return answer
    own = upright(scene.cameras.values()) if up == "cameras" else up
    world = WorldFrame(up=own).known_or(scene.world)
    members = [np.flatnonzero(scene.members(node)) for node in range(objects)]
    found = related(scene.splats, members, scene.evidence, world)
    return answer.model_copy(update={"world": world, "relations": found})


def _counts(nodes: Sequence[SceneNode]) -> str:
    """How many objects, parts and groups there are, such as ``1 object with 2 parts, in 1 group``."""
    counts = {kind: sum(one.kind == kind for one in nodes) for kind in ("object", "part", "group")}
    objects, parts, groups = (f"{count} {kind}{'s' * (count != 1)}" for kind, count in counts.items())
    parts = f" with {parts if counts['part'] else 'no parts'}"
    return objects + parts + (f", in {groups}" if counts["group"] else "")


def _described(
    scene: OpenedLift,
    nodes: np.ndarray,
    labels: np.ndarray,
    above: np.ndarray,
    views: np.ndarray,
    named: tuple[list[str | None], list[float | None]],
) -> list[dict[str, Any]]:
    """The fields of a `SceneObject` of each of some nodes, whose splats are also those of the nodes above them.

    Nodes without splats, which lifts of other programs may have, are left out. Boxes are kept with the scene: they
    take nearly all the time, and words change none.

    Args:
        nodes: [N], their ids. labels: [P] i32, the place of the smallest node of each splat, -1 for none.
        above: [N], the place of the node above each, which comes before it; -1 or itself: none.
        views: [N, V] i32. named: name and score of each.
    """
    order = np.argsort(labels, kind="stable")
    ends = np.searchsorted(labels[order], np.arange(len(views) + 1))
    rows_of = [order[first:last] for first, last in pairwise(ends.tolist())]
    for node in range(len(views) - 1, -1, -1):
        if 0 <= above[node] < node:
            rows_of[above[node]] = np.concatenate([rows_of[above[node]], rows_of[node]])
    evidence = scene.evidence.astype(np.float64)
    whole, known = evidence.sum() or 1.0, scene.metadata.views
    found = []
    for one, (name, score, mixed) in enumerate(zip(*named, rows_of, strict=True)):
        if not mixed.size:
            continue
        rows = np.sort(mixed)
        weights = evidence[rows] if evidence[rows].any() else np.ones(rows.size)
        key = int(nodes[one]), rows.size
        if key not in scene.node_boxes:
            scene.node_boxes[key] = thing_box(scene.splats, rows, weights)
        box = scene.node_boxes[key]
        x, y, z = np.mean(box, axis=0).tolist()
        shown = tuple(known[view] for view in views[one] if 0 <= view < len(known))
        share = float(evidence[rows].sum() / whole)
        found.append(
            {"id": one, "name": name, "score": score, "splats": int(rows.size), "share": share, "centre": (x, y, z)}
            | {"box": box, "size": size_of(scene.world, box), "views": shown}
        )
    return found


def object_features(scene: OpenedLift) -> np.ndarray:
    """[N, F] f32: the unit mean of each object's unit features, by evidence; zeros where none has a feature."""
    if scene.object_features is None:
        scene.object_features = _object_means(scene)
    return scene.object_features


def _object_means(scene: OpenedLift) -> np.ndarray:
    from scipy.sparse import csr_array

    assert scene.object is not None and scene.object_views is not None
    number = len(scene.object_views)
    sums = np.zeros((number, scene.channels))
    weights = np.where(scene.seen, scene.evidence / np.where(scene.seen, scene.norms, 1.0), 0.0)
    chosen = np.flatnonzero((scene.object >= 0) & (weights > 0))
    for first in range(0, chosen.size, _BLOCK):
        rows = chosen[first : first + _BLOCK]
        places = scene.object[rows], np.arange(rows.size)
        shares = csr_array((weights[rows].astype(np.float64), places), shape=(number, rows.size))
        sums += shares @ scene.features[rows].astype(np.float32)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0).astype(np.float32)


def _named(features: np.ndarray, words: Sequence[str], vectors: Any) -> tuple[list[str | None], list[float | None]]:
    """Name and cosine of each object; None without words, and for an object without a feature."""
    number = len(features)
    check_texts(words, "words")
    if not words:
        return [None] * number, [None] * number
    rows = None if vectors is None else np.atleast_2d(np.asarray(as_numpy(vectors), np.float32))
    if rows is None or len(rows) != len(words) or len(words) > MOST_WORDS:
        got = f"{len(words)} words and {0 if rows is None else len(rows)} vectors"
        raise InvalidQuery("words", expected=f"at most {MOST_WORDS} words, a vector each", got=got)
    if rows.shape[1] != features.shape[1] or not np.isfinite(rows).all() or not rows.any(axis=1).all():
        expected = f"finite vectors of {features.shape[1]} channels, as the lift has, none of them zero"
        raise InvalidQuery("words", expected=expected, got=f"vectors of {rows.shape[1]} channels")
    nearest, best = np.zeros(number, np.int64), np.full(number, -np.inf, np.float32)
    norms = norms_of(features)
    for first in range(0, len(words), 256):
        scores = cosines(features, norms, rows[first : first + 256])
        place = scores.argmax(axis=1)
        higher = scores[np.arange(number), place] > best
        nearest[higher], best[higher] = first + place[higher], scores[np.arange(number), place][higher]
    known = norms > 0
    names = [words[row] if has else None for row, has in zip(nearest.tolist(), known, strict=True)]
    return names, [score if has else None for score, has in zip(best.tolist(), known, strict=True)]


def table_csv(found: Catalogue) -> bytes:
    """The catalogue as a table: a line an object."""
    content = io.StringIO(newline="")
    writer = csv.writer(content)
    corners = [f"{end}_{axis}" for end in ("low", "high") for axis in "xyz"]
    sides = [f"size_{axis}" for axis in "xyz"]
    writer.writerow(["id", "name", "score", "splats", "share", "x", "y", "z", *corners, "views", *sides, "unit"])
    for one in found.objects:
        low, high = one.box
        named = "" if one.name is None else one.name, "" if one.score is None else f"{one.score:.6g}"
        digits = 9 if max(map(abs, (*low, *high))) < MAP_REACH else 15  # as many as the boxes' numbers have
        numbers = (f"{value:.{digits}g}" for value in (one.share, *one.centre, *low, *high))
        size = (f"{side:.6g}" for side in one.size)
        writer.writerow([one.id, *named, one.splats, *numbers, " ".join(one.views), *size, found.world.unit])
    return content.getvalue().encode()


def one_object_splats(scene: OpenedLift, number: int, suffix: str = ".ply") -> Iterable[bytes]:
    """The splats of one object, or another node, as a file in blocks; of a PLY every property of theirs to the byte.

    Raises:
        NotFound: the lift has no such object.
        InvalidLift: the splats moved or changed since the lift.
    """
    from liftcore.io.splats import some_rows

    return some_rows(scene.splat_file, scene.members(number), suffix, scene.world)
