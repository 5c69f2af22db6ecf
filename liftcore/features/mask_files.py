"""Files that hold masks: PNGs, and COCO's run lengths in JSON.

COCO's run lengths say how many pixels lie outside a mask, then inside, then outside, and so on, down the columns.
They are a list of numbers ("uncompressed"), or a string of them, in which a number is written in groups of five bits,
the lowest first, each a character from ``0`` on: 32 says that more groups follow, and 16 in the last that the number
is negative. From the fourth on, a number is the difference to the one two before it. The format is of
cocodataset/cocoapi, ``common/maskApi.c`` (``rleToString``, ``rleFrString``).
"""

import json
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, overload

import numpy as np
from PIL import Image, UnidentifiedImageError

from liftcore.errors import InvalidFeatures
from liftcore.scene.cameras import MAX_SIDE

LABELS = "a PNG of one channel, 8 or 16 bits of grey or a palette"
BINARY = "a PNG without transparency, of one value beside black"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_HEADER_BYTES = 26  # up to the depth and the kind of colours
PNG_KINDS = {
    0: "grey",
    2: "red, green and blue",
    3: "a palette",
    4: "grey with transparency",
    6: "colours with transparency",
}
MAX_JSON_BYTES = 1 << 28  # of a file: some thousand masks of a large photo as plain numbers
MASK_LIST = "a list of masks, or {'annotations': [...]}"
GROUP_BITS = 5
MORE, SIGN, VALUE = 32, 16, 31
LOWEST, HIGHEST = ord("0"), ord("0") + 63  # the characters of a group
MOST_GROUPS = 7  # 35 bits: differences of lengths in an image of MAX_SIDE squared, and their sign
MAX_PIXELS = 178_956_970  # as many as Pillow opens


def label_png(path: Path) -> tuple[np.ndarray, dict[str, str]]:
    """[h, w] i32, the numbers as they are stored, and the picture's texts.

    Raises:
        InvalidFeatures: no PNG of one channel whose numbers Pillow gives as they are.
    """
    with _opened(path, LABELS, _refuse_spread) as image:
        texts = {name: str(text) for name, text in getattr(image, "text", {}).items()}
        return np.asarray(image).astype(np.int32), texts


def binary_png(path: Path) -> np.ndarray:
    """[h, w] bool, where a picture of one value beside black has that value.

    Raises:
        InvalidFeatures: no PNG, one with transparency, or one of more values.
    """
    with _opened(path, BINARY, _refuse_transparency) as image:
        values = np.asarray(image)
    grey = values.max(axis=2) if values.ndim == 3 else values
    inside = grey != 0
    told = grey[inside]
    if len(told) and told.min() != told.max():
        got, hint = f"values from {told.min()} to {told.max()} beside it", "label pictures need their --names"
        raise InvalidFeatures(str(path), expected="one value beside 0, a mask", got=got, hint=hint)
    return inside


@contextmanager
def _opened(path: Path, expected: str, check: Callable[[int, str, Path], None]) -> Iterator[Image.Image]:
    """A PNG as Pillow opens it, once its depth and kind of colours are checked."""
    try:
        with path.open("rb") as handle:
            header = handle.read(PNG_HEADER_BYTES)
        if len(header) < PNG_HEADER_BYTES or not header.startswith(PNG_SIGNATURE):
            raise InvalidFeatures(str(path), expected=expected, got="a file that is no PNG")
        check(header[24], PNG_KINDS.get(header[25], "an unknown kind"), path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # it opens, up to twice the limit
            with Image.open(path, formats=["PNG"]) as image:
                image.load()
                yield image
    except Image.DecompressionBombError:
        most = 2 * (Image.MAX_IMAGE_PIXELS or 0)
        raise InvalidFeatures(str(path), expected=f"at most {most} pixels", got="a larger picture") from None
    except UnidentifiedImageError:
        raise InvalidFeatures(str(path), expected=expected, got="one that Pillow does not know") from None
    except (OSError, SyntaxError, ValueError, EOFError) as error:  # Pillow's kinds for files that are cut or broken
        got = f"one that does not open ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected=expected, got=got, hint="write it anew") from None


def _refuse_spread(depth: int, kind: str, path: Path) -> None:
    """Refuse what Pillow would open as other numbers than are stored: it spreads grey of few bits over 0 to 255."""
    if kind != "a palette" and not (kind == "grey" and depth in (8, 16)):
        hint = "a photo belongs in another folder; a picture of colours is one of labels once each has a number"
        raise InvalidFeatures(str(path), expected=LABELS, got=f"{kind} of {depth} bits", hint=hint)


def _refuse_transparency(_: int, kind: str, path: Path) -> None:
    if "transparency" in kind:
        hint = "write the mask alone: cv2.imwrite(name, 255 * mask.astype(numpy.uint8))"
        raise InvalidFeatures(str(path), expected=BINARY, got=kind, hint=hint)


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


def read_mask_json(path: Path) -> Any:
    """The content of a JSON file of masks.

    Raises:
        InvalidFeatures: no JSON, or one beyond MAX_JSON_BYTES.
    """
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            got, hint = f"{path.stat().st_size} bytes", "compressed counts (coco_rle) take a fraction of them"
            raise InvalidFeatures(str(path), expected=f"at most {MAX_JSON_BYTES} bytes", got=got, hint=hint)
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InvalidFeatures(str(path), expected=MASK_LIST, got=f"no such file ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        got = f"no JSON ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected=MASK_LIST, got=got, hint="write it anew with json.dump") from None


def mask_records(content: Any, path: Path) -> list[Any]:
    """The records of masks in such a content: a list, or that under ``annotations``.

    Raises:
        InvalidFeatures: there is none.
    """
    records = content.get("annotations") if isinstance(content, dict) else content
    if not isinstance(records, list):
        got = f"an object of {', '.join(map(repr, list(content)[:3]))}"[:120] if isinstance(content, dict) else "none"
        raise InvalidFeatures(str(path), expected=MASK_LIST, got=got, hint="files of no views belong elsewhere")
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
        if not LOWEST <= ord(character) <= HIGHEST or groups == MOST_GROUPS:
            expected = f"counts of characters {chr(LOWEST)!r} to {chr(HIGHEST)!r}, {MOST_GROUPS} at most for a number"
            raise InvalidFeatures(where, expected=expected, got=f"{character!r} in number {len(numbers)}")
        group = ord(character) - LOWEST
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
