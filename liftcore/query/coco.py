"""COCO's JSON of masks: where each instance of some labels shows in each view."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.opened import OpenedLift
from liftcore.query.segment import value_map

if TYPE_CHECKING:
    from liftcore.io.labels import Labels


def masks_json(
    scene: OpenedLift,
    labels: Labels,
    views: Sequence[str] | None = None,
    on_view: Callable[[str, np.ndarray], None] | None = None,
) -> Iterator[bytes]:
    """The masks of all instances in views, in blocks, a view at a time.

    A pixel is of the instance with the most weight on its ray, in the photo's own pixels. Masks are uncompressed run
    lengths, column by column. ``image_id`` counts from 1, ``category_id`` is the class, 0 without a name. Parts,
    which labels of a tree have, have masks too: a pixel is of the smallest node with the most weight, and its path.

    Args:
        views: their names; None: those that were lifted. on_view: is given each with the instances [H, W] i32 of its
            pixels, 0 for none, before its block.

    Raises:
        InvalidQuery: the labels have no instances.
        InvalidLift: the cameras or splats moved or changed since the lift.
    """
    instances = {one["instance_id"]: one for one in labels.document["instances"]}
    if not instances:
        raise InvalidQuery("source", expected="labels with instances", got="none", hint="export other words")
    kinds = {one["class_id"]: one["name"] for one in labels.document["classes"]}
    parts = {one["node_id"]: one for one in labels.document.get("nodes", []) if one["kind"] == "part"}
    class_of = {name: number for number, name in kinds.items()}
    for number, one in parts.items():
        class_id = class_of.setdefault(one["name"], len(class_of) + 1) if one["name"] else 0
        parts[number] = one | {"class_id": class_id}
    kinds |= {number: name for name, number in class_of.items()}
    if any(one["class_id"] not in kinds for one in (*instances.values(), *parts.values())):
        kinds[0] = "object"
    head = {
        "info": {"description": "instances of a lift in its views", "contributor": labels.document["made_by"]}
        | {name: labels.document[name] for name in ("world", "unit")},
        "categories": [{"id": number, "name": name} for number, name in sorted(kinds.items())],
    }
    chosen = scene.metadata.views if views is None else views
    return _blocks(scene, labels, instances, parts, head, chosen, on_view)


def _blocks(
    scene: OpenedLift,
    labels: Labels,
    instances: dict[int, dict[str, Any]],
    parts: dict[int, dict[str, Any]],
    head: dict[str, Any],
    views: Sequence[str],
    on_view: Callable[[str, np.ndarray], None] | None,
) -> Iterator[bytes]:
    images, count = [], 0
    depths = _part_tables(labels, parts)
    yield json.dumps(head, ensure_ascii=False)[:-1].encode() + b', "annotations": ['
    for place, view in enumerate(views, 1):
        shown = value_map(scene, labels.columns["instance_id"], view)
        if on_view is not None:
            on_view(view, shown)
        height, width = shown.shape
        images.append({"id": place, "file_name": view, "width": width, "height": height})
        smallest = value_map(scene, labels.columns["node_id"], view) if parts else shown
        maps = [(shown, instances), *((table[smallest], parts) for table in depths)]
        for one in (one for numbers, rows in maps for one in _annotations(numbers, rows)):
            count += 1
            yield (", " if count > 1 else "").encode() + json.dumps({"id": count, "image_id": place} | one).encode()
    yield b'], "images": ' + json.dumps(images, ensure_ascii=False).encode() + b"}\n"


def _part_tables(labels: Labels, parts: dict[int, dict[str, Any]]) -> list[np.ndarray]:
    """For each depth of parts, the part there that each node is of, by their numbers, [nodes + 1] i32; 0 for none."""
    paths = {one["node_id"]: one["path"] for one in labels.document.get("nodes", [])}
    tables = []
    for depth in sorted({one["depth"] for one in parts.values()}):
        table = np.zeros(max(paths) + 1, np.int32)
        for node, path in paths.items():
            table[node] = path[depth] if len(path) > depth and path[depth] in parts else 0
        tables.append(table)
    return tables


def _annotations(shown: np.ndarray, rows: dict[int, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The mask of each number above 0 in [H, W] i32, with what its row says of it."""
    from scipy.ndimage import find_objects

    places = find_objects(shown)
    for number, lengths in run_lengths(shown).items():
        one, (down, across) = rows[number], places[number - 1]
        yield {
            "category_id": one["class_id"],
            **{key: one[key] for key in ("instance_id", "node_id", "parent", "path") if key in one},
            "segmentation": {"size": [*shown.shape], "counts": lengths},
            "area": sum(lengths[1::2]),
            "bbox": [across.start, down.start, across.stop - across.start, down.stop - down.start],
            "iscrowd": 0,
            **({"score": one["score"]} if one.get("score") is not None else {}),
        }


def run_lengths(shown: np.ndarray) -> dict[int, list[int]]:
    """COCO's uncompressed run lengths of each number above 0 in [H, W] i32: column by column, the first run is of
    what comes before it. All are found in one pass, however many there are.
    """
    flat = shown.ravel(order="F")
    begins = np.concatenate([[0], np.flatnonzero(np.diff(flat)) + 1])
    ends = np.append(begins[1:], flat.size)
    order = np.argsort(flat[begins], kind="stable")
    numbers, firsts = np.unique(flat[begins][order], return_index=True)
    found = dict[int, list[int]]()
    for number, runs in zip(numbers.tolist(), np.split(order, firsts[1:]), strict=True):
        edges = np.stack([begins[runs], ends[runs]], axis=1).ravel()
        lengths = np.diff(edges, prepend=0, append=flat.size).tolist()
        if number > 0:
            found[number] = lengths if lengths[-1] else lengths[:-1]
    return found
