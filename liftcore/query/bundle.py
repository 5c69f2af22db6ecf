"""Labels as one ZIP: splats with their numbers; names, boxes and counts of classes and instances; masks of views."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Iterator
from tempfile import SpooledTemporaryFile
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.io.labels import document_bytes
from liftcore.query.coco import masks_json
from liftcore.query.opened import OpenedLift

if TYPE_CHECKING:
    from liftcore.io.labels import Labels

MOST_TRUTH = 1 << 25  # pixels of masks that are collected for ``truth.safetensors``; with more it is left out
IN_MEMORY = 16 << 20  # bytes of the masks' JSON in memory, before they go to a temporary file
MASK_CHARACTERS = str.maketrans('/\\:*?"<>|', "_________")  # characters that file names cannot have
SIZE = 18  # pixels of a line of the legend


def bundle(scene: OpenedLift, labels: Labels, view: str | None = None) -> Iterator[bytes]:
    """Write a ZIP, in blocks: ``labels.ply``, ``labels.json``, ``instances.csv``, ``legend.png``, and masks of views.

    ``masks/VIEW.png`` has the number of the instance with the most weight on each pixel, as a palette in the legend's
    colours; ``masks.json`` has the same as COCO. ``truth.safetensors`` has the classes from 0, and -1 for none: masks
    with which a trade-off evaluates lifts. It is left out above MOST_TRUTH pixels.

    Args:
        view: the only view with masks; None: all lifted views.

    Raises:
        InvalidQuery: the labels have no instances.
        NotFound, InvalidLift: no such view; splats or cameras moved or changed since the lift.
    """
    instances = labels.document["instances"]
    if not instances:
        raise InvalidQuery("source", expected="labels with instances", got="none", hint="export other words")
    return _zipped(_entries(scene, labels, view))


def _entries(scene: OpenedLift, labels: Labels, view: str | None) -> Iterator[tuple[str, Iterator[bytes] | bytes]]:
    from safetensors.numpy import save

    from liftcore.io.splats import labelled
    from liftcore.query.segment import palette_png

    instances = labels.document["instances"]
    yield "labels.json", document_bytes(labels)
    yield "instances.csv", _table(instances)
    yield "legend.png", legend_png([(_title(instance), tuple(instance["colour"])) for instance in instances])
    yield "labels.ply", iter(labelled(scene.splat_file, labels, ".ply"))
    highest = max(instance["instance_id"] for instance in instances)
    names, colours, kinds = [""] * highest, np.zeros((highest + 1, 3), np.uint8), np.full(highest + 1, -1, np.int16)
    for instance in instances:
        names[instance["instance_id"] - 1], colours[instance["instance_id"]] = _title(instance), instance["colour"]
        kinds[instance["instance_id"]] = instance["class_id"] - 1  # the first of a trade-off's classes is 0
    pictures, truth = dict[str, bytes](), dict[str, np.ndarray]()

    def keep(name: str, numbers: np.ndarray) -> None:
        pictures[name] = palette_png(numbers, names, colours)
        if sum(map(np.size, truth.values())) < MOST_TRUTH:
            truth[f"{name}/mask"] = kinds[numbers]

    views = scene.metadata.views if view is None else (view,)
    with SpooledTemporaryFile(IN_MEMORY) as coco:
        for block in masks_json(scene, labels, views, keep):
            coco.write(block)
            for name in list(pictures):
                yield f"masks/{name.translate(MASK_CHARACTERS)}.png", pictures.pop(name)
        coco.seek(0)
        yield "masks.json", iter(lambda: coco.read(1 << 20), b"")
    if sum(map(np.size, truth.values())) < MOST_TRUTH:
        yield "truth.safetensors", save(truth)


def _zipped(entries: Iterator[tuple[str, Iterator[bytes] | bytes]]) -> Iterator[bytes]:
    """Write files by their names to a ZIP; a file that repeats a name gets a number."""
    sink, unique_names = _Sink(), set[str]()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in entries:
            stem, dot, suffix = name.rpartition(".")
            unique, number = name, 1
            while unique in unique_names:
                number += 1
                unique = f"{stem}-{number}{dot}{suffix}"
            unique_names.add(unique)
            with archive.open(zipfile.ZipInfo(unique, (1980, 1, 1, 0, 0, 0)), "w", force_zip64=True) as file:
                for block in [content] if isinstance(content, bytes) else content:
                    file.write(block)
                    yield from sink.take_blocks()
            yield from sink.take_blocks()
    yield from sink.take_blocks()


class _Sink(io.RawIOBase):
    """Buffer of a ZIP's bytes, whose blocks are taken as they are written."""

    def __init__(self) -> None:
        self._blocks: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, block: Any) -> int:
        self._blocks.append(bytes(block))
        return len(self._blocks[-1])

    def take_blocks(self) -> list[bytes]:
        """Return the blocks written since the last call."""
        blocks, self._blocks = self._blocks, []
        return blocks


def _title(instance: dict[str, Any]) -> str:
    return f"{instance.get('name') or 'object'} {instance['instance_id']}"


def _table(instances: list[dict[str, Any]]) -> bytes:
    """Write a CSV table of instances: numbers, name, colour, splats, score and box."""
    content = io.StringIO(newline="")
    writer = csv.writer(content)
    corners = [f"{end}_{axis}" for end in ("low", "high") for axis in "xyz"]
    writer.writerow(["instance_id", "class_id", "name", "red", "green", "blue", "splats", "score", *corners])
    for instance in instances:
        box, score = instance["box"], instance.get("score")
        head = [
            instance["instance_id"],
            instance["class_id"],
            instance.get("name") or "",
            *instance["colour"],
            instance["splats"],
        ]
        writer.writerow([*head, "" if score is None else f"{score:.6g}", *box["low"], *box["high"]])
    return content.getvalue().encode()


def legend_png(rows: list[tuple[str, tuple[int, ...]]]) -> bytes:
    """Draw names with their colours, a line each, as a PNG."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(SIZE)
    width = int(max(font.getlength(name) for name, _ in rows)) + 3 * SIZE
    canvas = Image.new("RGB", (width, (3 * len(rows) + 1) * SIZE // 2), "white")
    draw = ImageDraw.Draw(canvas)
    for line, (name, colour) in enumerate(rows):
        y = SIZE // 2 + line * 3 * SIZE // 2
        draw.rectangle((SIZE // 2, y, 3 * SIZE // 2, y + SIZE), fill=tuple(colour))
        draw.text((2 * SIZE, y - 2), name, fill="black", font=font)
    content = io.BytesIO()
    canvas.save(content, format="PNG")
    return content.getvalue()
