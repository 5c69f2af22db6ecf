"""COCO's JSON of masks: the visible pixels of each labelled instance in each view."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.opened import OpenedLift
from liftcore.query.segment import value_map

if TYPE_CHECKING:
    from liftcore.io.labels import Labels


def masks_json(scene: OpenedLift, labels: Labels, views: Sequence[str] | None = None) -> Iterator[bytes]:
    """Write the masks of all instances in views, in blocks, a view at a time.

    A pixel belongs to the instance with the most weight on its ray, in the photo's pixels. Masks are uncompressed run
    lengths, column by column. ``image_id`` counts from 1, ``category_id`` is the class, 0 without a name. Parts, in
    labels of a tree, have masks, too: a pixel belongs to the smallest node with the most weight, and to its path.

    Args:
        views: their names; None: the lifted ones.

    Raises:
        InvalidQuery: the labels have no instances.
        InvalidLift: the cameras or splats moved or changed since the lift.
    """
    instances = {row["instance_id"]: row for row in labels.document["instances"]}
    if not instances:
        raise InvalidQuery("source", expected="labels with instances", got="none", hint="export other words")
    kinds = {row["class_id"]: row["name"] for row in labels.document["classes"]}
    parts = {row["node_id"]: row for row in labels.document.get("nodes", []) if row["kind"] == "part"}
    class_of = {name: number for number, name in kinds.items()}
    for number, row in parts.items():
        class_id = class_of.setdefault(row["name"], len(class_of) + 1) if row["name"] else 0
        parts[number] = row | {"class_id": class_id}
    kinds |= {number: name for name, number in class_of.items()}
    if any(row["class_id"] not in kinds for row in (*instances.values(), *parts.values())):
        kinds[0] = "object"
    head = {
        "info": {"description": "instances of a lift in its views", "contributor": labels.document["made_by"]}
        | {name: labels.document[name] for name in ("world", "unit")},
        "categories": [{"id": number, "name": name} for number, name in sorted(kinds.items())],
    }
    view_names = scene.metadata.views if views is None else views
    return _blocks(scene, labels, instances, parts, head, view_names)


def _blocks(
    scene: OpenedLift,
    labels: Labels,
    instances: dict[int, dict[str, Any]],
    parts: dict[int, dict[str, Any]],
    head: dict[str, Any],
    views: Sequence[str],
) -> Iterator[bytes]:
    images, count = [], 0
    depths = _part_tables(labels, parts)
    yield json.dumps(head, ensure_ascii=False)[:-1].encode() + b', "annotations": ['
    for place, view in enumerate(views, 1):
        number_map = value_map(scene, labels.columns["instance_id"], view)
        height, width = number_map.shape
        images.append({"id": place, "file_name": view, "width": width, "height": height})
        smallest = value_map(scene, labels.columns["node_id"], view) if parts else number_map
        maps = [(number_map, instances), *((table[smallest], parts) for table in depths)]
        for annotation in (annotation for numbers, rows in maps for annotation in _annotations(numbers, rows)):
            count += 1
            yield (", " if count > 1 else "").encode() + json.dumps(
                {"id": count, "image_id": place} | annotation
            ).encode()
    yield b'], "images": ' + json.dumps(images, ensure_ascii=False).encode() + b"}\n"


def _part_tables(labels: Labels, parts: dict[int, dict[str, Any]]) -> list[np.ndarray]:
    """Return for each depth of parts the part of each node at this depth, by number, [nodes + 1] i32; 0 for none."""
    paths = {row["node_id"]: row["path"] for row in labels.document.get("nodes", [])}
    tables = []
    for depth in sorted({row["depth"] for row in parts.values()}):
        table = np.zeros(max(paths) + 1, np.int32)
        for node, path in paths.items():
            table[node] = path[depth] if len(path) > depth and path[depth] in parts else 0
        tables.append(table)
    return tables


def _annotations(number_map: np.ndarray, rows: dict[int, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield the annotation of each number above 0 in [H, W] i32: its mask, with the fields of its row."""
    from scipy.ndimage import find_objects

    places = find_objects(number_map)
    for number, lengths in run_lengths(number_map).items():
        row, (down, across) = rows[number], places[number - 1]
        yield {
            "category_id": row["class_id"],
            **{key: row[key] for key in ("instance_id", "node_id", "parent", "path") if key in row},
            "segmentation": {"size": [*number_map.shape], "counts": lengths},
            "area": sum(lengths[1::2]),
            "bbox": [across.start, down.start, across.stop - across.start, down.stop - down.start],
            "iscrowd": 0,
            **({"score": row["score"]} if row.get("score") is not None else {}),
        }


def run_lengths(number_map: np.ndarray) -> dict[int, list[int]]:
    """Compute COCO's uncompressed run lengths of each number above 0 in [H, W] i32, column by column.

    The first run is of the pixels before the number. One pass over the runs finds all numbers.
    """
    flat = number_map.ravel(order="F")
    begins = np.concatenate([[0], np.flatnonzero(np.diff(flat)) + 1])
    ends = np.append(begins[1:], flat.size)
    order = np.argsort(flat[begins], kind="stable")
    numbers, firsts = np.unique(flat[begins][order], return_index=True)
    lengths_of = dict[int, list[int]]()
    for number, runs in zip(numbers.tolist(), np.split(order, firsts[1:]), strict=True):
        edges = np.stack([begins[runs], ends[runs]], axis=1).ravel()
        lengths = np.diff(edges, prepend=0, append=flat.size).tolist()
        if number > 0:
            lengths_of[number] = lengths if lengths[-1] else lengths[:-1]
    return lengths_of
