"""Objects and parts of a lift: position, size, views and name of each.

Objects are found at lift time by masks alone (`liftcore.solve.objects`). They are numbered from 0, the one with the
largest total weight first, the same for the same lift. An object's feature is the mean of its splats' unit features
by total weight, of many splats that of a sample. Its name is the nearest word, even if that is far; its score is the
cosine.

Parts and groups are numbered after the objects. Their features are those of their own masks, without their parts
(`liftcore.solve.objects.NodeVectors`), as a splat's feature is the sum over all levels.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.objects import object_box, size_of
from liftcore.query.question import SceneNode, SceneTree
from liftcore.query.scene import Scene, as_numpy
from liftcore.query.scores import cosines, norms_of
from liftcore.text import check_texts

MOST_WORDS = 65_536  # of a vocabulary: their vectors take 130 MB at 512 channels
NONE_FOUND = "no object: masks of three views never keep the same splats together"


def tree(scene: Scene, words: Sequence[str] = (), vectors: Any = None) -> SceneTree:
    """List the objects of a lift with their parts and groups, named by the nearest of some words.

    Nodes without splats, which lifts of other programs may have, are left out. Boxes are cached in the scene: they
    take most of the time, and do not depend on words.

    Args:
        scene: an opened lift. words: n. vectors: [n, F], torch or numpy, their text vectors.

    Raises:
        InvalidQuery: words without vectors, too many, or vectors that are no directions of the lift's space.
        InvalidLift: the splats moved or changed since the lift.
    """
    parents = scene.node_parents
    if scene.object_views is None or scene.node_views is None or parents is None:
        return _tree_of(scene, (), scene.lack_of_objects())
    features = scene.object_means
    if scene.node_features is not None:
        features = np.concatenate([features, scene.node_features[len(features) :].astype(np.float32)])
    naming = _names(features, words, vectors)
    rows_of = [np.flatnonzero(scene.members(node)) for node in range(len(parents))]
    total_weight, view_names = scene.total_weight.astype(np.float64), scene.metadata.views
    total, nodes = total_weight.sum() or 1.0, list[SceneNode]()
    for node, ((name, score), rows) in enumerate(zip(naming, rows_of, strict=True)):
        if not rows.size:
            continue
        key = node, rows.size
        if key not in scene.node_boxes:
            scene.node_boxes[key] = object_box(scene.splats, rows, scene.weights_of(rows))
        box = scene.node_boxes[key]
        x, y, z = np.mean([*box], axis=0).tolist()
        nodes.append(
            SceneNode(
                id=node,
                name=name,
                score=score,
                splats=rows.size,
                share=float(total_weight[rows].sum() / total),
                centre=(x, y, z),
                box=box,
                size=size_of(scene.world, box),
                views=tuple(view_names[view] for view in scene.node_views[node] if 0 <= view < len(view_names)),
                kind=scene.node_kind(node),
                parent=int(parents[node]) if parents[node] >= 0 else None,
                path=scene.node_paths[node],
                parts=tuple(part for part in np.flatnonzero(parents == node).tolist() if rows_of[part].size),
                confidence=scene.confidence_of(node),
            )
        )
    return _tree_of(scene, tuple(nodes), _counts(nodes) if nodes else NONE_FOUND)


def _tree_of(scene: Scene, nodes: tuple[SceneNode, ...], explanation: str) -> SceneTree:
    world = scene.world
    return SceneTree(explanation=explanation, count=len(nodes), nodes=nodes, world=world, unit=world.unit)


def _counts(nodes: Sequence[SceneNode]) -> str:
    """Count objects, parts and groups in words, such as ``1 object with 2 parts, in 1 group``."""
    counts = {kind: sum(node.kind == kind for node in nodes) for kind in ("object", "part", "group")}
    objects, parts, groups = (f"{count} {kind}{'s' * (count != 1)}" for kind, count in counts.items())
    parts = f" with {parts if counts['part'] else 'no parts'}"
    return objects + parts + (f", in {groups}" if counts["group"] else "")


def _names(features: np.ndarray, words: Sequence[str], vectors: Any) -> list[tuple[str | None, float | None]]:
    """Return name and cosine of each node [N, F] f32, unit; None without words, and for one without a feature."""
    check_texts(words, "words")
    if not words:
        return [(None, None)] * len(features)
    rows = None if vectors is None else np.atleast_2d(np.asarray(as_numpy(vectors), np.float32))
    if rows is None or len(rows) != len(words) or len(words) > MOST_WORDS:
        got = f"{len(words)} words and {0 if rows is None else len(rows)} vectors"
        raise InvalidQuery("words", expected=f"at most {MOST_WORDS} words, a vector each", got=got)
    norms, names = norms_of(features), list[tuple[str | None, float | None]]()
    for norm, similar in zip(norms, cosines(features, norms, rows), strict=True):
        best = int(similar.argmax())
        names.append((words[best], float(similar[best])) if norm else (None, None))
    return names


def table_csv(source: SceneTree) -> bytes:
    """Write the objects of a tree as a CSV table, a line an object."""
    content = io.StringIO(newline="")
    writer = csv.writer(content)
    corners = [f"{end}_{axis}" for end in ("low", "high") for axis in "xyz"]
    sides = [f"size_{axis}" for axis in "xyz"]
    writer.writerow(["id", "name", "score", "splats", "share", "x", "y", "z", *corners, "views", *sides, "unit"])
    for obj in source.objects:
        low, high = obj.box
        label = "" if obj.name is None else obj.name, "" if obj.score is None else f"{obj.score:.6g}"
        numbers = (f"{value:.12g}" for value in (obj.share, *obj.centre, *low, *high))
        size = (f"{side:.6g}" for side in obj.size)
        writer.writerow([obj.id, *label, obj.splats, *numbers, " ".join(obj.views), *size, source.world.unit])
    return content.getvalue().encode()
