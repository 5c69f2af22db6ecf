"""Answers as files: what was found alone, the whole scene in the colours of its scores, or the scores.

Splat files are copies of the file that was lifted, in its dialect and in the order of its rows: whatever opens that
file opens them, and they can be lifted again.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.errors import InvalidQuery
from liftcore.io.ply import recoloured, some_rows
from liftcore.query.colours import NOT_SEEN_COLOUR, constant_terms, heat_colours
from liftcore.query.objects import objects

if TYPE_CHECKING:
    from collections.abc import Iterable

    from liftcore.query.ask import Answer
    from liftcore.query.scene import QueryScene


def object_ply(scene: QueryScene, answer: Answer) -> Iterable[bytes]:
    """The splats that were selected, as a file in blocks; every property of theirs to the byte.

    A query that keeps the largest gets the largest object alone (`objects`).

    Raises:
        InvalidQuery: none was selected: most viewers open no file without splats; or more than objects are made of.
        InvalidLift: the splats moved or changed since the lift.
    """
    if answer.count == 0:
        raise InvalidQuery(
            "object",
            expected="splats at or above the threshold",
            got=f"none of {len(answer.scores)}: nothing stands out",
            hint="name a lower threshold, or ask in other words or by example",
        )
    if answer.query.keep == "largest":
        return some_rows(scene.splat_file, objects(scene, answer).numbers == 0)
    return some_rows(scene.splat_file, answer.selected.numpy())


def coloured_ply(scene: QueryScene, answer: Answer) -> Iterable[bytes]:
    """All splats in the colours of their scores, as a file in blocks.

    The colour map spans the scores of the seen splats as a picture of the attention spans its pixels; splats without
    a score are grey. Colours are the same from everywhere; all else is kept to the byte.

    Raises:
        InvalidLift: the splats moved or changed since the lift.
        InvalidSplats: their file holds no colours; told when the first block is asked for.
    """
    seen = answer.seen.numpy()
    colours = heat_colours(answer.scores.numpy(), seen)
    colours[~seen] = NOT_SEEN_COLOUR
    return recoloured(scene.splat_file, constant_terms(colours))


def scores_npy(answer: Answer) -> bytes:
    """The score of every splat, [P] f32, as an ``.npy`` file."""
    content = io.BytesIO()
    np.save(content, answer.scores.to(torch.float32).numpy())
    return content.getvalue()
