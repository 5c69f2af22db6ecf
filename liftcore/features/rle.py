"""COCO's run lengths of a mask: how many pixels lie outside, then inside, then outside, and so on.

Pixels are counted down the columns. The lengths are a list of numbers ("uncompressed"), or a string of them, in which
a number is written in groups of five bits, the lowest first, each a character from ``0`` on: 32 says that more groups
follow, and 16 in the last that the number is negative. From the fourth on, a number is the difference to the one two
before it. The format is of cocodataset/cocoapi, ``common/maskApi.c`` (``rleToString``, ``rleFrString``).
"""

from __future__ import annotations

from itertools import accumulate
from typing import Any

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.scene.cameras import MAX_SIDE

GROUP_BITS = 5
MORE, SIGN, VALUE = 32, 16, 31
FIRST, LAST = ord("0"), ord("0") + 63  # the characters of a group
MOST_GROUPS = 7  # 35 bits: differences of lengths in an image of MAX_SIDE squared, and their sign
MAX_PIXELS = 178_956_970  # as many as Pillow opens


def read_runs(segmentation: Any, where: str) -> tuple[tuple[int, int], np.ndarray]:
    """Size and checked run lengths of what JSON holds as a mask, ``{"size": [h, w], "counts": ...}``.

    Returns:
        (h, w), and the lengths [n] i64, whose sum is h w.

    Raises:
        InvalidFeatures: a polygon or what else is no such mask, a size out of bounds, a string that is cut off or
            has other characters, or lengths that do not cover the image exactly. ``where`` is named.
    """
    if not isinstance(segmentation, dict) or not {"size", "counts"} <= segmentation.keys():
        got = "a polygon" if isinstance(segmentation, list) else "another thing"
        hint = "segment-anything writes them with output_mode='uncompressed_rle' or 'coco_rle'"
        raise InvalidFeatures(where, expected="run lengths {size, counts}", got=got, hint=hint)
    size, counts = segmentation["size"], segmentation["counts"]
    if not (isinstance(size, list) and len(size) == 2 and all(type(side) is int for side in size)):
        raise InvalidFeatures(where, expected="size [h, w]", got=repr(size)[:80])
    height, width = size
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE and height * width <= MAX_PIXELS):
        expected = f"sides in 1..{MAX_SIDE} and at most {MAX_PIXELS} pixels"
        raise InvalidFeatures(where, expected=expected, got=f"size {height} x {width}"[:80])
    lengths = _decompressed(counts, where) if isinstance(counts, str) else counts
    if not isinstance(lengths, list) or not all(type(length) is int for length in lengths):
        raise InvalidFeatures(where, expected="counts, a list of whole numbers or a string", got=repr(counts)[:80])
    if min(lengths, default=0) < 0:
        raise InvalidFeatures(where, expected="counts from 0 on", got=f"a run of {min(lengths)}"[:80])
    if sum(lengths) != height * width:
        expected = f"counts that sum up to {height} x {width} = {height * width}"
        hint = "the file is cut off, or size is not [h, w] of the mask"
        raise InvalidFeatures(where, expected=expected, got=f"a sum of {sum(lengths)}"[:80], hint=hint)
    return (height, width), np.array(lengths, np.int64)


def mask_of_runs(size: tuple[int, int], lengths: np.ndarray) -> np.ndarray:
    """[h, w] bool, the mask of checked run lengths."""
    height, width = size
    inside = np.arange(len(lengths)) % 2 == 1
    return np.repeat(inside, lengths).reshape(width, height).T


def _decompressed(text: str, where: str) -> list[int]:
    numbers: list[int] = []
    number = groups = 0
    for character in text:
        if not FIRST <= ord(character) <= LAST or groups == MOST_GROUPS:
            expected = f"counts of characters {chr(FIRST)!r} to {chr(LAST)!r}, {MOST_GROUPS} at most for a number"
            raise InvalidFeatures(where, expected=expected, got=f"{character!r} in number {len(numbers)}")
        group = ord(character) - FIRST
        number |= (group & VALUE) << GROUP_BITS * groups
        groups += 1
        if group & MORE:
            continue
        numbers.append(number - (1 << GROUP_BITS * groups) if group & SIGN else number)
        number = groups = 0
    if groups:
        raise InvalidFeatures(where, expected="whole counts", got="a string that is cut off within a number")
    return _summed(numbers)


def _summed(numbers: list[int]) -> list[int]:
    """Differences to the number two before, undone: two running sums, of the odd and of the even places."""
    lengths = numbers[:1] + [0] * (len(numbers) - 1)
    lengths[1::2] = accumulate(numbers[1::2])
    lengths[2::2] = accumulate(numbers[2::2])
    return lengths
