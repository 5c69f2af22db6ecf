"""Answers as files: what was found alone, the whole scene in the colours of its scores, or the scores.

Splat files are copies of the file that was lifted, in its dialect and in the order of its rows: whatever opens that
file opens them, and they can be lifted again.
"""

import io
from collections.abc import Iterable

import numpy as np

from liftcore.errors import InvalidQuery
from liftcore.query.ask import Answer
from liftcore.query.colours import NOT_SEEN_COLOUR, constant_terms, heat_colours
from liftcore.query.objects import objects
from liftcore.query.scene import QueryScene


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
    return recoloured(scene.splat_file, constant_terms(colours))


def npy(values: np.ndarray) -> bytes:
    """Values of splats, such as an answer's scores [P] f32, as an ``.npy`` file."""
    content = io.BytesIO()
    np.save(content, values)
    return content.getvalue()
