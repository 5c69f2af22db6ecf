"""Folders of masks with one vector each: SAM's masks, say, and CLIP's vector of the crop of each.

``IMG.npy`` [M, F] holds the vectors, row k of mask k. The masks are in one of: ``IMG.json``, run lengths as
segment-anything returns them, or polygons; ``IMG_masks.npy`` (or ``.npz``), booleans [M, H, W], also [M, 1, H, W] as
SAM's predictor returns them, or ids [H, W] or [L, H, W] with -1 for none;
``IMG.png``, a label picture of one channel. They need not have the photo's size.

In a label picture where 0 means unlabelled, as most programs have it, value v is mask v - 1. Where another value
does (255, 65535), value v is mask v. Whoever takes the one for the other is one off in every mask, so with 0 the
values must end at the number of vectors.

Masks that overlap become levels of labels that do not (`label_levels`).

segment-anything's ``SamAutomaticMaskGenerator`` and SA-1B keep a list of objects whose ``segmentation`` is run
lengths (`liftcore.features.mask_files`), alone or under ``annotations``. Mask k is the list's k-th.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.features.folders import ViewFolder, files_below, files_by_view, mask_ids, npy_files
from liftcore.features.mask_files import (
    StoredMasks,
    label_png,
    mask_records,
    read_mask,
    read_mask_json,
)
from liftcore.features.mask_json import stated_size
from liftcore.io.npy import NUMBERS, open_array, read_floats, without_unit_axes
from liftcore.values.views import NO_LABEL, Regions, label_levels

VECTORS = ".npy"
ARRAY, RUNS, PICTURE = "_masks.npy", ".json", ".png"
ZIPPED_ARRAY = "_masks.npz"
OVERLAP = "photos belong in another folder than their masks"


def mask_files(folder: Path) -> dict[str, Path]:
    """View -> its file of masks, of a folder and its sub-folders that hold no vectors.

    Raises:
        InvalidFeatures: the folder has none, or vectors, or a view has two.
    """
    if not folder.is_dir():
        raise InvalidFeatures(str(folder), expected="a folder of masks", got="no such folder")
    arrays = [path for path in files_below(folder) if path.name.endswith((VECTORS, ZIPPED_ARRAY))]
    vectors = [path.name for path in arrays if not path.name.endswith((ARRAY, ZIPPED_ARRAY))]
    if vectors:
        hint = "leave the encoder out: these are packed as they are"
        raise InvalidFeatures(str(folder), expected="masks without vectors", got=vectors[0], hint=hint)
    found = files_by_view(
        [*arrays, *_pictures(folder)], folder, ARRAY, ZIPPED_ARRAY, what="file of masks", hint=OVERLAP
    )
    if not found:
        expected = f"masks as IMG{RUNS}, IMG{ARRAY} or IMG{PICTURE}"
        raise InvalidFeatures(str(folder), expected=expected, got="no such files")
    return found


def labels_alone(path: Path, unlabelled: int = 0) -> tuple[np.ndarray, int]:
    """[L, h, w] i32 of a view's masks, -1 for none, and how many masks it has, without vectors to be held to.

    Raises:
        InvalidFeatures: as `mask_views` has it.
    """
    if path.suffix.lower() == RUNS:
        rows = len(mask_records(read_mask_json(path), path))
    elif path.suffix.lower() == PICTURE:
        values = label_png(path)[0]
        high = int(values.max(initial=0, where=values != unlabelled))
        rows = high + (unlabelled != 0 and bool((values != unlabelled).any()))
    else:
        stored = _planes(open_array(path, kinds=NUMBERS + "b"))
        high = float(stored.max())
        if not np.isfinite(high):
            raise InvalidFeatures(str(path), expected="mask ids, or booleans", got="numbers that are not finite")
        rows = len(stored) if stored.dtype.kind == "b" else max(-1, int(high)) + 1
    if not rows:
        raise InvalidFeatures(
            str(path), expected="one mask or more", got="none", hint="leave out views without masks"
        )
    return _labels(path, rows, unlabelled), rows


def mask_views(
    folder: Path, unlabelled: int = 0, made: Mapping[str, np.ndarray] | None = None
) -> ViewFolder[Regions]:
    """The regions of a folder and its sub-folders: labels are rows of the vectors, in the order of the masks.

    Args:
        folder: the folder. unlabelled: what pixels without a mask have in label pictures.
        made: view -> vectors [M, F], of a folder that has none (`liftcore.features.encoders.crops`).

    Raises:
        InvalidFeatures: the folder has no vectors, vectors lack masks or masks vectors, or a view has two files of
            one of them. Reading a view: a file is malformed, masks and vectors are not as many, or masks take too
            many levels.
    """
    if made is not None:
        files = mask_files(folder)

        def with_made(view: str) -> Regions:
            return Regions(_labels(files[view], len(made[view]), unlabelled), made[view], where=f"view {view!r}")

        return ViewFolder(files, with_made)
    arrays = npy_files(folder, VECTORS, ZIPPED_ARRAY)
    found = [*(path for path in arrays if path.name.endswith((ARRAY, ZIPPED_ARRAY))), *_pictures(folder)]
    masks = files_by_view(found, folder, ARRAY, ZIPPED_ARRAY, what="file of masks", hint=OVERLAP)
    found = [path for path in arrays if not path.name.endswith((ARRAY, ZIPPED_ARRAY))]
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


def _pictures(folder: Path) -> list[Path]:
    return [path for path in files_below(folder) if path.suffix.lower() in (RUNS, PICTURE)]


def _labels(path: Path, rows: int, unlabelled: int) -> np.ndarray:
    """[L, h, w] i32 of a view's masks, each a row of its vectors."""
    if path.suffix.lower() == PICTURE:
        return picture_labels(path, rows, unlabelled)
    if path.suffix.lower() == RUNS:
        return label_levels(sam_masks(path, rows), str(path))
    stored = _planes(open_array(path, kinds=NUMBERS + "b"))
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
    return label_levels(list(stored), str(path))  # planes of the mapped file, not read yet


def picture_labels(path: Path, rows: int, unlabelled: int) -> np.ndarray:
    """[1, h, w] i32 of masks, -1 for none.

    Args:
        path: the picture. rows: vectors that there are. unlabelled: the value of pixels without a mask.

    Raises:
        InvalidFeatures: the file is no such PNG, or a value has no vector; with 0 for unlabelled also when vectors
            are left over at the end.
    """
    values = label_png(path)[0]
    labelled = values != unlabelled
    high = int(values.max(initial=0, where=labelled))
    if unlabelled == 0 and high != rows:
        other = "is there a vector for 0 too, or does another value mean none (--unlabelled 255)?"
        hint = (
            other
            if high < rows
            else "name the value that means none with --unlabelled (255, 65535), in Python unlabelled="
        )
        expected = f"values 1..{rows} for {rows} vectors, and 0 for none"
        raise InvalidFeatures(str(path), expected=expected, got=f"values up to {high}", hint=hint)
    if unlabelled and high >= rows:
        expected = f"values 0..{rows - 1} for {rows} vectors, and {unlabelled} for none"
        hint = "where 0 means none, value 1 has the first vector: --unlabelled 0, in Python unlabelled=0"
        raise InvalidFeatures(str(path), expected=expected, got=f"the value {high}", hint=hint)
    return np.where(labelled, values - (unlabelled == 0), NO_LABEL).astype(np.int32)[None]


def _planes(stored: np.ndarray) -> np.ndarray:
    """Masks [M, H, W] of such with an axis of length 1 before it, behind M as SAM's predictor has them, or last."""
    found = without_unit_axes(stored, 4)
    if found.ndim == 4 and 1 in (found.shape[1], found.shape[3]) and found.dtype.kind == "b":
        found = found[:, 0] if found.shape[1] == 1 else found[..., 0]
    return without_unit_axes(found, 3)


def sam_masks(path: Path, count: int) -> StoredMasks:
    """The masks of a file, in its order.

    Args:
        path: the file. count: how many vectors there are. Where the lists differ, nobody knows from which place on
            they ceased to match, so that is refused before anything is decoded.

    Raises:
        InvalidFeatures: no such JSON, not ``count`` masks, a record without one, masks of several sizes, or as
            `read_mask`.
    """
    content = read_mask_json(path)
    records, stated = mask_records(content, path), stated_size(content)
    if len(records) != count:
        hint = "leave out views without masks" if not records else "row k of the vectors is of mask k of the list"
        raise InvalidFeatures(str(path), expected=f"{count} masks, one a vector", got=str(len(records)), hint=hint)
    found = []
    for number, record in enumerate(records):
        if (mask := read_mask(record, stated, f"{path} mask {number}")) is None:
            hint = "segment-anything writes them with output_mode='uncompressed_rle' or 'coco_rle'"
            expected = "a segmentation, run lengths {size, counts} or polygons"
            raise InvalidFeatures(f"{path} mask {number}", expected=expected, got="none", hint=hint)
        found.append(mask)
    size = found[0].size
    for number, mask in enumerate(found):
        if (other := mask.size) != size:
            got = f"{size[0]} x {size[1]} of mask 0 and {other[0]} x {other[1]} of mask {number}"
            raise InvalidFeatures(str(path), expected="masks of one size", got=got, hint="write those of one photo")
    return StoredMasks(tuple(found))
