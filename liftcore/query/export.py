"""Answers as files: the selected splats alone, the whole scene in the colours of its scores, or the scores.

Splat files are copies of the lifted file, in its dialect and row order: programs that open that file open them, too,
and they can be lifted again.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.catalogue import Catalogue, one_object_splats, table_csv
from liftcore.query.colours import NOT_SEEN_COLOUR, cluster_colours, heat_colours
from liftcore.query.objects import MOST_SPLATS, objects
from liftcore.query.opened import OpenedLift, as_numpy
from liftcore.query.question import Answer, SceneTree

if TYPE_CHECKING:  # these load torch
    from PIL.Image import Image

    from liftcore.query.render import ViewMask
    from liftcore.query.segment import Segmentation
    from liftcore.scene.cameras import Camera

OF_LABELS = ("labelled", "names", "masks")  # files with labels of all splats
FILES = {  # kind of a source -> the files that can be made of it
    "answer": ("object", "coloured", "scores", "selection", "mask", "attention", "overlay", *OF_LABELS),
    "answers": OF_LABELS,
    "segmentation": ("coloured", "labels", "picture", "splat_labels", *OF_LABELS),
    "object": ("object",),
    "catalogue": ("csv", *OF_LABELS),
    "scenetree": OF_LABELS,
    "scene": ("rgb", "depth", "pca", "cluster", "confidence", "splats"),
}

BY_SUFFIX = {  # suffix of a name -> file of sources with several classes
    **dict.fromkeys((".glb", ".spz", ".usdc", ".usdz"), "labelled"), ".json": "masks",
}  # fmt: skip
OF_CATALOGUE = BY_SUFFIX | {".ply": "labelled"}  # a segmentation's .ply has its colours instead


def blocks_of(
    scene: OpenedLift,
    source: Answer | Mapping[str, Answer] | Segmentation | Catalogue | SceneTree | int | None,
    content: str = "",
    *,
    view: str | Camera | None = None,
    suffix: str = "",
    view_mask: ViewMask | None = None,
    photo: Image | None = None,
) -> Iterable[bytes]:
    """Make a file, in blocks: of an answer, a segmentation, an object of the lift by its id, or the scene.

    Arguments and errors are those of `Scene.blocks_of`; ``content`` is one of FILES.
    """
    kind = "object" if isinstance(source, int) else "scene" if source is None else type(source).__name__.lower()
    kind = "answers" if isinstance(source, Mapping) else kind
    default = (
        (OF_CATALOGUE if kind == "catalogue" else BY_SUFFIX).get(suffix)
        if kind in ("segmentation", "catalogue", "scenetree", "answers")
        else None
    )
    content = content or default or FILES[kind][0]
    if content not in FILES[kind]:
        raise InvalidQuery("what", expected=f"one of {', '.join(FILES[kind])}", got=repr(content))
    if isinstance(source, int):
        return one_object_splats(scene, source, suffix or ".ply")
    if isinstance(source, Mapping | SceneTree) or (source is not None and content in OF_LABELS):
        return _of_labels(scene, source, content, suffix, view)
    if source is None:
        return _of_scene(scene, content, view, suffix)
    if isinstance(source, Catalogue):
        return [table_csv(source)]
    if isinstance(source, Answer):
        return _of_answer(scene, source, content, view, suffix, view_mask, photo)
    return _of_words(scene, source, content, view)


def _of_scene(scene: OpenedLift, content: str, view: str | Camera | None, suffix: str) -> Iterable[bytes]:
    if content == "splats":
        return splats_as(scene, suffix or ".splat")
    from liftcore.query.render import render_png

    return [render_png(scene, _require_view(view), content)]


def _of_answer(
    scene: OpenedLift,
    answer: Answer,
    content: str,
    view: str | Camera | None,
    suffix: str,
    in_view: ViewMask | None,
    photo: Image | None,
) -> Iterable[bytes]:
    if content == "object":
        return object_splats(scene, answer, suffix or ".ply")
    if content == "coloured":
        return coloured_ply(scene, answer)
    if content in ("scores", "selection"):
        return [npy(answer.scores if content == "scores" else answer.selected)]
    from liftcore.query.render import attention_png, mask_png, overlay_png, view_mask

    place = answer.query.seen_from() if view is None else view
    in_view = view_mask(scene, answer, place) if in_view is None else in_view
    if content == "overlay":
        caption = ", ".join(map(str, answer.query.positives))
        return [overlay_png(scene, in_view, place, caption, photo)]
    return [mask_png(in_view.mask) if content == "mask" else attention_png(in_view)]


def _of_words(
    scene: OpenedLift, segmentation: Segmentation, content: str, view: str | Camera | None
) -> Iterable[bytes]:
    from liftcore.query.segment import map_png, named_ply, picture_png, word_map

    if content == "coloured":
        return named_ply(scene, segmentation)
    if content == "splat_labels":
        return [npy(segmentation.values)]
    values = word_map(scene, segmentation, _require_view(view))
    if content == "labels":
        return [map_png(values, segmentation)]
    from liftcore.query.render import render

    return [picture_png(render(scene, _require_view(view)), values, segmentation)]


def _of_labels(
    scene: OpenedLift,
    source: Answer | Mapping[str, Answer] | Segmentation | Catalogue | SceneTree,
    content: str,
    suffix: str,
    view: str | Camera | None,
) -> Iterable[bytes]:
    from liftcore.io.labels import document_bytes
    from liftcore.io.splats import labelled
    from liftcore.query.labels import labels

    columns = labels(scene, source)
    if content == "labelled":
        return labelled(scene.splat_file, columns, suffix or ".ply")
    if content == "masks":
        from liftcore.query.coco import masks_json

        return masks_json(scene, columns, [view] if isinstance(view, str) else None)
    return [document_bytes(columns)]


def _require_view(view: str | Camera | None) -> str | Camera:
    if view is None:
        raise InvalidQuery("view", expected="a view's name or a camera", got="nothing")
    return view


def object_splats(scene: OpenedLift, answer: Answer, suffix: str = ".ply") -> Iterable[bytes]:
    """Write the splats of an answer's objects as a file, in blocks; a PLY has all their properties unchanged.

    They are those of `objects` and masks, without unassigned splats; of more than are grouped, all selected ones.
    A ``.glb`` and USD have their labels, too.

    Raises:
        InvalidQuery: no splat is selected, or the object is absent: most viewers open no file without splats; or
            the query keeps some objects, and more splats are selected than are grouped.
        InvalidLift: the splats moved or changed since the lift.
    """
    from liftcore.io.splats import labelled, some_rows
    from liftcore.query.labels import labels

    if answer.is_dropped:
        hint = "absent=keep selects the most similar splats; or ask in other words or by example"
        raise InvalidQuery("object", expected="an object in the scene", got=answer.reason.rstrip("."), hint=hint)
    if answer.count == 0:
        raise InvalidQuery(
            "object",
            expected="splats at or above the threshold",
            got=f"none of {len(answer.scores)}: nothing stands out",
            hint="name a lower threshold, or ask in other words or by example",
        )
    is_ungrouped = answer.count > MOST_SPLATS and not answer.query.keeps_some
    mask = answer.selected if is_ungrouped else objects(scene, answer).numbers >= 0
    if suffix in (".glb", ".usdc", ".usdz") and not is_ungrouped:
        return labelled(scene.splat_file, labels(scene, answer), suffix, mask)
    return some_rows(scene.splat_file, mask, suffix, scene.world)


def coloured_ply(scene: OpenedLift, answer: Answer) -> Iterable[bytes]:
    """Write all splats in the colours of their scores as a file, in blocks.

    The colour map spans the scores of splats with a feature, as a picture of the attention spans its pixels. Splats
    without a score are grey, and so are all splats if the object is absent. Colours are the same from all directions;
    all other properties are unchanged.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
        InvalidSplats: their file holds no colours; raised with the first block.
    """
    from liftcore.io.splats import recoloured

    colours = heat_colours(answer.scores, answer.has_feature)
    colours[~answer.has_feature | answer.is_dropped] = NOT_SEEN_COLOUR
    return recoloured(scene.splat_file, colours)


def npy(values: np.ndarray) -> bytes:
    """Write values of splats, such as an answer's scores [P] f32, as an ``.npy`` file."""
    content = io.BytesIO()
    np.save(content, values)
    return content.getvalue()


def array_blocks(values: np.ndarray, content: str = "") -> list[bytes]:
    """Write an array as ``npy``, or a mask [H, W] of booleans as PNG: ``mask``."""
    from liftcore.query.render import mask_png

    return [mask_png(values) if content == "mask" else npy(values)]


def splats_as(scene: OpenedLift, suffix: str) -> Iterator[bytes]:
    """Write the splats of the scene in another format, in the lift's order, in blocks; web viewers read ``.splat``.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
        InvalidSplats: the format is not written.
    """
    from liftcore.io.splats import blocks_as

    return blocks_as(replace(scene.splats, world=scene.world), suffix)


def layer_colours(scene: OpenedLift, layer: str) -> np.ndarray:
    """Colour all splats by a layer, [P, 3] u8 sRGB.

    ``pca`` are three principal components of the features, ``cluster`` a colour a cluster; ``total_weight`` (by its
    logarithm) and ``confidence`` go through the colour map of scores. Splats without a feature
    are grey.

    Raises:
        InvalidQuery: the lift has no clusters, or no confidence.
    """
    if layer == "pca":
        colours = np.round(255 * scene.principal.numpy()).astype(np.uint8)
    elif layer == "cluster":
        if scene.cluster is None or scene.cluster_features is None:
            hint = "lift again with the setting aggregation=true"
            raise InvalidQuery("what", expected="a lift with clusters", got="a lift without aggregation", hint=hint)
        colours = cluster_colours(len(scene.cluster_features))[scene.cluster]
    else:
        tensor = getattr(scene.lift, layer)
        if tensor is None:
            hint = "lift again with the setting robust=true"
            got = "a lift without reweighting"
            raise InvalidQuery("what", expected=f"a lift with {layer}", got=got, hint=hint)
        values = as_numpy(tensor).astype(np.float32)
        valid = scene.has_feature & np.isfinite(values)
        if layer == "total_weight":
            valid &= values > 0
            values = np.log(np.where(valid, values, 1.0))
        colours = heat_colours(values, valid)
    colours[~scene.has_feature] = NOT_SEEN_COLOUR
    return colours
