"""COCO's JSON of masks: the visible pixels of each labelled instance in each view."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.scene import Scene
from liftcore.query.segment import label_map

if TYPE_CHECKING:
    from liftcore.io.labels import Labels


def masks_json(scene: Scene, labels: Labels, views: Sequence[str] | None = None) -> Iterator[bytes]:
    """Write the masks of all instances in views, in blocks, a view at a time.

    A pixel belongs to the instance with the most weight on its ray, in the photo's pixels. Masks are uncompressed run
    lengths, column by column. ``image_id`` counts from 1, ``category_id`` is the class, 0 without a name.

    Args:
        views: their names; None: the lifted ones.
    """
    instances = {row["instance_id"]: row for row in labels.document["instances"]}
    if not instances:
        raise InvalidQuery("source", expected="labels with instances", got="none", hint="export other words")
    kinds = {row["class_id"]: row["name"] for row in labels.document["classes"]}
    if any(row["class_id"] not in kinds for row in instances.values()):
        kinds[0] = "object"
    head = {
        "info": {"description": "instances of a lift in its views", "contributor": labels.document["made_by"]}
        | {name: labels.document[name] for name in ("world", "unit")},
        "categories": [{"id": number, "name": name} for number, name in sorted(kinds.items())],
    }
    view_names = scene.metadata.views if views is None else views

    def blocks() -> Iterator[bytes]:
        images, numbers = [], itertools.count(1)
        yield json.dumps(head, ensure_ascii=False)[:-1].encode() + b', "annotations": ['
        for place, view in enumerate(view_names, 1):
            number_map = label_map(scene, labels.columns["instance_id"], view)
            height, width = number_map.shape
            images.append({"id": place, "file_name": view, "width": width, "height": height})
            for annotation in _annotations(number_map, instances):
                entry = {"id": next(numbers), "image_id": place} | annotation
                yield (", " if entry["id"] > 1 else "").encode() + json.dumps(entry).encode()
        yield b'], "images": ' + json.dumps(images, ensure_ascii=False).encode() + b"}\n"

    return blocks()


def _annotations(number_map: np.ndarray, rows: dict[int, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield the annotation of each number above 0 in [H, W] i32: its mask, with the fields of its row."""
    from scipy.ndimage import find_objects

    for number, place in enumerate(find_objects(number_map), 1):
        if place is None:
            continue
        row, (down, across), lengths = rows[number], place, run_lengths(number_map == number)
        yield {
            "category_id": row["class_id"],
            "instance_id": number,
            "segmentation": {"size": [*number_map.shape], "counts": lengths},
            "area": sum(lengths[1::2]),
            "bbox": [across.start, down.start, across.stop - across.start, down.stop - down.start],
            "iscrowd": 0,
            **({"score": row["score"]} if row.get("score") is not None else {}),
        }


def run_lengths(mask: np.ndarray) -> list[int]:
    """Compute COCO's uncompressed run lengths of a mask [H, W] bool, column by column; the first is of False."""
    edges = np.flatnonzero(np.diff(mask.ravel(order="F"), prepend=False))
    return np.diff(edges, prepend=0, append=mask.size).tolist()
