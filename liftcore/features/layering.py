"""Masks that overlap become levels of labels that do not.

The largest mask comes first, of equals the one that was given first, and each goes to the first level on which none
of its pixels is taken. No pixel of any mask is lost, and what lies alone is on level 0. A lift that takes levels as
rows of their own asks only which masks lie on a pixel, so there it does not matter on which level they are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.features.views import NO_LABEL

if TYPE_CHECKING:
    from collections.abc import Sequence

MAX_LEVELS = 32  # a hierarchy of four partitions, with masks 1 to 4 pixels over their neighbours, took 13 to 18


def layered(masks: Sequence[np.ndarray], where: str) -> np.ndarray:
    """[L, h, w] i32: label k where mask k is, -1 for none; an empty mask has no label.

    Args:
        masks: [h, w] bool each, at least one, all of one size; each is asked for twice. where: named in the error.

    Raises:
        InvalidFeatures: they take more than MAX_LEVELS levels.
    """
    boxes, areas = zip(*map(_extent, masks), strict=True)
    # Room for all levels that there may be: pages of those that are never written take no memory.
    labels = np.empty((min(MAX_LEVELS, len(masks)), *masks[0].shape), np.int32)
    labels[0] = NO_LABEL
    used = 1
    for number in sorted(range(len(masks)), key=lambda number: -areas[number]):
        if not areas[number]:
            break
        inside, windows = masks[number][boxes[number]], labels[:, *boxes[number]]
        level = next((k for k in range(used) if not ((windows[k] != NO_LABEL) & inside).any()), used)
        if level == MAX_LEVELS:
            raise _too_many(masks, where)
        if level == used:
            labels[level] = NO_LABEL
            used += 1
        windows[level][inside] = number
    return labels[:used]


def _extent(mask: np.ndarray) -> tuple[tuple[slice, slice], int]:
    """The rows and columns between which a mask's pixels lie, and how many it has."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return (slice(0), slice(0)), 0
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    return box, int(np.count_nonzero(mask[box]))


def _too_many(masks: Sequence[np.ndarray], where: str) -> InvalidFeatures:
    depth = np.zeros(masks[0].shape, np.int32)
    for mask in masks:
        depth += mask
    return InvalidFeatures(
        where,
        expected=f"masks that lie on {MAX_LEVELS} levels without overlap",
        got=f"{len(masks)} masks, up to {int(depth.max())} of them over one pixel",
        hint="leave out those that are nearly the same, as SamAutomaticMaskGenerator does by box_nms_thresh",
    )
