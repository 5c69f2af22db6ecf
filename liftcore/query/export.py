"""Answers as files: what was found alone, the whole scene in the colours of its scores, or the scores.

Splat files are copies of the file that was lifted, in its dialect and in the order of its rows: whatever opens that
file opens them, and they can be lifted again.
"""

import io
from collections.abc import Iterable, Iterator

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.ask import Answer
from liftcore.query.colours import NOT_SEEN_COLOUR, cluster_colours, heat_colours
from liftcore.query.objects import objects
from liftcore.query.scene import QueryScene, as_numpy
from liftcore.scene.harmonics import SH_C0

_BLOCK_ROWS = 1 << 16
_GREY = 0.6  # of splats whose file holds no colours
_THIN = 0.01  # of a disc's smaller scale: the thickness that it is shown with
_LARGEST_SCALE = 80.0  # log: its exponential is a float32


def object_ply(scene: QueryScene, answer: Answer) -> Iterable[bytes]:
    """The splats that were selected, as a file in blocks; every property of theirs to the byte.

    A query that keeps the largest gets the largest object alone (`objects`).

    Raises:
        InvalidQuery: none was selected: most viewers open no file without splats; or more than objects are made of.
        InvalidLift: the splats moved or changed since the lift.
    """
    from liftcore.io.splats import some_rows

    if answer.count == 0:
        raise InvalidQuery(
            "object",
            expected="splats at or above the threshold",
            got=f"none of {len(answer.scores)}: nothing stands out",
            hint="name a lower threshold, or ask in other words or by example",
        )
    largest = answer.query.keep == "largest"
    return some_rows(scene.splat_file, objects(scene, answer).numbers == 0 if largest else answer.selected)


def coloured_ply(scene: QueryScene, answer: Answer) -> Iterable[bytes]:
    """All splats in the colours of their scores, as a file in blocks.

    The colour map spans the scores of the seen splats as a picture of the attention spans its pixels; splats without
    a score are grey. Colours are the same from everywhere; all else is kept to the byte.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
        InvalidSplats: their file holds no colours; told when the first block is asked for.
    """
    from liftcore.io.splats import recoloured

    colours = heat_colours(answer.scores, answer.seen)
    colours[~answer.seen] = NOT_SEEN_COLOUR
    return recoloured(scene.splat_file, colours)


def npy(values: np.ndarray) -> bytes:
    """Values of splats, such as an answer's scores [P] f32, as an ``.npy`` file."""
    content = io.BytesIO()
    np.save(content, values)
    return content.getvalue()


def viewer_splats(scene: QueryScene) -> Iterator[bytes]:
    """The scene in the ``.splat`` format of web viewers, [P] `io.splat.ROW` in the lift's order, in blocks.

    A row is centre and scales in f32, the constant colour with the opacity, and the quaternion w x y z as bytes
    ``128 + 128 q``. Colours that change with the direction are left out, and grey stands in where there are none.
    What is no 3D Gaussian is shown as the nearest one: a disc (2DGS) as a thin one, and a DBS kernel
    ``(1 - r^2)^beta`` as the one of its variance in the image, ``1 / (2 (beta + 2))``.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
    """
    from liftcore.io.splat import ROW

    splats = scene.splats
    fields = (splats.means, splats.log_scales, splats.quats, splats.opacity_logits, splats.beta, splats.sh)
    means, scales, quats, logits, betas, sh = map(as_numpy, fields)
    for first in range(0, len(means), _BLOCK_ROWS):
        block = slice(first, first + _BLOCK_ROWS)
        rows = np.zeros(len(means[block]), ROW)
        rows["means"] = means[block]
        size = np.exp(scales[block].clip(-_LARGEST_SCALE, _LARGEST_SCALE))
        if size.shape[1] == 2:
            size = np.concatenate([size, _THIN * size.min(axis=1, keepdims=True)], axis=1)
        if betas is not None:
            beta = 4 * np.exp(betas[block].clip(-_LARGEST_SCALE, _LARGEST_SCALE))
            size = size / np.sqrt(2 * (beta + 2))[:, None]
        rows["scales"] = size
        colour = np.full((len(rows), 3), _GREY, np.float32) if sh is None else 0.5 + SH_C0 * sh[block, 0]
        rows["colours"][:, :3] = np.round(255 * colour.clip(0, 1))
        with np.errstate(over="ignore"):
            rows["colours"][:, 3] = np.round(255 / (1 + np.exp(-logits[block])))
        length = np.linalg.norm(quats[block].astype(np.float64), axis=1, keepdims=True)
        unit = np.where(length > 0, quats[block] / np.where(length > 0, length, 1.0), (1.0, 0.0, 0.0, 0.0))
        rows["quats"] = np.round(128 + 128 * unit).clip(0, 255)
        yield rows.tobytes()


def layer_colours(scene: QueryScene, what: str) -> np.ndarray:
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
