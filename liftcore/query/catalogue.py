"""Objects and parts of a lift: position, size, views and name of each.

Objects are found at lift time by masks alone (`liftcore.solve.objects`); the lift stores one number a splat. They are
numbered from 0, the one with the largest total weight first, the same for the same lift. An object's feature is the
mean of its splats' unit features by total weight. Its name is the nearest word, even if that is far; its score is the
cosine.

Parts and groups are numbered after the objects. Their features are those of their own masks, without their parts
(`liftcore.solve.objects.NodeVectors`), as a splat's feature is the sum over all levels.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.objects import object_box, size_of
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.query.question import ListedObjects, SceneNode, SceneObject, SceneTree
from liftcore.query.scores import cosines, norms_of
from liftcore.runtime.one_line import one_line
from liftcore.scene.origin import MAP_REACH
from liftcore.scene.world import UNKNOWN, WorldFrame
from liftcore.text import check_texts

MOST_WORDS = 65_536  # of a vocabulary: their vectors take 130 MB at 512 channels
NO_TREE = "this lift holds no tree: it was made before lifts had one; lift again"
NONE_FOUND = "no object: masks of three views never keep the same splats together"
_BLOCK = 1 << 14  # rows of features converted to f32 at once


@dataclass(frozen=True)
class Catalogue:
    """All objects of a lift."""

    objects: tuple[SceneObject, ...]
    explanation: str
    """the number of objects and its reason, in a sentence"""
    features: np.ndarray
    """[N, F] f32, unit means; zero where no splat has a feature"""
    world: WorldFrame = UNKNOWN
    """up axis and length unit, in which sizes are given"""

    def __repr__(self) -> str:
        text = ", ".join(f"{obj.name or obj.id}: {obj.splats}" for obj in self.objects)
        return one_line(self, f"{len(self.objects)} objects", f"features={list(self.features.shape)}", text or "none")

    def iterate_objects(
        self, first: int = 0, last: int | None = None, *, features: bool = False
    ) -> Iterator[SceneObject]:
        """Iterate over the objects ``first:last``; with ``features`` each has its mean feature."""
        rows = zip(self.objects[first:last], self.features[first:last], strict=True)
        return (obj.model_copy(update={"feature": tuple(row.tolist())}) if features else obj for obj, row in rows)

    def summary(self, *, features: bool = False) -> ListedObjects:
        """Return all objects as the model that is written as JSON."""
        objects = tuple(self.iterate_objects(features=features))
        facts = {"explanation": self.explanation, "count": len(objects), "objects": objects}
        return ListedObjects(**facts, world=self.world, unit=self.world.unit)


def catalogue(scene: OpenedLift, words: Sequence[str] = (), vectors: Any = None) -> Catalogue:
    """List the objects of a lift, named by the nearest of some words.

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
    naming, ids = _name_objects(features, words, vectors), np.arange(number)
    facts = _describe_nodes(scene, ids, scene.object, ids, scene.object_views, naming)
    count = "1 object" if len(facts) == 1 else f"{len(facts)} objects"
    explanation = f"{count}, which masks of three or more views keep together" if facts else NONE_FOUND
    objects = tuple(SceneObject(**fields) for fields in facts)
    return Catalogue(objects, explanation, features[[fields["id"] for fields in facts]], scene.world)


def tree(scene: OpenedLift, words: Sequence[str] = (), vectors: Any = None) -> SceneTree:
    """List the objects of a lift with their parts and groups, named by the nearest of some words.

    Args:
        scene, words, vectors: as of `catalogue`.

    Raises:
        InvalidQuery, InvalidLift: as `catalogue`.
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
    naming = _name_objects(features[order], words, vectors)
    facts = _describe_nodes(scene, order, splats, above, scene.node_views[order], naming)
    nodes, by_node = [], {int(order[fields["id"]]): fields for fields in facts}
    for node, fields in sorted(by_node.items()):
        path = scene.node_path(node)
        under = [part for part in np.flatnonzero(parents == node).tolist() if part in by_node]
        tree_fields = {"id": node, "kind": scene.node_kind(node), "path": path, "parts": tuple(under)}
        parent = int(parents[node]) if parents[node] >= 0 else None
        confidence = float(scene.node_confidence[node])
        nodes.append(SceneNode(**fields | tree_fields, parent=parent, confidence=confidence))
    explanation = _counts(nodes) if nodes else NONE_FOUND
    return SceneTree(explanation=explanation, count=len(nodes), nodes=tuple(nodes), **measured)


def _counts(nodes: Sequence[SceneNode]) -> str:
    """Count objects, parts and groups in words, such as ``1 object with 2 parts, in 1 group``."""
    counts = {kind: sum(node.kind == kind for node in nodes) for kind in ("object", "part", "group")}
    objects, parts, groups = (f"{count} {kind}{'s' * (count != 1)}" for kind, count in counts.items())
    parts = f" with {parts if counts['part'] else 'no parts'}"
    return objects + parts + (f", in {groups}" if counts["group"] else "")


def _describe_nodes(
    scene: OpenedLift,
    nodes: np.ndarray,
    labels: np.ndarray,
    above: np.ndarray,
    views: np.ndarray,
    naming: tuple[list[str | None], list[float | None]],
) -> list[dict[str, Any]]:
    """Return the fields of a `SceneObject` for each node; the splats of a node belong to all nodes above it, too.

    Nodes without splats, which lifts of other programs may have, are left out. Boxes are cached in the scene: they
    take most of the time, and do not depend on words.

    Args:
        nodes: [N], their ids. labels: [P] i32, the index of the smallest node of each splat, -1 for none.
        above: [N], the index of the node above each, which comes before it; -1 or its own index: none.
        views: [N, V] i32. naming: name and score of each.
    """
    order = np.argsort(labels, kind="stable")
    ends = np.searchsorted(labels[order], np.arange(len(views) + 1))
    rows_of = [order[first:last] for first, last in pairwise(ends.tolist())]
    for node in range(len(views) - 1, -1, -1):
        if 0 <= above[node] < node:
            rows_of[above[node]] = np.concatenate([rows_of[above[node]], rows_of[node]])
    total_weight = scene.total_weight.astype(np.float64)
    total, view_names = total_weight.sum() or 1.0, scene.metadata.views
    entries = []
    for index, (name, score, unsorted_rows) in enumerate(zip(*naming, rows_of, strict=True)):
        if not unsorted_rows.size:
            continue
        rows = np.sort(unsorted_rows)
        weights = total_weight[rows] if total_weight[rows].any() else np.ones(rows.size)
        key = int(nodes[index]), rows.size
        if key not in scene.node_boxes:
            scene.node_boxes[key] = object_box(scene.splats, rows, weights)
        box = scene.node_boxes[key]
        x, y, z = np.mean(box, axis=0).tolist()
        visible_views = tuple(view_names[view] for view in views[index] if 0 <= view < len(view_names))
        share = float(total_weight[rows].sum() / total)
        entries.append(
            {"id": index, "name": name, "score": score, "splats": int(rows.size), "share": share, "centre": (x, y, z)}
            | {"box": box, "size": size_of(scene.world, box), "views": visible_views}
        )
    return entries


def object_features(scene: OpenedLift) -> np.ndarray:
    """Return the unit mean [N, F] f32 of unit features of each object by total weight; zeros without a feature."""
    if scene.object_features is None:
        scene.object_features = _compute_object_features(scene)
    return scene.object_features


def _compute_object_features(scene: OpenedLift) -> np.ndarray:
    from scipy.sparse import csr_array

    assert scene.object is not None and scene.object_views is not None
    number = len(scene.object_views)
    sums = np.zeros((number, scene.channels))
    weights = np.where(scene.has_feature, scene.total_weight / np.where(scene.has_feature, scene.norms, 1.0), 0.0)
    indices = np.flatnonzero((scene.object >= 0) & (weights > 0))
    objects, rows, weights = scene.object[indices], indices, weights[indices].astype(np.float64)
    if scene.features.code is not None:  # a sum for each pair of an object and a row
        count = len(scene.features.rows)
        pairs, place = np.unique(objects * count + scene.features.code[indices], return_inverse=True)
        objects, rows, weights = pairs // count, pairs % count, np.bincount(place, weights)
    for first in range(0, rows.size, _BLOCK):
        block = slice(first, first + _BLOCK)
        places = objects[block], np.arange(rows[block].size)
        shares = csr_array((weights[block], places), shape=(number, rows[block].size))
        sums += shares @ scene.features.rows[rows[block]].astype(np.float32)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0).astype(np.float32)


def _name_objects(
    features: np.ndarray, words: Sequence[str], vectors: Any
) -> tuple[list[str | None], list[float | None]]:
    """Return name and cosine of each object; None without words, and for an object without a feature."""
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
    has_feature = norms > 0
    names = [words[row] if has else None for row, has in zip(nearest.tolist(), has_feature, strict=True)]
    return names, [score if has else None for score, has in zip(best.tolist(), has_feature, strict=True)]


def table_csv(source: Catalogue) -> bytes:
    """Write the catalogue as a CSV table, a line an object."""
    content = io.StringIO(newline="")
    writer = csv.writer(content)
    corners = [f"{end}_{axis}" for end in ("low", "high") for axis in "xyz"]
    sides = [f"size_{axis}" for axis in "xyz"]
    writer.writerow(["id", "name", "score", "splats", "share", "x", "y", "z", *corners, "views", *sides, "unit"])
    for obj in source.objects:
        low, high = obj.box
        label = "" if obj.name is None else obj.name, "" if obj.score is None else f"{obj.score:.6g}"
        digits = 9 if max(map(abs, (*low, *high))) < MAP_REACH else 15  # as many as the boxes' numbers have
        numbers = (f"{value:.{digits}g}" for value in (obj.share, *obj.centre, *low, *high))
        size = (f"{side:.6g}" for side in obj.size)
        writer.writerow([obj.id, *label, obj.splats, *numbers, " ".join(obj.views), *size, source.world.unit])
    return content.getvalue().encode()


def one_object_splats(scene: OpenedLift, number: int, suffix: str = ".ply") -> Iterable[bytes]:
    """Write the splats of an object or another node as a file, in blocks; a PLY has all their properties unchanged.

    Raises:
        NotFound: the lift has no such object.
        InvalidLift: the splats moved or changed since the lift.
    """
    from liftcore.io.splats import some_rows

    return some_rows(scene.splat_file, scene.members(number), suffix, scene.world)
