"""Answers as files: what was found alone, the whole scene in the colours of its scores, or the scores.

Splat files are copies of the file that was lifted, in its dialect and in the order of its rows: whatever opens that
file opens them, and they can be lifted again.
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

OF_LABELS = ("labelled", "prims", "names", "lines", "masks", "bundle")  # files of what every splat is
FILES = {  # of what a file is made -> the files that there are of it
    "answer": ("object", "coloured", "scores", "selection", "mask", "attention", "overlay", *OF_LABELS),
    "answers": OF_LABELS,
    "segmentation": ("coloured", "labels", "picture", "splat_labels", *OF_LABELS),
    "object": ("object",),
    "catalogue": ("csv", *OF_LABELS),
    "scenetree": OF_LABELS,
    "scene": ("rgb", "depth", "pca", "cluster", "confidence", "splats"),
}

BY_SUFFIX = {  # what a name asks for of many things
    **dict.fromkeys((".glb", ".spz", ".usdc", ".usdz"), "labelled"), ".json": "masks", ".jsonl": "lines",
    ".zip": "bundle",
}  # fmt: skip
OF_CATALOGUE = BY_SUFFIX | {".ply": "labelled"}  # as a segmentation's has its colours


def blocks_of(
    scene: OpenedLift,
    source: Answer | Mapping[str, Answer] | Segmentation | Catalogue | SceneTree | int | None,
    what: str = "",
    *,
    view: str | Camera | None = None,
    suffix: str = "",
    seen: ViewMask | None = None,
    photo: Image | None = None,
) -> Iterable[bytes]:
    """Make a file, in blocks: of an answer, a segmentation, an object of the lift by its id, or the scene.

    Arguments and errors are those of `Scene.blocks_of`; ``what`` is one of FILES.
    """
    kind = "object" if isinstance(source, int) else "scene" if source is None else type(source).__name__.lower()
    kind = "answers" if isinstance(source, Mapping) else kind
    usual = (
        (OF_CATALOGUE if kind == "catalogue" else BY_SUFFIX).get(suffix)
        if kind in ("segmentation", "catalogue", "scenetree", "answers") or suffix == ".zip"
        else None
    )
    what = what or usual or FILES[kind][0]
    if what not in FILES[kind]:
        raise InvalidQuery("what", expected=f"one of {', '.join(FILES[kind])}", got=repr(what))
    if isinstance(source, int):
        return one_object_splats(scene, source, suffix or ".ply")
    if isinstance(source, Mapping | SceneTree) or (source is not None and what in OF_LABELS):
        return _of_labels(scene, source, what, suffix, view)
    if source is None:
        return _of_scene(scene, what, view, suffix)
    if isinstance(source, Catalogue):
        return [table_csv(source)]
    if isinstance(source, Answer):
        return _of_answer(scene, source, what, view, suffix, seen, photo)
    return _of_words(scene, source, what, view)


def _of_scene(scene: OpenedLift, what: str, view: str | Camera | None, suffix: str) -> Iterable[bytes]:
    if what == "splats":
        return splats_as(scene, suffix or ".splat")
    from liftcore.query.render import render_png

    return [render_png(scene, _needed(view), what)]


def _of_answer(
    scene: OpenedLift,
    answer: Answer,
    what: str,
    view: str | Camera | None,
    suffix: str,
    seen: ViewMask | None,
    photo: Image | None,
) -> Iterable[bytes]:
    if what == "object":
        return object_splats(scene, answer, suffix or ".ply")
    if what == "coloured":
        return coloured_ply(scene, answer)
    if what in ("scores", "selection"):
        return [npy(answer.scores if what == "scores" else answer.selected)]
    from liftcore.query.render import attention_png, mask_png, overlay_png, view_mask

    place = answer.query.seen_from() if view is None else view
    seen = view_mask(scene, answer, place) if seen is None else seen
    if what == "overlay":
        named = ", ".join(map(str, answer.query.positives))
        return [overlay_png(scene, seen, place, named, photo)]
    return [mask_png(seen.mask) if what == "mask" else attention_png(seen)]


def _of_words(scene: OpenedLift, found: Segmentation, what: str, view: str | Camera | None) -> Iterable[bytes]:
    from liftcore.query.segment import map_png, named_ply, picture_png, word_map

    if what == "coloured":
        return named_ply(scene, found)
    if what == "splat_labels":
        return [npy(found.values)]
    values = word_map(scene, found, _needed(view))
    if what == "labels":
        return [map_png(values, found)]
    from liftcore.query.render import render

    return [picture_png(render(scene, _needed(view)), values, found)]


def _of_labels(
    scene: OpenedLift,
    source: Answer | Mapping[str, Answer] | Segmentation | Catalogue | SceneTree,
    what: str,
    suffix: str,
    view: str | Camera | None,
) -> Iterable[bytes]:
    from liftcore.io.labels import document_bytes, document_lines
    from liftcore.io.splats import labelled
    from liftcore.query.labels import labels

    made = labels(scene, source)
    if what == "bundle":
        from liftcore.query.bundle import bundle

        return bundle(scene, made, view if isinstance(view, str) else None)
    if what in ("labelled", "prims"):
        prims = what == "prims"
        return labelled(scene.splat_file, made, suffix or (".usdc" if prims else ".ply"), prims=prims)
    if what == "masks":
        from liftcore.query.coco import masks_json

        return masks_json(scene, made)
    return [document_bytes(made) if what == "names" else document_lines(made)]


def _needed(view: str | Camera | None) -> str | Camera:
    if view is None:
        raise InvalidQuery("view", expected="a view's name or a camera", got="nothing")
    return view


def object_splats(scene: OpenedLift, answer: Answer, suffix: str = ".ply") -> Iterable[bytes]:
    """The splats of an answer's objects, as a file in blocks: a PLY with every property to the byte, or another.

    They are those that `objects` and masks show, without strays; of more than are grouped, all that were selected.
    All others but a ``.splat`` have their labels, too.

    Raises:
        InvalidQuery: none was selected, or nothing asked for is there: most viewers open no file without splats; or
            some objects are to be kept, and more were selected than objects are made of.
        InvalidLift: the splats moved or changed since the lift.
    """
    from liftcore.io.splats import labelled, some_rows
    from liftcore.query.labels import labels

    if answer.dropped:
        hint = "absent=keep takes what is most like it; or ask in other words or by example"
        raise InvalidQuery("object", expected="something that is there", got=answer.why.rstrip("."), hint=hint)
    if answer.count == 0:
        raise InvalidQuery(
            "object",
            expected="splats at or above the threshold",
            got=f"none of {len(answer.scores)}: nothing stands out",
            hint="name a lower threshold, or ask in other words or by example",
        )
    whole = answer.count > MOST_SPLATS and not answer.query.keeps_some
    kept = answer.selected if whole else objects(scene, answer).numbers >= 0
    if suffix in (".glb", ".spz", ".usdc", ".usdz") and not whole:
        return labelled(scene.splat_file, labels(scene, answer), suffix, kept)
    return some_rows(scene.splat_file, kept, suffix, scene.world)


def coloured_ply(scene: OpenedLift, answer: Answer) -> Iterable[bytes]:
    """All splats in the colours of their scores, as a file in blocks.

    The colour map spans the scores of the seen splats as a picture of the attention spans its pixels. Splats without
    a score are grey, and so are all where nothing asked for is there. Colours are the same from everywhere; all else
    is kept to the byte.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
        InvalidSplats: their file holds no colours; told when the first block is asked for.
    """
    from liftcore.io.splats import recoloured

    colours = heat_colours(answer.scores, answer.seen)
    colours[~answer.seen | answer.dropped] = NOT_SEEN_COLOUR
    return recoloured(scene.splat_file, colours)


def npy(values: np.ndarray) -> bytes:
    """Values of splats, such as an answer's scores [P] f32, as an ``.npy`` file."""
    content = io.BytesIO()
    np.save(content, values)
    return content.getvalue()


def array_blocks(values: np.ndarray, what: str = "") -> list[bytes]:
    """An array as ``npy``, or a mask [H, W] of booleans as PNG: ``mask``."""
    from liftcore.query.render import mask_png

    return [mask_png(values) if what == "mask" else npy(values)]


def splats_as(scene: OpenedLift, suffix: str) -> Iterator[bytes]:
    """The splats of the scene in another format, in the lift's order, in blocks; ``.splat`` is that of web viewers.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
        InvalidSplats: the format is not written.
    """
    from liftcore.io.splats import blocks_as

    return blocks_as(replace(scene.splats, world=scene.world), suffix)


def layer_colours(scene: OpenedLift, what: str) -> np.ndarray:
    """Colours of all splats, [P, 3] u8 sRGB.

    ``pca`` are three principal components of the features, ``cluster`` a colour a cluster; ``evidence`` (by its
    logarithm), ``agreement`` and ``confidence`` go through the colour map of scores. Splats without a feature are
    grey.

    Raises:
        InvalidQuery: clusters or confidence are asked for, and the lift has none.
    """
    if what == "pca":
        colours = np.round(255 * scene.principal.numpy()).astype(np.uint8)
    elif what == "cluster":
        if scene.cluster is None or scene.cluster_features is None:
            hint = "lift again with the setting aggregation=true"
            raise InvalidQuery("what", expected="a lift with clusters", got="a lift without aggregation", hint=hint)
        colours = cluster_colours(len(scene.cluster_features))[scene.cluster]
    else:
        told = getattr(scene.lift, what)
        if told is None:
            hint = "lift again with the setting robust_steps=1"
            got = "a lift without reweighting"
            raise InvalidQuery("what", expected=f"a lift with {what}", got=got, hint=hint)
        values = as_numpy(told).astype(np.float32)
        known = scene.seen & np.isfinite(values)
        if what == "evidence":
            known &= values > 0
            values = np.log(np.where(known, values, 1.0))
        colours = heat_colours(values, known)
    colours[~scene.seen] = NOT_SEEN_COLOUR
    return colours
