"""Files of masks: PNGs, and COCO's run lengths and polygons in JSON.

COCO's run lengths are the numbers of pixels outside a mask, then inside, then outside, and so on, down the columns.
They are a list of numbers ("uncompressed") or a string, in which a number is written in groups of five bits, the
lowest first, each a character from ``0`` on: bit 32 means that more groups follow, and bit 16 of the last group that
the number is negative. From the fourth on, a number is the difference to the one two before it. The format is that of
cocodataset/cocoapi, ``common/maskApi.c`` (``rleToString``, ``rleFrString``).

A polygon is a list of parts, ``[[x1, y1, x2, y2, ...], ...]`` in pixels of the image, whose union is the mask.

Readers raise ``ValueError`` (`liftcore.errors.reading`).
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from liftcore.io.photos import open_image
from liftcore.scene.compositing import MAX_SIDE

LABELS = "a PNG of one channel, 8 or 16 bits of grey or a palette"
PNG_HEADER_BYTES = 26  # up to the bit depth and the colour type
GREY, PALETTE = 0, 3  # colour types of a PNG
MAX_JSON_BYTES = 1 << 28  # of a file: some thousand masks of a large photo as plain numbers
AS_COCO = "export COCO's JSON (instances) from the program that wrote it"
GROUP_BITS = 5
CONTINUATION, SIGN, VALUE = 32, 16, 31
LOWEST, HIGHEST = ord("0"), ord("0") + 63  # the characters of a group
MAX_GROUPS = 7  # 35 bits: differences of lengths in an image of MAX_SIDE squared, and their sign
MAX_PIXELS = 178_956_970  # as many as Pillow opens
MAX_COORDINATE = 1e6  # pixels


def label_png(path: Path) -> tuple[np.ndarray, dict[str, str]]:
    """Read the stored values [h, w] i32 of a label picture, and its texts."""
    with _open_png(path) as (image, depth, kind):
        if kind != PALETTE and not (kind == GREY and depth in (8, 16)):  # Pillow scales grey values of few bits
            raise ValueError(f"{LABELS}, got a picture in colours or of {depth} bits; move photos to another folder")
        texts = {name: str(text) for name, text in getattr(image, "text", {}).items()}
        return np.asarray(image).astype(np.int32), texts


def binary_picture(path: Path, unlabelled: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Read a picture of one value besides black: [h, w] bool, where it has this value, and where ``unlabelled``."""
    with _open_png(path) as (image, _, _):
        if image.mode in ("RGBA", "LA") and image.getchannel("A").getextrema()[0] != 255:
            hint = "write only the mask: cv2.imwrite(name, 255 * mask.astype(numpy.uint8))"
            raise ValueError(f"a PNG without transparent pixels, got colours with transparency; {hint}")
        values = np.asarray(image.convert("RGB") if "A" in image.mode else image)
    if values.ndim == 2:
        return binary_mask(values, unlabelled)
    inside, void = binary_mask(values.max(axis=2), unlabelled)
    colours = values[inside].astype(np.int32) @ (1 << 16, 1 << 8, 1)
    if len(colours) and colours.min() != colours.max():
        raise ValueError(f"one colour besides black, a mask, got several, as of classes or instances; {AS_COCO}")
    return inside, void


def binary_mask(values: np.ndarray, unlabelled: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Split values [h, w] in two masks [h, w] bool: those besides 0, and the unlabelled ones."""
    void = np.zeros(values.shape, bool) if unlabelled is None else values == unlabelled
    inside = (values != 0) & ~void
    inside_values = values[inside]
    if len(inside_values) and (low := inside_values.min()) != (high := inside_values.max()):
        hint = "give the names of label pictures (--names, in Python names=); save soft edges or scores as a mask"
        raise ValueError(f"one value besides 0, a mask, got values from {low} to {high} besides 0; {hint}")
    return inside, void


@contextmanager
def _open_png(path: Path) -> Iterator[tuple[Image.Image, int, int]]:
    """Open a PNG with Pillow, with its bit depth and colour type."""
    with path.open("rb") as handle:
        header = handle.read(PNG_HEADER_BYTES)
    try:
        with open_image(path, "PNG") as image:
            image.load()
            yield image, header[24], header[25]
    except OSError as error:  # also of truncated or broken files
        raise ValueError(f"a PNG, got one that does not open ({error}); write it again") from None


@dataclass(frozen=True)
class StoredMask:
    """A mask as run lengths."""

    size: tuple[int, int]  # h, w
    lengths: np.ndarray  # [n] i64, whose sum is h w

    def pixels(self) -> np.ndarray:
        """Decode the mask, [h, w] bool."""
        height, width = self.size
        inside = np.arange(len(self.lengths)) % 2 == 1
        return np.repeat(inside, self.lengths).reshape(width, height).T

    def is_empty(self) -> bool:
        """Return True if no pixel is inside."""
        return not self.lengths[1::2].any()


@dataclass(frozen=True)
class StoredMasks(Sequence[np.ndarray]):
    """Sequence of masks of one size, each decoded as [h, w] bool at every access."""

    stored: tuple[StoredMask, ...]

    def __getitem__(self, index: Any) -> Any:
        return self.stored[index].pixels()

    def __len__(self) -> int:
        return len(self.stored)


def read_mask_json(path: Path) -> Any:
    """Read the content of a JSON file of masks."""
    if (size := path.stat().st_size) > MAX_JSON_BYTES:
        hint = "write compressed counts (coco_rle), which are smaller"
        raise ValueError(f"at most {MAX_JSON_BYTES} bytes, got {size} bytes; {hint}")
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"JSON, got one that does not parse ({str(error)[:80]}); write it with json.dump") from None


def mask_records(content: Any) -> list[Any]:
    """Return the records of masks of a document: a list, or the list under ``annotations``."""
    records = content.get("annotations") if isinstance(content, dict) else content
    if not isinstance(records, list):
        got = f"an object of {', '.join(map(repr, list(content)[:3]))}" if isinstance(content, dict) else "none"
        raise ValueError(f"a list of masks, or {{'annotations': [...]}}, got {got[:120]}; {AS_COCO}")
    return records


def read_mask(segmentation: Any, size: tuple[int, int] | None) -> StoredMask | None:
    """Read run lengths or polygons; None if there is neither."""
    if segmentation is None or segmentation == []:
        return None
    if isinstance(segmentation, list):
        if size is None:
            hint = "give the image's width and height, or masks as run lengths"
            raise ValueError(f"the size of the image of a polygon, got none; {hint}")
        return stored_mask(fill_polygons(check_size(size), read_polygons(segmentation)))
    return read_runs(segmentation)


def read_polygons(segmentation: Any) -> list[np.ndarray]:
    """Read the parts of a polygon, [n, 2] f64 each: x and y in pixels.

    Args:
        segmentation: one list x1, y1, x2, y2, ... for each part, or for the only one; or the points [x, y] of one.
    """
    parts = segmentation if isinstance(segmentation, list) else [segmentation]
    if parts and all(isinstance(point, list) and len(point) == 2 for point in parts):
        parts = [[number for point in parts for number in point]]
    elif parts and not isinstance(parts[0], list):
        parts = [parts]
    for part in parts:
        if not isinstance(part, list) or len(part) % 2 or not all(map(_is_coordinate, part)):
            expected = "parts [x1, y1, x2, y2, ...] of a polygon, in pixels"
            raise ValueError(f"{expected}, got {repr(part)[:80]}; {AS_COCO}")
    corners = [number for part in parts for number in part]
    if len(corners) >= 6 and 0 <= min(corners) <= max(corners) <= 1:
        hint = "multiply x by the image's width and y by its height"
        raise ValueError(f"a polygon in pixels, got one in fractions of the image; {hint}")
    return [np.array(part, np.float64).reshape(-1, 2) for part in parts]


def _is_coordinate(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MAX_COORDINATE


def fill_polygons(size: tuple[int, int], parts: Iterable[np.ndarray]) -> np.ndarray:
    """Fill the union of polygons [n, 2] by the even-odd rule at the centres of pixels, [h, w] bool.

    Polygons are clipped to the image. cocodataset/cocoapi (``rleFrPoly``) rounds corners to fifths of a pixel first,
    so its outlines differ by a fraction of a pixel.
    """
    height, width = size
    inside = np.zeros(size, bool)
    for part in parts:
        ends = np.clip(np.ceil(part[:, 0] - 0.5), 0, width).astype(np.int64)  # columns whose centres edges begin at
        left = ends.min(initial=width)
        crossings = np.zeros((height + 1, max(0, ends.max(initial=0) - left)), bool)
        edges = zip(part, np.roll(part, -1, axis=0), ends, np.roll(ends, -1), strict=True)
        for (x, y), (next_x, next_y), end, next_end in edges:
            columns = np.arange(min(end, next_end), max(end, next_end))
            rows = np.ceil(y + (columns + 0.5 - x) * (next_y - y) / (next_x - x) - 0.5).clip(0, height)
            crossings[rows.astype(np.int64), columns - left] ^= True
        inside[:, left : left + crossings.shape[1]] |= np.logical_xor.accumulate(crossings[:height], axis=0)
    return inside


def check_size(size: tuple[int, int]) -> tuple[int, int]:
    """Return a size of masks (h, w) if it is within bounds."""
    height, width = size
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE and height * width <= MAX_PIXELS):
        raise ValueError(f"sides in 1..{MAX_SIDE} and at most {MAX_PIXELS} pixels, got size {height} x {width}"[:160])
    return size


def stored_mask(mask: np.ndarray) -> StoredMask:
    """Encode a mask [h, w] bool."""
    flat = mask.T.ravel()
    changes = np.flatnonzero(np.diff(flat, prepend=False))
    return StoredMask((mask.shape[0], mask.shape[1]), np.diff(changes, prepend=0, append=flat.size))


def read_runs(segmentation: Any) -> StoredMask:
    """Read the run lengths of a mask in JSON, ``{"size": [h, w], "counts": ...}``."""
    if not isinstance(segmentation, dict) or not {"size", "counts"} <= segmentation.keys():
        hint = f"segment-anything writes them with output_mode='uncompressed_rle' or 'coco_rle'; {AS_COCO}"
        raise ValueError(f"run lengths {{size, counts}}, got {repr(segmentation)[:80]}; {hint}")
    size, counts = segmentation["size"], segmentation["counts"]
    if not (isinstance(size, list) and len(size) == 2 and all(type(side) is int for side in size)):
        raise ValueError(f"size [h, w], got {repr(size)[:80]}")
    height, width = check_size((size[0], size[1]))
    lengths = _decompress_counts(counts) if isinstance(counts, str) else counts
    if not isinstance(lengths, list) or not all(type(length) is int for length in lengths):
        raise ValueError(f"counts, a list of whole numbers or a string, got {repr(counts)[:80]}")
    if min(lengths, default=0) < 0:
        raise ValueError(f"counts from 0 on, got a run of {min(lengths)}"[:120])
    if sum(lengths) != height * width:
        expected = f"counts that sum up to {height} x {width} = {height * width}"
        hint = "the file is truncated, or size is not [h, w] of the mask"
        raise ValueError(f"{expected}, got a sum of {str(sum(lengths))[:40]}; {hint}")
    return StoredMask((height, width), np.array(lengths, np.int64))


def _without_bytes_notation(text: str) -> str:
    """Return the counts of a text ``b'...'``, which ``str`` writes for the bytes of pycocotools.

    Counts have no quotes, and the backslash is their only character that Python escapes.
    """
    is_bytes = len(text) > 2 and text[0] == "b" and text[1] in "'\"" and text[-1] == text[1]
    return text[2:-1].replace("\\\\", "\\") if is_bytes else text


def _decompress_counts(text: str) -> list[int]:
    numbers: list[int] = []
    number = groups = 0
    for character in _without_bytes_notation(text):
        if not LOWEST <= ord(character) <= HIGHEST or groups == MAX_GROUPS:
            expected = f"counts of characters {chr(LOWEST)!r} to {chr(HIGHEST)!r}, {MAX_GROUPS} at most for a number"
            raise ValueError(f"{expected}, got {character!r} in number {len(numbers)}")
        group = ord(character) - LOWEST
        number |= (group & VALUE) << GROUP_BITS * groups
        groups += 1
        if group & CONTINUATION:
            continue
        numbers.append(number - (1 << GROUP_BITS * groups) if group & SIGN else number)
        number = groups = 0
    if groups:
        raise ValueError("complete counts, got a string that ends within a number")
    # Numbers are differences to the one two before, so there are two cumulative sums, of odd and of even positions.
    lengths = numbers[:1] + [0] * (len(numbers) - 1)
    lengths[1::2] = accumulate(numbers[1::2])
    lengths[2::2] = accumulate(numbers[2::2])
    return lengths
