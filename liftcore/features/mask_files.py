"""Files of masks: PNGs, and COCO's run lengths and polygons in JSON.

COCO's run lengths are the numbers of pixels outside a mask, then inside, then outside, and so on, down the columns.
They are a list of numbers ("uncompressed") or a string, in which a number is written in groups of five bits, the
lowest first, each a character from ``0`` on: bit 32 means that more groups follow, and bit 16 of the last group that
the number is negative. From the fourth on, a number is the difference to the one two before it. The format is that of
cocodataset/cocoapi, ``common/maskApi.c`` (``rleToString``, ``rleFrString``).

A polygon is a list of parts, ``[[x1, y1, x2, y2, ...], ...]`` in pixels of the image, whose union is the mask; or the
points ``[[x, y], ...]`` of one part (LabelMe, ISAT); or several rings, where a pixel is inside the mask if it is
inside an odd number of rings (``exterior`` and ``interior`` of Supervisely, ``paths`` of Darwin).

LabelMe and Supervisely also store pictures of a part of the image, as PNGs in base64 with the position of a corner.
"""

import base64
import io
import json
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, overload

import numpy as np
from PIL import Image, UnidentifiedImageError

from liftcore.errors import InvalidFeatures
from liftcore.scene.compositing import MAX_SIDE

LABELS = "a PNG of one channel, 8 or 16 bits of grey or a palette"
BINARY = "a PNG without transparent pixels, with one value besides black"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_HEADER_BYTES = 26  # up to the bit depth and the colour type
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
CONTINUATION, SIGN, VALUE = 32, 16, 31
LOWEST, HIGHEST = ord("0"), ord("0") + 63  # the characters of a group
MAX_GROUPS = 7  # 35 bits: differences of lengths in an image of MAX_SIDE squared, and their sign
MAX_PIXELS = 178_956_970  # as many as Pillow opens
MAX_CROSSINGS = 1 << 24  # of columns of pixels by the edges of a polygon
MAX_COORDINATE = 1e6  # pixels
CIRCLE_CORNERS = 64
OVERHANG = 0.02  # of the image's sides, by which polygons drawn by hand may extend beyond it
TOO_LARGE = Image.DecompressionBombError
MAX_PICTURE_BYTES = 64 << 20  # of a PNG of a mask
RECORD_LISTS = ("annotations", "shapes", "objects", "predictions")  # COCO's, LabelMe's, ISAT's, Roboflow's
SEGMENTATIONS = ("segmentation", "polygon", "points", "segments", "rle", "mask")  # of a record


def label_png(path: Path) -> tuple[np.ndarray, dict[str, str]]:
    """Read the stored values [h, w] i32 of a label picture, and its texts.

    Raises:
        InvalidFeatures: not a PNG of one channel whose values Pillow reads unchanged.
    """
    with _open_png(path, LABELS, _check_label_depth) as image:
        texts = {name: str(text) for name, text in getattr(image, "text", {}).items()}
        return np.asarray(image).astype(np.int32), texts


def panoptic_png(path: Path) -> np.ndarray:
    """Read the ids [h, w] i32 of a picture of numbers, or of colours, R + 256 G + 65536 B (COCO).

    Raises:
        InvalidFeatures: not a PNG, or one with transparency.
    """
    with _open_png(path, BINARY, _check_opaque) as image:
        values = np.asarray(image).astype(np.int32)
    return values if values.ndim == 2 else values @ np.array([1, 256, 65_536], np.int32)


def binary_picture(path: Path, unlabelled: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Read a picture of one value besides black: [h, w] bool, where it has this value, and where ``unlabelled``.

    Raises:
        InvalidFeatures: not a PNG, or one with transparency or more values.
    """
    with _open_png(path, BINARY, lambda *_: None) as image:
        is_opaque = image.mode in ("RGBA", "LA") and image.getchannel("A").getextrema()[0] == 255
        if not is_opaque:
            _check_opaque(0, "colours with transparency" if image.mode in ("RGBA", "LA") else "", path)
        values = np.asarray(image.convert("RGB") if is_opaque else image)
    grey = values.max(axis=2) if values.ndim == 3 else values
    void = np.zeros(grey.shape, bool) if unlabelled is None else grey == unlabelled
    inside = (grey != 0) & ~void
    inside_values = grey[inside]
    if len(inside_values) and inside_values.min() != inside_values.max():
        got = f"values from {inside_values.min()} to {inside_values.max()} besides 0"
        names_hint = "give the names of label pictures (--names, in Python names=)"
        hint = f"{names_hint}; save a mask with soft edges as values of at least one half"
        raise InvalidFeatures(str(path), expected="one value besides 0, a mask", got=got, hint=hint)
    return inside, void


@contextmanager
def _open_png(path: Path, expected: str, check: Callable[[int, str, Path], None]) -> Iterator[Image.Image]:
    """Open a PNG with Pillow after a check of its bit depth and colour type."""
    try:
        with path.open("rb") as handle:
            header = handle.read(PNG_HEADER_BYTES)
        if len(header) < PNG_HEADER_BYTES or not header.startswith(PNG_SIGNATURE):
            raise InvalidFeatures(str(path), expected=expected, got="a file that is not a PNG")
        check(header[24], PNG_KINDS.get(header[25], "an unknown kind"), path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # Pillow raises at twice the limit
            with Image.open(path, formats=["PNG"]) as image:
                image.load()
                yield image
    except Image.DecompressionBombError:
        limit = 2 * (Image.MAX_IMAGE_PIXELS or 0)
        raise InvalidFeatures(str(path), expected=f"at most {limit} pixels", got="a larger picture") from None
    except UnidentifiedImageError:
        raise InvalidFeatures(str(path), expected=expected, got="one that Pillow cannot identify") from None
    except (OSError, SyntaxError, ValueError, EOFError) as error:  # Pillow's errors for truncated or broken files
        got = f"one that does not open ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected=expected, got=got, hint="write it again") from None


def _check_label_depth(depth: int, kind: str, path: Path) -> None:
    """Check that Pillow reads the stored values unchanged: it scales grey values of few bits to 0 to 255."""
    if kind != "a palette" and not (kind == "grey" and depth in (8, 16)):
        hint = "move photos to another folder; save a picture of colours with one number for each colour"
        raise InvalidFeatures(str(path), expected=LABELS, got=f"{kind} of {depth} bits", hint=hint)


def _check_opaque(_: int, kind: str, path: Path) -> None:
    if "transparency" in kind:
        hint = "write only the mask: cv2.imwrite(name, 255 * mask.astype(numpy.uint8))"
        raise InvalidFeatures(str(path), expected=BINARY, got=kind, hint=hint)


@dataclass(frozen=True)
class RunMask:
    """A mask as run lengths."""

    size: tuple[int, int]  # h, w
    lengths: np.ndarray  # [n] i64, whose sum is h w

    def pixels(self) -> np.ndarray:
        """Decode the mask, [h, w] bool."""
        return mask_of_runs(self.size, self.lengths)

    def is_empty(self) -> bool:
        """Return True if no pixel is inside."""
        return not self.lengths[1::2].any()


@dataclass(frozen=True)
class PolygonMask:
    """A mask as the union of polygons."""

    size: tuple[int, int]  # h, w
    parts: tuple[np.ndarray, ...]  # [n, 2] f64 each, x and y in pixels

    def pixels(self) -> np.ndarray:
        """Fill the mask, [h, w] bool."""
        return fill_polygons(self.size, self.parts)

    def is_empty(self) -> bool:
        """Return True if no pixel is inside."""
        return not self.pixels().any()

    def reaches_beyond(self, size: tuple[int, int]) -> bool:
        """Return True if a corner is further outside an image (h, w) than rounding and drawing by hand explain."""
        height, width = size
        corner_limit = np.array([width, height]) * (1 + OVERHANG) + 1
        return any((part > corner_limit).any() for part in self.parts)


StoredMask = RunMask | PolygonMask


@dataclass(frozen=True)
class StoredMasks(Sequence[np.ndarray]):
    """Sequence of masks of one size, each decoded as [h, w] bool at every access."""

    stored: tuple[StoredMask, ...]

    @overload
    def __getitem__(self, index: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, index: slice) -> "StoredMasks": ...
    def __getitem__(self, index: int | slice) -> "np.ndarray | StoredMasks":
        return StoredMasks(self.stored[index]) if isinstance(index, slice) else self.stored[index].pixels()

    def __len__(self) -> int:
        return len(self.stored)


def read_mask_json(path: Path) -> Any:
    """Read the content of a JSON file of masks.

    Raises:
        InvalidFeatures: not JSON, or larger than MAX_JSON_BYTES.
    """
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            got, hint = f"{path.stat().st_size} bytes", "write compressed counts (coco_rle), which are smaller"
            raise InvalidFeatures(str(path), expected=f"at most {MAX_JSON_BYTES} bytes", got=got, hint=hint)
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InvalidFeatures(str(path), expected=MASK_LIST, got=f"no such file ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        got = f"invalid JSON ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected=MASK_LIST, got=got, hint="write it with json.dump") from None


def mask_records(content: Any, path: Path) -> list[Any]:
    """Return the records of masks of a document: a list, or the list under one of RECORD_LISTS.

    Raises:
        InvalidFeatures: there is no such list.
    """
    candidates = (content.get(key) for key in RECORD_LISTS) if isinstance(content, dict) else iter([content])
    records = next((records for records in candidates if isinstance(records, list)), None)
    if records is None:
        got = f"an object of {', '.join(map(repr, list(content)[:3]))}"[:120] if isinstance(content, dict) else "none"
        raise InvalidFeatures(str(path), expected=MASK_LIST, got=got, hint="move files without views out of it")
    return records


def read_mask(record: Any, size: tuple[int, int] | None, location: str) -> StoredMask | None:
    """Read the mask of a record, run lengths or polygons; None if it has no mask, or polygons without a part.

    Args:
        size: (h, w) of the image, needed for polygons; None: unknown.
        location: of the record in its file, for errors.

    Raises:
        InvalidFeatures: as in `read_runs` and `read_polygons`, or polygons of an image of unknown size.
    """
    fields = record if isinstance(record, dict) else {}
    bitmap, shape = fields.get("bitmap"), fields.get("shape_type")
    if shape == "mask" or isinstance(bitmap, dict):
        corner = bitmap.get("origin") if isinstance(bitmap, dict) else (fields.get("points") or [None])[0]
        content = bitmap.get("data") if isinstance(bitmap, dict) else fields.get("mask")
        return _read_bitmap(content, corner, _known_size(size, location), location)
    segmentation = next((fields[key] for key in SEGMENTATIONS if fields.get(key) is not None), None)
    if segmentation is None or segmentation == []:
        return None
    rings = _rings(segmentation)
    if rings is None and not isinstance(segmentation, list):
        return RunMask(*read_runs(segmentation, location))
    parts = read_polygons(segmentation, location) if rings is None else [_join_rings(rings, location)]
    parts = [_circle_outline(parts[0])] if shape == "circle" and parts and len(parts[0]) == 2 else parts
    corners = np.concatenate([part.reshape(-1) for part in parts])
    if len(corners) >= 6 and 0 <= corners.min() <= corners.max() <= 1 and (size is None or max(size) > 2):
        hint = "multiply x by the image's width and y by its height"
        raise InvalidFeatures(
            location, expected="a polygon in pixels", got="one in fractions of the image", hint=hint
        )
    return PolygonMask(_known_size(size, location), tuple(parts))


def _known_size(size: tuple[int, int] | None, location: str) -> tuple[int, int]:
    if size is None:
        hint = "give the image's width and height, or masks as run lengths"
        raise InvalidFeatures(location, expected="the size of the image of a polygon", got="none", hint=hint)
    check_size(size, location)
    return size


def _rings(segmentation: Any) -> list[Any] | None:
    """Return the rings of a record of rings, the outer one first; None for other records."""
    if not isinstance(segmentation, dict):
        return None
    if isinstance(segmentation.get("paths"), list):
        return segmentation["paths"]
    if all(isinstance(segmentation.get(axis), list) for axis in "xy"):  # of Ultralytics
        return [[list(point) for point in zip(segmentation["x"], segmentation["y"], strict=False)]]
    inner = segmentation.get("interior")
    return (
        [segmentation["exterior"], *(inner if isinstance(inner, list) else [])]
        if "exterior" in segmentation
        else None
    )


def _join_rings(rings: Sequence[Any], location: str) -> np.ndarray:
    """Join rings to one outline [n, 2] f64, with lines between them in both directions, which cancel."""
    outlines = [part for ring in rings for part in read_polygons(ring, location) if len(part)]
    closed = [np.concatenate([part, part[:1], outlines[0][:1]]) for part in outlines]
    return np.concatenate(closed) if closed else np.zeros((0, 2))


def _circle_outline(points: np.ndarray) -> np.ndarray:
    """Return the outline [n, 2] f64 of a circle from its centre and a point on it [2, 2]."""
    centre, rim = points
    angles = np.linspace(0, 2 * np.pi, CIRCLE_CORNERS, endpoint=False)
    return centre + np.hypot(*(rim - centre)) * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _read_bitmap(content: Any, corner: Any, size: tuple[int, int], location: str) -> RunMask:
    """Read the mask of a PNG in base64, possibly deflated, with its corner (x, y) in pixels of the image."""
    try:
        packed = base64.b64decode(content, validate=True)
        unpacker = zlib.decompressobj()
        png = packed if packed.startswith(PNG_SIGNATURE) else unpacker.decompress(packed, MAX_PICTURE_BYTES)
        with Image.open(io.BytesIO(png), formats=["PNG"]) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(f"{image.width}x{image.height} pixels")
            is_alpha = image.mode in ("LA", "RGBA")
            inside = np.asarray(image.getchannel("A") if is_alpha else image.convert("L")) > 0
        left, top = (round(float(place)) for place in corner)
    except (TypeError, ValueError, OverflowError, zlib.error, OSError, SyntaxError, TOO_LARGE) as error:
        got, expected = str(error)[:80] or "none", "a PNG in base64 and its corner (x, y)"
        raise InvalidFeatures(location, expected=expected, got=got) from None
    height, width = size
    if not (top >= 0 and top + inside.shape[0] <= height and left >= 0 and left + inside.shape[1] <= width):
        got = f"{inside.shape[1]} x {inside.shape[0]} pixels at ({left}, {top})"
        raise InvalidFeatures(location, expected=f"a picture within {width} x {height} pixels", got=got)
    full_image = np.zeros(size, bool)
    full_image[top : top + inside.shape[0], left : left + inside.shape[1]] = inside
    flat = np.concatenate([[False], full_image.T.reshape(-1)])
    changes = np.flatnonzero(flat[1:] != flat[:-1])
    return RunMask(size, np.diff(np.concatenate([[0], changes, [full_image.size]])))


def read_polygons(segmentation: Any, location: str) -> list[np.ndarray]:
    """Read the parts of a polygon, [n, 2] f64 each: x and y in pixels.

    Args:
        segmentation: one list x1, y1, x2, y2, ... for each part, or for the only one; or the points of one part, as
            lists [x, y] or objects of x and y.

    Raises:
        InvalidFeatures: another structure, or a coordinate that is not a finite number within MAX_COORDINATE.
    """
    items = segmentation if isinstance(segmentation, list) else [segmentation]
    points = [[point.get("x"), point.get("y")] if isinstance(point, dict) else point for point in items]
    if points and all(isinstance(point, list) and len(point) == 2 for point in points):
        points = [[number for point in points for number in point]]
    elif points and not isinstance(points[0], list):
        points = [points]
    for part in points:
        if not isinstance(part, list) or len(part) % 2 or not all(map(_is_coordinate, part)):
            expected = "parts [x1, y1, x2, y2, ...] of a polygon, or its points [x, y], in pixels"
            raise InvalidFeatures(location, expected=expected, got=repr(part)[:80])
    return [np.array(part, np.float64).reshape(-1, 2) for part in points]


def _is_coordinate(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MAX_COORDINATE


def fill_polygons(size: tuple[int, int], parts: Iterable[np.ndarray]) -> np.ndarray:
    """Fill the union of polygons [n, 2] by the even-odd rule at the centres of pixels, [h, w] bool.

    Polygons are clipped to the image. cocodataset/cocoapi (``rleFrPoly``) rounds corners to fifths of a pixel first,
    so its outlines differ by a fraction of a pixel.

    Raises:
        InvalidFeatures: a part's edges cross more than MAX_CROSSINGS columns of pixels.
    """
    height, width = size
    inside = np.zeros(size, bool)
    for part in parts:
        ends = np.roll(part, -1, axis=0)
        low, high = np.minimum(part, ends)[:, 0], np.maximum(part, ends)[:, 0]
        first, last = (np.clip(np.ceil(side - 0.5), 0, width).astype(np.int64) for side in (low, high))
        if (crossed := int((last - first).sum())) > MAX_CROSSINGS:
            expected = f"at most {MAX_CROSSINGS} crossings of its edges with columns of pixels"
            raise InvalidFeatures("polygon", expected=expected, got=f"{crossed} by {len(part)} corners")
        edges = np.repeat(np.arange(len(part)), last - first)  # an entry for each column whose centre an edge crosses
        if not len(edges):
            continue
        columns = np.arange(len(edges)) - np.repeat(np.cumsum(last - first) - last, last - first)
        (x, y), (dx, dy) = part[edges].T, (ends - part)[edges].T
        rows = np.clip(np.ceil(y + (columns + 0.5 - x) * dy / dx - 0.5), 0, height).astype(np.int64)
        left, top = int(columns.min()), int(rows.min())
        box = int(rows.max()) - top, int(columns.max()) + 1 - left
        places = (rows - top) * box[1] + columns - left
        crossings = np.bincount(places, minlength=(box[0] + 1) * box[1]).reshape(-1, box[1])[: box[0]] % 2 == 1
        inside[top : top + box[0], left : left + box[1]] |= np.logical_xor.accumulate(crossings, axis=0)
    return inside


def check_size(size: tuple[int, int], location: str) -> None:
    """Check that a size of masks (h, w) is within bounds.

    Raises:
        InvalidFeatures: a side below 1 or above MAX_SIDE, or more than MAX_PIXELS pixels.
    """
    height, width = size
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE and height * width <= MAX_PIXELS):
        expected = f"sides in 1..{MAX_SIDE} and at most {MAX_PIXELS} pixels"
        raise InvalidFeatures(location, expected=expected, got=f"size {height} x {width}"[:80])


def read_runs(segmentation: Any, location: str) -> tuple[tuple[int, int], np.ndarray]:
    """Read size and run lengths of a mask in JSON, ``{"size": [h, w], "counts": ...}``.

    Returns:
        (h, w), and the lengths [n] i64, whose sum is h w.

    Raises:
        InvalidFeatures: another structure, a size out of bounds, a string that is truncated or has other characters,
            or lengths that do not cover the image exactly. The error starts with ``location``.
    """
    if not isinstance(segmentation, dict) or not {"size", "counts"} <= segmentation.keys():
        hint = "segment-anything writes them with output_mode='uncompressed_rle' or 'coco_rle'"
        raise InvalidFeatures(location, expected="run lengths {size, counts}", got=repr(segmentation)[:80], hint=hint)
    size, counts = segmentation["size"], segmentation["counts"]
    if not (isinstance(size, list) and len(size) == 2 and all(type(side) is int for side in size)):
        raise InvalidFeatures(location, expected="size [h, w]", got=repr(size)[:80])
    height, width = size
    check_size((height, width), location)
    lengths = _decompress_counts(counts, location) if isinstance(counts, str) else counts
    if not isinstance(lengths, list) or not all(type(length) is int for length in lengths):
        raise InvalidFeatures(location, expected="counts, a list of whole numbers or a string", got=repr(counts)[:80])
    if min(lengths, default=0) < 0:
        raise InvalidFeatures(location, expected="counts from 0 on", got=f"a run of {min(lengths)}"[:80])
    if sum(lengths) != height * width:
        expected = f"counts that sum up to {height} x {width} = {height * width}"
        hint = "the file is truncated, or size is not [h, w] of the mask"
        raise InvalidFeatures(location, expected=expected, got=f"a sum of {sum(lengths)}"[:80], hint=hint)
    return (height, width), np.array(lengths, np.int64)


def mask_of_runs(size: tuple[int, int], lengths: np.ndarray) -> np.ndarray:
    """Decode valid run lengths to a mask [h, w] bool."""
    height, width = size
    inside = np.arange(len(lengths)) % 2 == 1
    return np.repeat(inside, lengths).reshape(width, height).T


def _without_bytes_notation(text: str) -> str:
    """Return the counts of a text ``b'...'``, which ``str`` writes for the bytes of pycocotools.

    Counts have no quotes, and the backslash is their only character that Python escapes.
    """
    is_bytes = len(text) > 2 and text[0] == "b" and text[1] in "'\"" and text[-1] == text[1]
    return text[2:-1].replace("\\\\", "\\") if is_bytes else text


def _decompress_counts(text: str, location: str) -> list[int]:
    text = _without_bytes_notation(text)
    numbers: list[int] = []
    number = groups = 0
    for character in text:
        if not LOWEST <= ord(character) <= HIGHEST or groups == MAX_GROUPS:
            expected = f"counts of characters {chr(LOWEST)!r} to {chr(HIGHEST)!r}, {MAX_GROUPS} at most for a number"
            raise InvalidFeatures(location, expected=expected, got=f"{character!r} in number {len(numbers)}")
        group = ord(character) - LOWEST
        number |= (group & VALUE) << GROUP_BITS * groups
        groups += 1
        if group & CONTINUATION:
            continue
        numbers.append(number - (1 << GROUP_BITS * groups) if group & SIGN else number)
        number = groups = 0
    if groups:
        raise InvalidFeatures(location, expected="complete counts", got="a string that ends within a number")
    # Numbers are differences to the one two before, so there are two cumulative sums, of odd and of even positions.
    lengths = numbers[:1] + [0] * (len(numbers) - 1)
    lengths[1::2] = accumulate(numbers[1::2])
    lengths[2::2] = accumulate(numbers[2::2])
    return lengths
