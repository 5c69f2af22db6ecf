"""Masks in JSON, as segment-anything's ``SamAutomaticMaskGenerator`` returns them and SA-1B keeps them.

A list of objects whose ``segmentation`` is run lengths, alone or under ``annotations``. Mask k is the list's k-th.

COCO's run lengths say how many pixels lie outside a mask, then inside, then outside, and so on, down the columns.
They are a list of numbers ("uncompressed"), or a string of them, in which a number is written in groups of five bits,
the lowest first, each a character from ``0`` on: 32 says that more groups follow, and 16 in the last that the number
is negative. From the fourth on, a number is the difference to the one two before it. The format is of
cocodataset/cocoapi, ``common/maskApi.c`` (``rleToString``, ``rleFrString``).
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, overload

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.scene.cameras import MAX_SIDE

MAX_BYTES = 1 << 28  # of a file: some thousand masks of a large photo as plain numbers
EXPECTED = "a list of masks, or {'annotations': [...]}"
GROUP_BITS = 5
MORE, SIGN, VALUE = 32, 16, 31
FIRST, LAST = ord("0"), ord("0") + 63  # the characters of a group
MOST_GROUPS = 7  # 35 bits: differences of lengths in an image of MAX_SIDE squared, and their sign
MAX_PIXELS = 178_956_970  # as many as Pillow opens


@dataclass(frozen=True)
class RunMasks(Sequence[np.ndarray]):
    """Masks of one size, kept as run lengths; each is made anew, [h, w] bool, when it is asked for."""

    size: tuple[int, int]  # h, w
    runs: tuple[np.ndarray, ...]  # [n] i64 each, checked

    @overload
    def __getitem__(self, index: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, index: slice) -> "RunMasks": ...
    def __getitem__(self, index: int | slice) -> "np.ndarray | RunMasks":
        if isinstance(index, slice):
            return RunMasks(self.size, self.runs[index])
        return mask_of_runs(self.size, self.runs[index])

    def __len__(self) -> int:
        return len(self.runs)


def sam_masks(path: Path, count: int) -> RunMasks:
    """The masks of a file, in its order.

    Args:
        path: the file. count: how many vectors there are. Where the lists differ, nobody knows from which place on
            they ceased to match, so that is refused before anything is decoded.

    Raises:
        InvalidFeatures: no such JSON, not ``count`` masks, masks of several sizes, or as `read_runs`.
    """
    records = _records(path)
    if len(records) != count:
        hint = "leave out views without masks" if not records else "row k of the vectors is of mask k of the list"
        raise InvalidFeatures(str(path), expected=f"{count} masks, one a vector", got=str(len(records)), hint=hint)
    found = [
        read_runs(record.get("segmentation") if isinstance(record, dict) else None, f"{path} mask {number}")
        for number, record in enumerate(records)
    ]
    size = found[0][0]
    for number, (other, _) in enumerate(found):
        if other != size:
            got = f"{size[0]} x {size[1]} of mask 0 and {other[0]} x {other[1]} of mask {number}"
            raise InvalidFeatures(str(path), expected="masks of one size", got=got, hint="write those of one photo")
    return RunMasks(size, tuple(runs for _, runs in found))


def _records(path: Path) -> list[Any]:
    try:
        if path.stat().st_size > MAX_BYTES:
            got, hint = f"{path.stat().st_size} bytes", "output_mode='coco_rle' takes a fraction of them"
            raise InvalidFeatures(str(path), expected=f"at most {MAX_BYTES} bytes", got=got, hint=hint)
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise InvalidFeatures(str(path), expected=EXPECTED, got=f"no such file ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        got = f"no JSON ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected=EXPECTED, got=got, hint="write it anew with json.dump") from None
    records = content.get("annotations") if isinstance(content, dict) else content
    if not isinstance(records, list):
        got = f"an object of {', '.join(map(repr, list(content)[:3]))}"[:120] if isinstance(content, dict) else "none"
        raise InvalidFeatures(str(path), expected=EXPECTED, got=got, hint="files of no views belong elsewhere")
    return records


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
    # Differences to the number two before, undone: two running sums, of the odd and of the even places.
    lengths = numbers[:1] + [0] * (len(numbers) - 1)
    lengths[1::2] = accumulate(numbers[1::2])
    lengths[2::2] = accumulate(numbers[2::2])
    return lengths
