"""Answers, segmentations, objects and scenes as files (`FILES`).

Splat files are copies of the lifted file, in its dialect and row order: programs that open that file open them, too,
and they can be lifted again.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.io.labels import document_bytes
from liftcore.io.splats import blocks_as, labelled, recoloured, some_rows
from liftcore.query.coco import masks_json
from liftcore.query.colours import NOT_SEEN_COLOUR, heat_colours
from liftcore.query.labels import labels
from liftcore.query.objects import MOST_SPLATS, objects
from liftcore.query.question import Answer
from liftcore.query.scene import Scene
from liftcore.query.segment import label_map, map_png, picture_png
from liftcore.query.tree import table_csv

if TYPE_CHECKING:  # these load torch
    from PIL.Image import Image

    from liftcore.query.render import ViewMask
    from liftcore.scene.cameras import Camera


@dataclass(frozen=True)
class Export:
    """Source and options of a file."""

    scene: Scene
    source: Any  # as `Scene.blocks_of` has it, without queries
    content: str  # of FILES
    view: str | Camera | None
    suffix: str
    view_mask: ViewMask | None
    photo: Image | None

    def require_view(self) -> str | Camera:
        """Return the view; InvalidQuery without one."""
        if self.view is None:
            raise InvalidQuery("view", expected="a view's name or a camera", got="nothing")
        return self.view


def blocks_of(export: Export) -> Iterable[bytes]:
    """Make a file, in blocks: of an answer, a segmentation, an object of the lift by its id, or the scene.

    Errors are those of `Scene.blocks_of`. Empty ``content``: what the suffix or the kind of the source has first.
    """
    source, content = export.source, export.content
    kinds = {Mapping: "answers", np.ndarray: "array", int: "object", type(None): "scene"}
    kind = next((kinds[base] for base in kinds if isinstance(source, base)), type(source).__name__.lower())
    if kind not in FILES:
        hint = "of a selection ask Query(sets=['selection:NAME'])"
        expected = "an answer, a segmentation, a tree, an array, or the number of an object"
        raise InvalidQuery("source", expected=expected, got=kind, hint=hint)
    files = FILES[kind]
    if kind in ("segmentation", "scenetree", "answers"):
        by_suffix = BY_SUFFIX | ({".ply": "labelled"} if kind == "scenetree" else {})
        content = content or by_suffix.get(export.suffix, "")
    content = content or next(iter(files))
    if content not in files:
        raise InvalidQuery("content", expected=f"one of {', '.join(files)}", got=repr(content))
    return files[content](replace(export, content=content))


def _of_scene(export: Export) -> Iterable[bytes]:
    from liftcore.query.render import render_png

    return [render_png(export.scene, export.require_view(), export.content)]


def _of_view(export: Export) -> Iterable[bytes]:
    """Return the picture of an answer in a view."""
    from liftcore.query.render import attention_png, mask_png, overlay_png, view_mask

    place = export.source.query.seen_from() if export.view is None else export.view
    in_view = view_mask(export.scene, export.source, place) if export.view_mask is None else export.view_mask
    if export.content == "overlay":
        caption = ", ".join(map(str, export.source.query.positives))
        return [overlay_png(export.scene, in_view, place, caption, export.photo)]
    return [mask_png(in_view.mask) if export.content == "mask" else attention_png(in_view)]


def _of_words(export: Export) -> Iterable[bytes]:
    """Return the map or the picture of a segmentation in a view."""
    from liftcore.query.render import render

    labels = label_map(export.scene, export.source.labels, export.require_view())
    if export.content == "map":
        return [map_png(labels, export.source)]
    return [picture_png(render(export.scene, export.require_view()), labels, export.source)]


def _of_labels(export: Export) -> Iterable[bytes]:
    columns = labels(export.scene, export.source)
    if export.content == "labelled":
        return labelled(export.scene.splat_file, columns, export.suffix or ".ply")
    if export.content == "masks":
        return masks_json(export.scene, columns, [export.view] if isinstance(export.view, str) else None)
    return [document_bytes(columns)]


def object_splats(scene: Scene, answer: Answer, suffix: str = ".ply") -> Iterable[bytes]:
    """Write the splats of an answer's objects as a file, in blocks; a PLY has all their properties unchanged.

    They are those of `objects` and masks, without unassigned splats; of more than are grouped, all selected ones.
    A ``.glb`` and USD have their labels, too.

    Raises:
        InvalidQuery: no splat is selected, or the object is absent: most viewers open no file without splats; or
            the query keeps some objects, and more splats are selected than are grouped.
        InvalidLift: the splats moved or changed since the lift.
    """
    if answer.is_dropped:
        hint = "absent=keep selects the most similar splats; or ask in other words or by example"
        raise InvalidQuery("object", expected="an object in the scene", got=answer.reason.rstrip("."), hint=hint)
    is_ungrouped = answer.count > MOST_SPLATS and not answer.query.keeps_some
    mask = answer.selected if is_ungrouped else objects(scene, answer).numbers >= 0
    if not mask.any():
        got = f"{answer.count} in smaller objects" if answer.count else f"none of {len(mask)}: nothing stands out"
        expected = f"splats at or above the threshold, in objects of {answer.query.min_size} or more"
        hint = "name a lower threshold or min_size, or ask in other words or by example"
        raise InvalidQuery("object", expected=expected, got=got, hint=hint)
    if suffix in (".glb", ".usdc", ".usdz") and not is_ungrouped:
        return labelled(scene.splat_file, labels(scene, answer), suffix, mask)
    return some_rows(scene.splat_file, mask, suffix, scene.world)


def score_colours(answer: Answer) -> np.ndarray:
    """Colour all splats by their scores, [P, 3] u8 sRGB.

    The colour map spans the scores of splats with a feature, as a picture of the attention spans its pixels. Splats
    without a score are grey, and so are all splats if the object is absent.
    """
    colours = heat_colours(answer.scores, answer.has_feature)
    colours[~answer.has_feature | answer.is_dropped] = NOT_SEEN_COLOUR
    return colours


def npy(values: np.ndarray) -> bytes:
    """Write values of splats, such as an answer's scores [P] f32, as an ``.npy`` file."""
    content = io.BytesIO()
    np.save(content, values)
    return content.getvalue()


Files = dict[str, Callable[[Export], Iterable[bytes]]]
OF_LABELS: Files = {"labelled": _of_labels, "names": _of_labels, "masks": _of_labels}  # with labels of all splats
FILES: dict[str, Files] = {  # kind of a source -> the files that are made of it
    "answer": {
        "object": lambda export: object_splats(export.scene, export.source, export.suffix or ".ply"),
        "coloured": lambda export: recoloured(export.scene.splat_file, score_colours(export.source)),
        "scores": lambda export: [npy(export.source.scores)],
        "selection": lambda export: [npy(export.source.selected)],
        **dict.fromkeys(("mask", "attention", "overlay"), _of_view),
        **OF_LABELS,
    },
    "answers": OF_LABELS,
    "segmentation": {
        "coloured": lambda export: recoloured(export.scene.splat_file, export.source.colours[export.source.labels]),
        "labels": lambda export: [npy(export.source.labels)],
        **dict.fromkeys(("map", "picture"), _of_words),
        **OF_LABELS,
    },
    "object": {
        "object": lambda export: some_rows(
            export.scene.splat_file, export.scene.members(export.source), export.suffix or ".ply", export.scene.world
        )
    },
    "scenetree": {"csv": lambda export: [table_csv(export.source)], **OF_LABELS},
    "scene": {
        **dict.fromkeys(("rgb", "depth", "pca", "cluster", "confidence"), _of_scene),
        "splats": lambda export: blocks_as(
            replace(export.scene.splats, world=export.scene.world), export.suffix or ".splat"
        ),
    },
    "array": {"npy": lambda export: [npy(export.source)]},
}
BY_SUFFIX = {  # suffix of a name -> file of sources with several classes
    **dict.fromkeys((".glb", ".spz", ".splat", ".usdc", ".usdz"), "labelled"), ".json": "masks",
}  # fmt: skip
