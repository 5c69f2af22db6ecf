"""Folders of masks with one vector each: SAM's masks, say, and CLIP's vector of the crop of each.

``IMG.npy`` [M, F] holds the vectors, row k of mask k. The masks are in one of: ``IMG.json``, run lengths as
segment-anything returns them; ``IMG_masks.npy``, booleans [M, H, W] or ids [H, W] or [L, H, W] with -1 for none;
``IMG.png``, a label picture of one channel. They need not have the photo's size.

In a label picture where 0 means unlabelled, as most programs have it, value v is mask v - 1. Where another value
does (255, 65535), value v is mask v. Whoever takes the one for the other is one off in every mask, so with 0 the
values must end at the number of vectors.

Masks that overlap become levels of labels that do not (`layered`).

segment-anything's ``SamAutomaticMaskGenerator`` and SA-1B keep a list of objects whose ``segmentation`` is run
lengths, alone or under ``annotations``. Mask k is the list's k-th. COCO's run lengths say how many pixels lie outside
a mask, then inside, then outside, and so on, down the columns. They are a list of numbers ("uncompressed"), or a
string of them, in which a number is written in groups of five bits, the lowest first, each a character from ``0`` on:
32 says that more groups follow, and 16 in the last that the number is negative. From the fourth on, a number is the
difference to the one two before it. The format is of cocodataset/cocoapi, ``common/maskApi.c`` (``rleToString``,
``rleFrString``).
"""

import json
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, overload

import numpy as np
from PIL import Image, UnidentifiedImageError

from liftcore.errors import InvalidFeatures
from liftcore.features.folders import ViewFolder, files_below, files_by_view, mask_ids, npy_files
from liftcore.features.views import NO_LABEL, Regions
from liftcore.io.npy import NUMBERS, open_npy, read_floats
from liftcore.scene.cameras import MAX_SIDE

VECTORS = ".npy"
ARRAY, RUNS, PICTURE = "_masks.npy", ".json", ".png"
MAX_LEVELS = 32  # a hierarchy of four partitions, with masks 1 to 4 pixels over their neighbours, took 13 to 18
PNG = "a PNG of one channel, 8 or 16 bits of grey or a palette"
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
SAM_LIST = "a list of masks, or {'annotations': [...]}"
GROUP_BITS = 5
MORE, SIGN, VALUE = 32, 16, 31
LOWEST, HIGHEST = ord("0"), ord("0") + 63  # the characters of a group
MOST_GROUPS = 7  # 35 bits: differences of lengths in an image of MAX_SIDE squared, and their sign
MAX_PIXELS = 178_956_970  # as many as Pillow opens


def mask_views(folder: Path, unlabelled: int = 0) -> ViewFolder[Regions]:
    """The regions of a folder and its sub-folders: labels are rows of the vectors, in the order of the masks.

    Args:
        folder: the folder. unlabelled: what pixels without a mask have in label pictures.

    Raises:
        InvalidFeatures: the folder has no vectors, vectors lack masks or masks vectors, or a view has two files of
            one of them. Reading a view: a file is malformed, masks and vectors are not as many, or masks take too
            many levels.
    """
    arrays = npy_files(folder, VECTORS)
    pictures = [path for path in files_below(folder) if path.suffix.lower() in (RUNS, PICTURE)]
    overlap = "photos belong in another folder than their masks"
    found = [*(path for path in arrays if path.name.endswith(ARRAY)), *pictures]
    masks = files_by_view(found, folder, ARRAY, what="file of masks", hint=overlap)
    found = [path for path in arrays if not path.name.endswith(ARRAY)]
    vectors = files_by_view(found, folder, what="file of vectors")
    for view, path in vectors.items():
        if view not in masks:
            expected = f"masks in {view}{RUNS}, {view}{ARRAY} or {view}{PICTURE}"
            langsplat = path.name.endswith(("_s.npy", "_f.npy"))
            hint = "folders of LangSplat are packed by 'splatlift pack langsplat'" if langsplat else ""
            raise InvalidFeatures(str(folder), expected=expected, got=f"{path.name} alone", hint=hint)
    for view, path in masks.items():
        if view not in vectors:
            hint = "photos and other files that are no masks belong in another folder"
            expected = f"vectors in {view}{VECTORS}"
            raise InvalidFeatures(str(folder), expected=expected, got=f"{path.name} alone", hint=hint)

    def read(view: str) -> Regions:
        codebook = read_floats(vectors[view], "M, F")
        return Regions(_labels(masks[view], len(codebook), unlabelled), codebook, where=f"view {view!r}")

    return ViewFolder(vectors, read, masks.values())


def _labels(path: Path, rows: int, unlabelled: int) -> np.ndarray:
    """[L, h, w] i32 of a view's masks, each a row of its vectors."""
    if path.suffix.lower() == PICTURE:
        return picture_labels(path, rows, unlabelled)
    if path.suffix.lower() == RUNS:
        return layered(sam_masks(path, rows), str(path))
    stored = open_npy(path, kinds=NUMBERS + "b")
    got = f"{stored.dtype} {list(stored.shape)}"
    if stored.dtype.kind != "b":
        # Masks of zeros and ones, a plane each, would as ids all be of the first two vectors.
        if stored.ndim == 3 and len(stored) == rows > 1 and float(stored.min()) >= 0 and float(stored.max()) <= 1:
            hint = "masks that may overlap are booleans: numpy.save(name, masks.astype(bool))"
            got = f"{got} of zeros and ones"
            raise InvalidFeatures(str(path), expected="mask ids, or booleans", got=got, hint=hint)
        return mask_ids(stored, rows, path)
    if stored.ndim != 3:
        raise InvalidFeatures(str(path), expected="booleans [M, H, W]", got=got)
    if len(stored) != rows:
        hint = "row k of the vectors is of mask k, and masks come first: [M, H, W]"
        raise InvalidFeatures(str(path), expected=f"{rows} masks, one a vector", got=got, hint=hint)
    return layered(list(stored), str(path))  # planes of the mapped file, not read yet


def layered(masks: Sequence[np.ndarray], where: str) -> np.ndarray:
    """[L, h, w] i32: label k where mask k is, -1 for none; an empty mask has no label.

    The largest mask comes first, of equals the one that was given first, and each goes to the first level on which
    none of its pixels is taken. No pixel of any mask is lost, and what lies alone is on level 0. A lift that takes
    levels as rows of their own asks only which masks lie on a pixel, so there their level does not matter.

    Args:
        masks: [h, w] bool each, at least one, all of one size; each is asked for twice. where: named in the error.

    Raises:
        InvalidFeatures: they take more than MAX_LEVELS levels.
    """
    boxes, areas = zip(*map(_extent, masks), strict=True)
    # Space for all levels that there may be: pages of those that are never written take no memory.
    labels = np.empty((min(MAX_LEVELS, len(masks)), *masks[0].shape), np.int32)
    labels[0] = NO_LABEL
    used = 1
    for number in sorted(range(len(masks)), key=lambda number: -areas[number]):
        if not areas[number]:
            break
        inside, windows = masks[number][boxes[number]], labels[:, *boxes[number]]
        level = next((k for k in range(used) if not ((windows[k] != NO_LABEL) & inside).any()), used)
        if level == MAX_LEVELS:
            depth = np.zeros(masks[0].shape, np.int32)
            for mask in masks:
                depth += mask
            raise InvalidFeatures(
                where,
                expected=f"masks that lie on {MAX_LEVELS} levels without overlap",
                got=f"{len(masks)} masks, up to {depth.max()} of them over one pixel",
                hint="leave out those that are nearly the same, as SamAutomaticMaskGenerator does by box_nms_thresh",
            )
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


def picture_labels(path: Path, rows: int, unlabelled: int) -> np.ndarray:
    """[1, h, w] i32 of masks, -1 for none.

    Args:
        path: the picture. rows: vectors that there are. unlabelled: the value of pixels without a mask.

    Raises:
        InvalidFeatures: the file is no such PNG, or a value has no vector; with 0 for unlabelled also when vectors
            are left over at the end.
    """
    values = _picture(path)
    labelled = values != unlabelled
    high = int(values.max(initial=0, where=labelled))
    if unlabelled == 0 and high != rows:
        other = "is there a vector for 0 too, or does another value mean none (--unlabelled 255)?"
        hint = other if high < rows else "name the value that means none with --unlabelled (255, 65535)"
        expected = f"values 1..{rows} for {rows} vectors, and 0 for none"
        raise InvalidFeatures(str(path), expected=expected, got=f"values up to {high}", hint=hint)
    if unlabelled and high >= rows:
        expected = f"values 0..{rows - 1} for {rows} vectors, and {unlabelled} for none"
        hint = "where 0 means none, value 1 has the first vector: --unlabelled 0"
        raise InvalidFeatures(str(path), expected=expected, got=f"the value {high}", hint=hint)
    return np.where(labelled, values - (unlabelled == 0), NO_LABEL).astype(np.int32)[None]


def _picture(path: Path) -> np.ndarray:
    """[h, w] i32, the numbers as they are stored."""
    try:
        with path.open("rb") as handle:
            _check_png(handle.read(PNG_HEADER_BYTES), path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # it opens, up to twice the limit
            with Image.open(path, formats=["PNG"]) as image:
                return np.asarray(image).astype(np.int32)
    except Image.DecompressionBombError:
        most = 2 * (Image.MAX_IMAGE_PIXELS or 0)
        raise InvalidFeatures(str(path), expected=f"at most {most} pixels", got="a larger picture") from None
    except UnidentifiedImageError:
        raise InvalidFeatures(str(path), expected=PNG, got="one that Pillow does not know") from None
    except (OSError, SyntaxError, ValueError, EOFError) as error:  # Pillow's kinds for files that are cut or broken
        got = f"one that does not open ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected=PNG, got=got, hint="write it anew") from None


def _check_png(header: bytes, path: Path) -> None:
    """Refuse what Pillow would open as other numbers than are stored: it spreads grey of few bits over 0 to 255."""
    if len(header) < PNG_HEADER_BYTES or not header.startswith(PNG_SIGNATURE):
        raise InvalidFeatures(str(path), expected=PNG, got="a file that is no PNG")
    depth, kind = header[24], PNG_KINDS.get(header[25], "an unknown kind")
    if kind != "a palette" and not (kind == "grey" and depth in (8, 16)):
        hint = "a photo belongs in another folder; a picture of colours is one of labels once each has a number"
        raise InvalidFeatures(str(path), expected=PNG, got=f"{kind} of {depth} bits", hint=hint)


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
        if path.stat().st_size > MAX_JSON_BYTES:
            got, hint = f"{path.stat().st_size} bytes", "output_mode='coco_rle' takes a fraction of them"
            raise InvalidFeatures(str(path), expected=f"at most {MAX_JSON_BYTES} bytes", got=got, hint=hint)
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise InvalidFeatures(str(path), expected=SAM_LIST, got=f"no such file ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        got = f"no JSON ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected=SAM_LIST, got=got, hint="write it anew with json.dump") from None
    records = content.get("annotations") if isinstance(content, dict) else content
    if not isinstance(records, list):
        got = f"an object of {', '.join(map(repr, list(content)[:3]))}"[:120] if isinstance(content, dict) else "none"
        raise InvalidFeatures(str(path), expected=SAM_LIST, got=got, hint="files of no views belong elsewhere")
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
