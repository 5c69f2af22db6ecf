"""Labels of all splats for other programs: class and instance numbers per splat, and a document that explains them.

All sources give the same format. A segmentation has words as classes, and groups of touching splats as instances. An
answer has its texts as the one class, and its objects as instances. A tree has the objects of the lift.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.io.labels import FORMAT, Labels
from liftcore.query.colours import cluster_colours
from liftcore.query.objects import LEAST_OBJECT_WEIGHT, is_outlier, objects, trimmed_box
from liftcore.query.question import Answer, SceneNode, SceneTree
from liftcore.query.scene import Scene
from liftcore.runtime.version import __version__
from liftcore.scene.touching import touching

if TYPE_CHECKING:
    from liftcore.query.segment import Segmentation


def labels(scene: Scene, source: Segmentation | Answer | Mapping[str, Answer] | SceneTree) -> Labels:
    """Return the labels of a segmentation, of answers, or of a lift's objects with their parts.

    Of a segmentation, ``class_id`` is the value of a splat's word (`Segmentation.labels`), and ``instance_id``
    numbers the groups of touching splats of one word (`liftcore.scene.touching`), the one with the largest total
    weight first; groups with less than a twentieth of the total weight of their word's largest have only a class. Of
    an answer, every selected splat has class 1, and the instances are its objects. Of several answers by name, each
    is a class; a splat that several select belongs to the one whose threshold it exceeds most. Of a tree, the
    instances are its objects and the classes their names, without names none; ``node_id`` is 1 + the id of the
    smallest node of a splat: object, part or group. 0 means none in all columns. ``score`` is the cosine to the word,
    or the answer's score. ``confidence`` is that of a reweighted lift, ``code`` of a lift as codes; other lifts have
    none.

    Raises:
        InvalidQuery: no splat has a label, or more splats are selected than are grouped to objects.
        InvalidLift: the splats moved or changed since the lift.
    """
    parts = dict(source) if isinstance(source, Mapping) else {None: source}  # a copy: the caller's may change
    if (
        scene.labelled is None
        or not _are_same(scene.labelled[0], parts)
        or scene.labelled[1].document["world"] != scene.world.model_dump(mode="json")
    ):
        if isinstance(source, Answer | Mapping):
            result = _of_answers(scene, {_name(source): source} if isinstance(source, Answer) else source)
        else:
            result = _of_tree(scene, source) if isinstance(source, SceneTree) else _of_words(scene, source)
        scene.labelled = parts, result
    columns: Labels = scene.labelled[1]
    return columns


def _are_same(parts: Mapping[Any, Any], cached: Mapping[Any, Any]) -> bool:
    return list(parts) == list(cached) and all(part is cached[name] for name, part in parts.items())


def _name(answer: Answer) -> str:
    return ", ".join(map(str, (*answer.query.positives, *answer.query.sets)))


def _of_words(scene: Scene, segmentation: Segmentation) -> Labels:
    names, values = [label.word for label in segmentation.named_words], segmentation.labels
    groups = list[tuple[int, np.ndarray]]()
    for value in range(1, len(names) + 1):
        rows = np.flatnonzero(values == value)
        numbers = touching(scene.splats, rows)
        sums = np.bincount(numbers, scene.weights_of(rows))
        large = np.argsort(-sums, kind="stable")[: int((sums >= LEAST_OBJECT_WEIGHT * sums.max()).sum())]
        groups += [(value, rows[numbers == number]) for number in large.tolist()]
    colours = segmentation.colours[[value for value, _ in groups]]
    return _of_groups(scene, names, values, segmentation.score, groups, colours)


def _of_answers(scene: Scene, answers: Mapping[str, Answer]) -> Labels:
    selections = {name: a for name, a in answers.items() if a.count and not a.is_dropped}
    if not selections:
        first = next(iter(answers.values()))
        got = first.reason.rstrip(".") if first.is_dropped else "none above the threshold"
        raise InvalidQuery("source", expected="an answer with selected splats", got=got, hint="ask in other words")
    count = len(scene.features)
    class_ids, scores, best = np.zeros(count, np.int32), np.zeros(count, np.float32), np.full(count, -np.inf)
    for value, answer in enumerate(selections.values(), 1):
        cut = answer.threshold.value
        over = (answer.scores - cut) / max(float(answer.scores.max()) - cut, 1e-9)  # as the page colours them
        better = answer.selected & ((over > best) | (class_ids == 0))
        class_ids[better], best[better], scores[better] = value, over[better], answer.scores[better]
    numbers = [objects(scene, answer).numbers for answer in selections.values()]
    groups = [
        (value, rows)
        for value, of_answer in enumerate(numbers, 1)
        for number in range(of_answer.max() + 1)
        if (rows := np.flatnonzero((of_answer == number) & (class_ids == value))).size
    ]
    return _of_groups(scene, list(selections), class_ids, scores, groups, cluster_colours(len(groups))[:-1])


def _of_groups(
    scene: Scene,
    names: Sequence[str],
    classes: np.ndarray,
    scores: np.ndarray,
    groups: Sequence[tuple[int, np.ndarray]],
    colours: np.ndarray,
) -> Labels:
    """Return labels with an instance for each group of splats of a class, in its colour."""
    instances, rows_of = np.zeros(len(classes), np.int32), list[dict[str, Any]]()
    for number, ((value, rows), colour) in enumerate(zip(groups, colours.tolist(), strict=True), 1):
        instances[rows] = number
        entry = {"instance_id": number, "class_id": value, "name": names[value - 1], "colour": colour}
        rows_of.append(entry | _facts(scene, rows, scores))
    return _labels(scene, names, classes, instances, scores, rows_of)


def _of_tree(scene: Scene, tree: SceneTree) -> Labels:
    if not tree.objects or scene.object is None or scene.node is None or scene.node_parents is None:
        raise InvalidQuery("source", expected="a lift with objects", got=tree.explanation, hint="export words")
    names = list(dict.fromkeys(node.name for node in tree.objects if node.name is not None))
    class_of = {name: value for value, name in enumerate(names, 1)}
    colours = cluster_colours(len(scene.node_parents)).tolist()
    numbers, scores = np.zeros(len(scene.node_parents) + 1, np.int32), np.zeros(len(scene.node_parents) + 1)
    nodes = list[dict[str, Any]]()
    for node in tree.nodes:
        numbers[node.id], scores[node.id] = class_of.get(node.name or "", 0), node.score or 0.0
        entry: dict[str, Any] = {"colour": colours[node.id], "score": node.score, "share": node.share}
        entry |= {"views": list(node.views)} | _facts(scene, np.flatnonzero(scene.members(node.id)), None)
        nodes.append(_path(node) | entry | {"box": asdict(node.box)})
    values = numbers[scene.object]  # the last entry is of splats without an object
    instances = [
        {"instance_id": node.id + 1, "class_id": int(numbers[node.id])} | entry
        for node, entry in zip(tree.nodes, nodes, strict=True)
        if node.kind == "object"
    ]
    result = _labels(scene, names, values, scene.object + 1, scores[scene.object] if names else None, instances)
    columns = result.columns | {"node_id": scene.node + 1}
    return Labels(columns, result.document | {"columns": list(columns), "nodes": nodes})


def _path(node: SceneNode) -> dict[str, Any]:
    """Return the position of a node in the tree, by the numbers of the column ``node_id``."""
    path = [number + 1 for number in node.path]
    facts = {"node_id": node.id + 1, "kind": node.kind, "name": node.name, "parent": path[-2] if len(path) > 1 else 0}
    return facts | {"depth": len(path) - 1, "path": path, "parts": [number + 1 for number in node.parts]}


def _labels(
    scene: Scene,
    names: Sequence[str],
    classes: np.ndarray,
    instances: np.ndarray,
    scores: np.ndarray | None,
    instance_rows: list[dict[str, Any]],
) -> Labels:
    columns: dict[str, np.ndarray] = {"class_id": classes.astype(np.int32)} if names else {}
    columns["instance_id"] = instances.astype(np.int32)
    if scores is not None:
        columns["score"] = scores.astype(np.float32)
    if scene.confidence is not None:
        confidence = np.where((classes > 0) | (instances > 0), scene.confidence, 0)
        columns["confidence"] = confidence.astype(np.float32)
    if scene.features.code is not None:
        columns["code"] = scene.features.code.astype(np.int32)
    class_rows = [
        {
            "class_id": value,
            "name": name,
            "splats": int((classes == value).sum()),
            "instances": [row["instance_id"] for row in instance_rows if row["class_id"] == value],
        }
        for value, name in enumerate(names, 1)
    ]
    document = {
        "format": FORMAT,
        "made_by": f"splatlift {__version__}",
        "splats": len(classes),
        "columns": list(columns),
        "world": scene.world.model_dump(mode="json"),
        "unit": scene.world.unit,
        "classes": class_rows,
        "instances": instance_rows,
    }
    return Labels(columns, document)


def _facts(scene: Scene, rows: np.ndarray, scores: np.ndarray | None) -> dict[str, Any]:
    """Summarise splats: their number, their means of scores and confidence by total weight, and their boxes."""
    weights = scene.weights_of(rows)
    facts: dict[str, Any] = {"splats": len(rows)}
    if scores is not None:
        facts["score"] = float(np.average(scores[rows], weights=weights))
    if scene.confidence is not None:
        facts["confidence"] = float(np.average(scene.confidence[rows], weights=weights))
    inside = ~is_outlier(scene.splats, rows, weights)
    boxes = _boxes(scene.splats.positions(rows[inside]).astype(np.float64), weights[inside])
    return facts | boxes | {"size": [scene.world.length(2 * half) for half in boxes["oriented_box"]["half_sizes"]]}


def _boxes(means: np.ndarray, weights: np.ndarray) -> dict[str, Any]:
    """Compute the axis-aligned box of splat centres, and the box along their principal axes.

    Both leave out a thousandth of the total weight at each end of each axis.
    """
    middle = np.average(means, axis=0, weights=weights)
    spread = (means - middle).T @ ((means - middle) * weights[:, None])
    axes = np.linalg.eigh(spread)[1][:, ::-1].T  # rows, the longest first
    axes[2] = np.cross(axes[0], axes[1])  # right-handed
    ends = np.array([*trimmed_box((means - middle) @ axes.T, weights)])
    return {
        "box": asdict(trimmed_box(means, weights)),
        "oriented_box": {
            "centre": (middle + ends.mean(axis=0) @ axes).tolist(),
            "axes": axes.tolist(),
            "half_sizes": ((ends[1] - ends[0]) / 2).tolist(),
        },
    }
