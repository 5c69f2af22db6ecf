"""What every splat is, for other programs: numbers a splat, and a document of what they mean.

Every source gives the same: a segmentation has words as classes and groups of splats that touch as instances, an
answer its texts as the one class and its objects as instances, a catalogue the things of the lift.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidLift, InvalidQuery
from liftcore.io.labels import FORMAT, Labels
from liftcore.query.catalogue import Catalogue
from liftcore.query.colours import cluster_colours
from liftcore.query.objects import LEAST_EVIDENCE, objects, trimmed_box
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.query.question import Answer, SceneNode, SceneObject, SceneTree
from liftcore.runtime.version import __version__
from liftcore.scene.touching import touching

if TYPE_CHECKING:
    from liftcore.query.segment import Segmentation

FRAMES = {
    "colmap": "that of the COLMAP model that was lifted: right-handed, its unit",
    "file": "that of the splat file that was lifted, with x, y and z as its PLY has them",
}


def labels(scene: OpenedLift, source: Segmentation | Answer | Mapping[str, Answer] | Catalogue | SceneTree) -> Labels:
    """The labels of a segmentation, of answers, or of the objects of a lift, with their parts where it is its tree.

    Of a segmentation ``class_id`` is the value of a splat's word (`Segmentation.values`), ``instance_id`` counts
    groups of splats of one word that touch (`liftcore.scene.touching`), with the most evidence first; groups with
    less than a twentieth of the evidence of their word's largest have a class alone. Of an answer every selected
    splat has class 1, and the instances are its objects. Of several answers, by names, each is a class; a splat that
    several select is of the one whose threshold it passes by most. Of a catalogue the instances are its objects, and
    the classes their names; without names there are none. Of a tree they are those of its objects, and ``node_id`` is
    the smallest node of a splat, an object, a part or a group: its id and one more. 0 is none of all. ``score`` is
    the cosine to the word, or the answer's score. ``confidence`` is the lift's, where it was reweighted; other lifts
    have none.

    Raises:
        InvalidQuery: nothing was found, or more splats than objects are made of.
        InvalidLift: the splats moved or changed since the lift.
    """
    parts = dict(source) if isinstance(source, Mapping) else {None: source}  # a copy: theirs may change
    if (
        scene.labelled is None
        or not _are_same(scene.labelled[0], parts)
        or scene.labelled[1].document["world"] != scene.world.model_dump(mode="json")
    ):
        if isinstance(source, Answer | Mapping):
            made = _of_answers(scene, {_name(source): source} if isinstance(source, Answer) else source)
        else:
            of_objects = isinstance(source, Catalogue | SceneTree)
            made = _of_objects(scene, source) if of_objects else _of_words(scene, source)
        scene.labelled = parts, made
    columns: Labels = scene.labelled[1]
    return columns


def _are_same(parts: Mapping[Any, Any], others: Mapping[Any, Any]) -> bool:
    return list(parts) == list(others) and all(part is others[name] for name, part in parts.items())


def _name(answer: Answer) -> str:
    return ", ".join(map(str, (*answer.query.positives, *answer.query.sets)))


def _of_words(scene: OpenedLift, segmentation: Segmentation) -> Labels:
    values, colours = segmentation.values, segmentation.colours.tolist()
    instances, told = np.zeros(len(values), np.int32), list[dict[str, Any]]()
    for value, named in enumerate(segmentation.found, 1):
        rows = np.flatnonzero(values == value)
        weights = _weights(scene, rows)
        groups = touching(scene.splats, rows)
        sums = np.bincount(groups, weights)
        for group in np.argsort(-sums, kind="stable")[: int((sums >= LEAST_EVIDENCE * sums.max()).sum())].tolist():
            own = rows[groups == group]
            instances[own] = len(told) + 1
            one = {"instance_id": len(told) + 1, "class_id": value, "name": named.word, "question": named.word}
            told.append(one | {"colour": colours[value]} | _facts(scene, own, segmentation.score))
    classes = [
        {
            "class_id": value,
            "name": named.word,
            "colour": colours[value],
            "splats": named.splats,
            "score": named.score,
            "margin": named.margin,
            "box": {"low": named.box[0], "high": named.box[1]},
        }
        for value, named in enumerate(segmentation.found, 1)
    ]
    return _labels(scene, values, instances, segmentation.score, classes, told)


def _of_answers(scene: OpenedLift, answers: Mapping[str, Answer]) -> Labels:
    found = {name: (one, objects(scene, one)) for name, one in answers.items() if one.count and not one.dropped}
    if not found:
        first = next(iter(answers.values()))
        got = first.why.rstrip(".") if first.dropped else "none above the threshold"
        raise InvalidQuery("source", expected="an answer that found splats", got=got, hint="ask in other words")
    count = len(scene.features)
    chosen, best = np.zeros(count, np.int32), np.full(count, -np.inf)
    scores, instances = np.zeros(count, np.float32), np.zeros(count, np.int32)
    for value, (answer, _) in enumerate(found.values(), 1):
        cut = answer.threshold.value
        over = (answer.scores - cut) / max(float(answer.scores.max()) - cut, 1e-9)  # as the page colours them
        better = answer.selected & ((over > best) | (chosen == 0))
        chosen[better], best[better], scores[better] = value, over[better], answer.scores[better]
    colours = cluster_colours(sum(len(things.objects) for _, things in found.values())).tolist()
    told, classes = list[dict[str, Any]](), list[dict[str, Any]]()
    for value, (name, (answer, things)) in enumerate(found.items(), 1):
        classes.append({"class_id": value, "name": name, "splats": int((chosen == value).sum()), "question": name})
        for number in range(len(things.objects)):
            rows = np.flatnonzero((things.numbers == number) & (chosen == value))
            if not rows.size:
                continue
            instances[rows] = len(told) + 1
            one = {"instance_id": len(told) + 1, "class_id": value, "name": name, "question": name}
            told.append(one | {"colour": colours[len(told)]} | _facts(scene, rows, answer.scores))
    return _labels(scene, chosen, instances, scores, classes, told)


def _of_objects(scene: OpenedLift, source: Catalogue | SceneTree) -> Labels:
    objects: Sequence[SceneObject]
    if isinstance(source, SceneTree):
        objects = [one for one in source.nodes if one.kind == "object"]
    else:
        objects = source.objects
    if not objects or scene.object is None or scene.object_views is None:
        raise InvalidQuery("source", expected="a lift with objects", got=source.explanation, hint="export words")
    names = list(dict.fromkeys(one.name for one in objects if one.name is not None))
    class_of = {name: value for value, name in enumerate(names, 1)}
    colours = cluster_colours(len(scene.object_views if scene.node_parents is None else scene.node_parents)).tolist()
    numbers, told = np.zeros(len(scene.object_views) + 1, np.int32), []  # the last is of -1
    scores = np.zeros(len(scene.object_views) + 1, np.float32)
    for one in objects:
        numbers[one.id] = class_of.get(one.name or "", 0)
        scores[one.id] = one.score or 0.0
        entry: dict[str, Any] = {"instance_id": one.id + 1, "class_id": int(numbers[one.id]), "name": one.name}
        told.append(entry | _described(scene, one, colours[one.id]))
    values = numbers[scene.object]
    classes = [
        {"class_id": value, "name": name, "splats": int((values == value).sum())}
        for value, name in enumerate(names, 1)
    ]
    made = _labels(scene, values, scene.object + 1, scores[scene.object] if names else None, classes, told)
    if scene.node is None or not isinstance(source, SceneTree):
        return made
    listed = [_path(one) | _described(scene, one, colours[one.id]) for one in source.nodes]
    for entry, node in zip(
        made.document["instances"], (one for one in source.nodes if one.kind == "object"), strict=True
    ):
        entry.update(_path(node))
    columns = made.columns | {"node_id": scene.node + 1}
    return Labels(columns, made.document | {"columns": list(columns), "nodes": listed})


def _path(one: SceneNode) -> dict[str, Any]:
    """Where a node is in the tree, by the numbers of the column ``node_id``."""
    path = [node + 1 for node in one.path]
    facts = {"node_id": one.id + 1, "kind": one.kind, "name": one.name, "parent": path[-2] if len(path) > 1 else 0}
    return facts | {"depth": len(path) - 1, "path": path, "parts": [node + 1 for node in one.parts]}


def _described(scene: OpenedLift, one: SceneObject, colour: list[int]) -> dict[str, Any]:
    facts = _facts(scene, np.flatnonzero(scene.members(one.id)), None)
    entry = {"colour": colour, "score": one.score, "share": one.share, "views": list(one.views)} | facts
    return entry | {"box": {"low": one.box[0], "high": one.box[1]}}


def _labels(
    scene: OpenedLift,
    classes: np.ndarray,
    instances: np.ndarray,
    scores: np.ndarray | None,
    class_rows: Sequence[dict[str, Any]],
    instance_rows: Sequence[dict[str, Any]],
) -> Labels:
    columns: dict[str, np.ndarray] = {"class_id": classes.astype(np.int32)} if class_rows else {}
    columns["instance_id"] = instances.astype(np.int32)
    if scores is not None:
        columns["score"] = scores.astype(np.float32)
    if scene.confidence is not None:
        confidence = np.where((classes > 0) | (instances > 0), as_numpy(scene.confidence), 0)
        columns["confidence"] = confidence.astype(np.float32)
    frame, source = _frame(scene), f"splatlift {__version__}"
    told = scene.metadata
    provenance = ", ".join(filter(None, (source, told.encoder, told.text_space, f"{len(told.views)} views")))
    members: dict[int, list[int]] = {}
    for one in instance_rows:
        members.setdefault(one["class_id"], []).append(one["instance_id"])
    document = {
        "format": FORMAT,
        "made_by": source,
        "splats": len(classes),
        "columns": list(columns),
        "frame": frame,
        "frame_is": FRAMES[frame],
        "world": scene.world.model_dump(mode="json"),
        "unit": scene.world.unit,
        "classes": [one | {"instances": members.get(one["class_id"], [])} for one in class_rows],
        "instances": [one | {"provenance": provenance} for one in instance_rows],
    }
    return Labels(columns, document)


def _weights(scene: OpenedLift, rows: np.ndarray) -> np.ndarray:
    weights = scene.evidence[rows].astype(np.float64)
    return weights if weights.any() else np.ones(len(rows))


def _facts(scene: OpenedLift, rows: np.ndarray, scores: np.ndarray | None) -> dict[str, Any]:
    """How many splats, their means of scores and confidence by evidence, and their boxes."""
    weights = _weights(scene, rows)
    facts: dict[str, Any] = {"splats": len(rows)}
    if scores is not None:
        facts["score"] = float(np.average(scores[rows], weights=weights))
    if scene.confidence is not None:
        facts["confidence"] = float(np.average(as_numpy(scene.confidence)[rows], weights=weights))
    boxes = _boxes(scene.splats.positions(rows).astype(np.float64), weights)
    return facts | boxes | {"size": [scene.world.length(2 * half) for half in boxes["oriented_box"]["half_sizes"]]}


def _boxes(means: np.ndarray, weights: np.ndarray) -> dict[str, Any]:
    """The axis-aligned box of some splats' centres, and one along their principal axes.

    Both leave a thousandth of the evidence out at each end of each axis.
    """
    low, high = trimmed_box(means, weights)
    middle = np.average(means, axis=0, weights=weights)
    spread = (means - middle).T @ ((means - middle) * weights[:, None])
    axes = np.linalg.eigh(spread)[1][:, ::-1].T  # rows, the longest first
    axes[2] = np.cross(axes[0], axes[1])  # right-handed
    ends = np.array(trimmed_box((means - middle) @ axes.T, weights))
    return {
        "box": {"low": low, "high": high},
        "oriented_box": {
            "centre": (middle + ends.mean(axis=0) @ axes).tolist(),
            "axes": axes.tolist(),
            "half_sizes": ((ends[1] - ends[0]) / 2).tolist(),
        },
    }


def _frame(scene: OpenedLift) -> str:
    """Whose frame boxes and splats are in, as far as the lift's files tell."""
    from liftcore.io.cameras import camera_source

    try:
        cameras, path = scene.cameras, Path(scene.metadata.cameras.path)
    except InvalidLift:
        return "file"
    moved = cameras.frame is not None or cameras.of_nerfstudio
    is_colmap = bool(path.name) and (
        camera_source(path, scene.metadata.views).model is not None or zipfile.is_zipfile(path)
    )
    return "colmap" if is_colmap and not moved else "file"
