"""Folders of masks with one vector each, for example SAM's masks with CLIP's vector of each crop.

``IMG.npy`` [M, F] contains the vectors, row k for mask k. The masks are in one of these files, of any resolution:
``IMG.json``, run lengths as segment-anything returns them, or polygons; ``IMG_masks.npy`` (or ``.npz``), booleans
[M, H, W], also [M, 1, H, W] as SAM's predictor returns them, or ids [H, W] or [L, H, W] with -1 for none;
``IMG.png``, a label picture of one channel.

In a label picture where 0 means unlabelled, as in most programs, value v is mask v - 1. Where another value does
(255, 65535), value v is mask v. A mistake between these would shift every mask by one, so with 0 for unlabelled the
largest value must be the number of vectors.

A view whose arrays or lists are empty, in which nothing was found, has no label.

Masks that overlap become levels of labels without overlap (`label_levels`).

segment-anything's ``SamAutomaticMaskGenerator`` and SA-1B store a list of objects whose ``segmentation`` is run
lengths (`liftcore.features.mask_files`), as the document or under ``annotations``. Mask k is item k of the list.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from liftcore.errors import InvalidFeatures, reading
from liftcore.features.folders import ViewFolder, files_below, files_by_view, npy_files, whole_numbers
from liftcore.features.mask_files import AS_COCO, StoredMasks, label_png, mask_records, read_mask, read_mask_json
from liftcore.features.mask_json import declared_size
from liftcore.io.npy import NUMBERS, open_array, read_floats, without_unit_axes
from liftcore.values.views import NO_LABEL, Regions, label_levels

VECTORS = ".npy"
ARRAY, RUNS, PICTURE = "_masks.npy", ".json", ".png"
ZIPPED_ARRAY = "_masks.npz"
UNLABELLED = np.full((1, 1, 1), NO_LABEL, np.int32)


def mask_files(folder: Path) -> dict[str, Path]:
    """Return view -> its file of masks, of a folder without vectors and its sub-folders."""
    arrays = [path for path in files_below(folder) if path.name.endswith((VECTORS, ZIPPED_ARRAY))]
    vectors = [path.name for path in arrays if not path.name.endswith((ARRAY, ZIPPED_ARRAY))]
    if vectors:
        raise ValueError(f"masks without vectors, got {vectors[0]}; omit the encoder: these masks have vectors")
    by_view = _by_view(folder, arrays)
    if not by_view:
        raise ValueError(f"masks as IMG{RUNS}, IMG{ARRAY} or IMG{PICTURE}, got no such files")
    return by_view


def labels_alone(path: Path, unlabelled: int) -> tuple[np.ndarray, int]:
    """Read labels [L, h, w] i32 of a view's masks without vectors, -1 for none, and the number of masks."""
    with reading(path, InvalidFeatures, "masks"):
        labels, rows = _labels(path, None, unlabelled)
        return Regions(labels, np.zeros((max(rows, 1), 1), np.float32), context=str(path)).labels.numpy(), rows


def mask_views(
    folder: Path, unlabelled: int = 0, mask_vectors: Mapping[str, np.ndarray] | None = None
) -> ViewFolder[Regions]:
    """Open the regions of a folder and its sub-folders. Labels are rows of the vectors, in the order of the masks.

    Args:
        folder: of the masks. unlabelled: value of pixels without a mask in label pictures.
        mask_vectors: view -> vectors [M, F], for a folder without vectors (`liftcore.features.encoders.crops`).
    """
    if mask_vectors is not None:
        by_view = mask_files(folder)

        def add_masks(view: str) -> Regions:
            labels, _ = _labels(by_view[view], len(mask_vectors[view]), unlabelled)
            return _regions(labels, mask_vectors[view], mask_vectors.values(), view)

        return ViewFolder(by_view, add_masks)
    arrays = npy_files(folder, VECTORS, ZIPPED_ARRAY)
    masks = _by_view(folder, [path for path in arrays if path.name.endswith((ARRAY, ZIPPED_ARRAY))])
    files = [path for path in arrays if not path.name.endswith((ARRAY, ZIPPED_ARRAY))]
    vectors = files_by_view(files, folder, noun="file of vectors")
    for view in sorted(vectors.keys() ^ masks.keys()):
        path, hint = vectors.get(view) or masks[view], "move photos and other files to another folder"
        expected = f"masks in {view}{RUNS}, {view}{ARRAY} or {view}{PICTURE}"
        if path.name.endswith(("_s.npy", "_f.npy")):
            hint = "pack folders of LangSplat with 'splatlift pack langsplat'"
        if view in masks:
            expected = f"vectors in {view}{VECTORS}"
        raise ValueError(f"{expected}, got {path.name} alone; {hint}")

    def read(view: str) -> Regions:
        codebook = read_floats(vectors[view], "M, F")
        with reading(masks[view], InvalidFeatures, "masks"):
            labels, _ = _labels(masks[view], len(codebook), unlabelled)
        return _regions(labels, codebook, (read_floats(path, "M, F") for path in vectors.values()), view)

    return ViewFolder(vectors, read, masks.values())


def _regions(labels: np.ndarray, codebook: np.ndarray, all_vectors: Iterable[np.ndarray], view: str) -> Regions:
    """Return the regions of a view; without a mask those of a row of zeros, as wide as the vectors of other views."""
    if not len(codebook):
        codebook = np.zeros((1, next((rows.shape[1] for rows in all_vectors if len(rows)), 0)), np.float32)
    return Regions(labels, codebook, context=f"view {view!r}")


def _by_view(folder: Path, arrays: list[Path]) -> dict[str, Path]:
    """Return view -> its file of masks: one of the arrays, run lengths or a picture."""
    files = [*arrays, *(path for path in files_below(folder) if path.suffix.lower() in (RUNS, PICTURE))]
    hint = "move photos to another folder than their masks"
    return files_by_view(files, folder, ARRAY, ZIPPED_ARRAY, noun="file of masks", hint=hint)


def _labels(path: Path, rows: int | None, unlabelled: int) -> tuple[np.ndarray, int]:
    """Read labels [L, h, w] of a view's masks, rows of its vectors, and their number: ``rows`` if that is known."""
    if path.suffix.lower() == PICTURE:
        return _picture_labels(path, rows, unlabelled)
    if path.suffix.lower() == RUNS:
        masks = _stored_masks(path, rows)
        return (label_levels(masks) if masks else UNLABELLED), len(masks)
    stored = open_array(path, kinds=NUMBERS + "b")
    if not stored.size:
        _check_count(0, rows)
        return UNLABELLED, 0
    stored = _planes(stored)
    if stored.dtype.kind != "b":
        ids = whole_numbers(stored)
        return ids, int(ids.max()) + 1
    if stored.ndim != 3:
        raise ValueError(f"booleans [M, H, W], got {stored.dtype} {list(stored.shape)}")
    _check_count(len(stored), rows)
    return label_levels(list(stored)), len(stored)  # planes of the mapped file, not read yet


def _check_count(count: int, rows: int | None) -> None:
    if rows is not None and count != rows:
        raise ValueError(f"{rows} masks, one a vector, got {count}; row k of the vectors belongs to mask k")


def _picture_labels(path: Path, rows: int | None, unlabelled: int) -> tuple[np.ndarray, int]:
    """Read labels [1, h, w] i32 of a label picture, -1 for none, and the number of masks (see the module)."""
    values = label_png(path)[0]
    labelled = values != unlabelled
    high = int(values.max(initial=0, where=labelled))
    count = high + (unlabelled != 0 and bool(labelled.any()))
    if rows is not None and unlabelled == 0 and high != rows:
        hint = "give the value of unlabelled pixels with --unlabelled (255, 65535), in Python unlabelled="
        raise ValueError(f"values 1..{rows} for {rows} vectors, and 0 for none, got values up to {high}; {hint}")
    if rows is not None and count > rows and unlabelled:
        expected = f"values 0..{rows - 1} for {rows} vectors, and {unlabelled} for none"
        hint = "if 0 means unlabelled and value 1 has the first vector, give --unlabelled 0, in Python unlabelled=0"
        raise ValueError(f"{expected}, got the value {high}; {hint}")
    return np.where(labelled, values - (unlabelled == 0), NO_LABEL).astype(np.int32)[None], count


def _planes(stored: np.ndarray) -> np.ndarray:
    """Remove an axis of length 1 that is first, after M as in SAM's predictor, or last: [M, H, W] of masks."""
    planes = without_unit_axes(stored, 4)
    if planes.ndim == 4 and 1 in (planes.shape[1], planes.shape[3]) and planes.dtype.kind == "b":
        planes = planes[:, 0] if planes.shape[1] == 1 else planes[..., 0]
    return without_unit_axes(planes, 3)


def _stored_masks(path: Path, rows: int | None) -> StoredMasks:
    """Read the masks of a list of segment-anything, in its order."""
    content = read_mask_json(path)
    records, size_in_file = mask_records(content), declared_size(content)
    _check_count(len(records), rows)
    masks = []
    for number, record in enumerate(records):
        with reading(f"{path} mask {number}", InvalidFeatures, "a segmentation", AS_COCO):
            mask = read_mask(record["segmentation"], size_in_file)
            if mask is None:
                raise ValueError("a segmentation, run lengths {size, counts} or polygons, got none")
            masks.append(mask)
    if len(sizes := sorted({mask.size for mask in masks})) > 1:
        raise ValueError(f"masks of one size, got {sizes[0]} and {sizes[1]}; write the masks of one photo")
    return StoredMasks(tuple(masks))
