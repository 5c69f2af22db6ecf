"""Folders of masks with one vector each: SAM's masks, say, and CLIP's vector of the crop of each.

``IMG.npy`` [M, F] holds the vectors, row k of mask k. The masks are in one of: ``IMG.json``, run lengths as
segment-anything returns them; ``IMG_masks.npy``, booleans [M, H, W] or ids [H, W] or [L, H, W] with -1 for none;
``IMG.png``, a label picture. Masks that overlap are laid on levels (`layering`). They need not have the photo's size.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.errors import InvalidFeatures
from liftcore.features.folder import ViewFolder, files_below, npy_files
from liftcore.features.label_picture import picture_labels
from liftcore.features.layering import layered
from liftcore.features.mask_ids import mask_ids
from liftcore.features.mask_vectors import mask_vectors
from liftcore.features.sam_json import sam_masks
from liftcore.features.views import Regions
from liftcore.io.npy import NUMBERS, open_npy
from liftcore.scene.views import without_image_suffix

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    import numpy as np

VECTORS = ".npy"
ARRAY, RUNS, PICTURE = "_masks.npy", ".json", ".png"


class MaskViews(ViewFolder):
    """The views of a folder of masks and vectors; both are checked when a view is read."""

    def __init__(self, vectors: Mapping[str, Path], masks: Mapping[str, Path], unlabelled: int) -> None:
        super().__init__(vectors)
        self.masks = masks
        self.unlabelled = unlabelled

    @property
    def inputs(self) -> list[Path]:
        """All files that are read."""
        return [*super().inputs, *self.masks.values()]

    def read(self, view: str) -> Regions:
        """The region map of one view: labels are rows of the vectors, in the order of the masks.

        Raises:
            InvalidFeatures: a file is malformed, masks and vectors are not as many, or masks take too many levels.
        """
        vectors = mask_vectors(self.files[view])
        labels = _labels(self.masks[view], len(vectors), self.unlabelled)
        return Regions(labels, vectors, where=f"view {view!r}")


def mask_views(folder: Path, unlabelled: int = 0) -> MaskViews:
    """The views of a folder and its sub-folders.

    ``IMG.jpg.npy`` is of the view ``IMG``, as the camera of ``IMG.jpg`` is.

    Args:
        folder: the folder. unlabelled: what pixels without a mask have in label pictures.

    Raises:
        InvalidFeatures: the folder has no vectors, vectors lack masks or masks vectors, or a view has two files of
            one of them.
    """
    arrays = npy_files(folder, VECTORS).values()
    others = [path for path in files_below(folder) if path.suffix.lower() in (RUNS, PICTURE)]
    masks = _by_view([*(path for path in arrays if path.name.endswith(ARRAY)), *others], folder, "masks")
    vectors = _by_view((path for path in arrays if not path.name.endswith(ARRAY)), folder, "vectors")
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
    return MaskViews(vectors, masks, unlabelled)


def _by_view(paths: Iterable[Path], folder: Path, what: str) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in paths:
        inner = path.relative_to(folder).as_posix()
        view = without_image_suffix(inner.removesuffix(ARRAY if inner.endswith(ARRAY) else path.suffix))
        if view in found:
            got = f"{found[view].name} and {path.name}, both of the view {view!r}"
            hint = "photos belong in another folder than their masks" if what == "masks" else ""
            raise InvalidFeatures(str(folder), expected=f"one file of {what} a view", got=got, hint=hint)
        found[view] = path
    return found


def _labels(path: Path, rows: int, unlabelled: int) -> np.ndarray:
    """[L, h, w] i32 of a view's masks, each a row of its vectors."""
    if path.suffix.lower() == PICTURE:
        return picture_labels(path, rows, unlabelled)
    if path.suffix.lower() == RUNS:
        return layered(sam_masks(path, rows), str(path))
    stored = open_npy(path, kinds=NUMBERS + "b")
    if stored.dtype.kind != "b":
        _check_ids(stored, rows, path)
        return mask_ids(stored, rows, path)
    if stored.ndim != 3:
        raise InvalidFeatures(str(path), expected="booleans [M, H, W]", got=f"bool {list(stored.shape)}")
    if len(stored) != rows:
        hint = "row k of the vectors is of mask k, and masks come first: [M, H, W]"
        got = f"bool {list(stored.shape)}"
        raise InvalidFeatures(str(path), expected=f"{rows} masks, one a vector", got=got, hint=hint)
    return layered(list(stored), str(path))  # planes of the mapped file, not read yet


def _check_ids(stored: np.ndarray, rows: int, path: Path) -> None:
    """Refuse masks of zeros and ones, a plane each: as ids they would all be of the first two vectors."""
    if stored.ndim == 3 and len(stored) == rows > 1 and float(stored.min()) >= 0 and float(stored.max()) <= 1:
        got = f"{stored.dtype} {list(stored.shape)} of zeros and ones"
        hint = "masks that may overlap are booleans: numpy.save(name, masks.astype(bool))"
        raise InvalidFeatures(str(path), expected="mask ids, or booleans", got=got, hint=hint)
