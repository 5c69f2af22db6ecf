"""Answers as files: what was found alone, the whole scene in the colours of its scores, or the scores.

Splat files are copies of the file that was lifted, in its dialect and in the order of its rows: whatever opens that
file opens them, and they can be lifted again.
"""

import io
from collections.abc import Iterable, Iterator

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.colours import NOT_SEEN_COLOUR, cluster_colours, heat_colours
from liftcore.query.objects import MOST_SPLATS, objects
from liftcore.query.question import Answer
from liftcore.query.scene import QueryScene, as_numpy


def object_splats(scene: QueryScene, answer: Answer, suffix: str = ".ply") -> Iterable[bytes]:
    """The splats of an answer's objects, as a file in blocks: a PLY with every property to the byte, .splat or .spz.

    They are those that `objects` and masks show, without strays; of more than are grouped, all that were selected.

    Raises:
        InvalidQuery: none was selected, or nothing asked for is there: most viewers open no file without splats; or
            some objects are to be kept, and more were selected than objects are made of.
        InvalidLift: the splats moved or changed since the lift.
    """
    from liftcore.io.splats import some_rows

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
    return some_rows(scene.splat_file, answer.selected if whole else objects(scene, answer).numbers >= 0, suffix)


def coloured_ply(scene: QueryScene, answer: Answer) -> Iterable[bytes]:
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


def viewer_splats(scene: QueryScene) -> Iterator[bytes]:
    """The scene in the ``.splat`` format of web viewers, in the lift's order, in blocks.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
    """
    from liftcore.io.splat import splat_blocks

    return splat_blocks(scene.splats)


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
