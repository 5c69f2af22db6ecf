"""LangSplat's language features: masks at several levels and one embedding a mask.

``IMG_s.npy`` [L, H, W] holds mask ids, -1 for none, counted on over the levels, so that an id is a row of
``IMG_f.npy`` [M, F]. Occam's LGS, OpenGaussian, LaGa and VALA write the same files.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.errors import InvalidFeatures
from liftcore.observe.folder import ViewFolder, npy_files
from liftcore.observe.npy import open_npy
from liftcore.observe.observation import NO_LABEL, RegionMap

if TYPE_CHECKING:
    from pathlib import Path


class LangSplatViews(ViewFolder):
    """The views of a LangSplat folder; ids and embeddings are checked when a view is read."""

    def read(self, view: str) -> RegionMap:
        """The region map of one view.

        Raises:
            InvalidFeatures: a file is malformed, an id has no embedding, or an embedding is not finite.
        """
        labels_file = self.files[view]
        codebook = open_npy(_codebook_file(labels_file))
        if codebook.ndim != 2 or codebook.dtype.kind != "f" or codebook.dtype.itemsize > 8:
            got = f"{codebook.dtype} {list(codebook.shape)}"
            raise InvalidFeatures(str(_codebook_file(labels_file)), expected="floats [M, F]", got=got)
        labels = _labels(open_npy(labels_file), len(codebook), labels_file)
        dtype = np.float16 if codebook.dtype.itemsize == 2 else np.float32
        with np.errstate(over="ignore"):  # becomes infinite, and is refused as such where packs are written
            rows = codebook.astype(dtype, order="C")
        return RegionMap(torch.from_numpy(labels), torch.from_numpy(rows))


def langsplat_views(folder: Path) -> LangSplatViews:
    """The views of a folder of ``IMG_s.npy`` and ``IMG_f.npy`` files.

    Raises:
        InvalidFeatures: the folder has no such files, or a map lacks its embeddings.
    """
    files = npy_files(folder, "_s.npy")
    for path in files.values():
        if not _codebook_file(path).is_file():
            expected = f"embeddings in {_codebook_file(path).name}"
            raise InvalidFeatures(str(folder), expected=expected, got=f"{path.name} alone")
    return LangSplatViews(files)


def _codebook_file(labels_file: Path) -> Path:
    return labels_file.with_name(labels_file.name.removesuffix("_s.npy") + "_f.npy")


def _labels(stored: np.ndarray, rows: int, path: Path) -> np.ndarray:
    """[L, H, W] i32 of ids stored as integers or as floats."""
    if stored.ndim not in (2, 3):
        raise InvalidFeatures(str(path), expected="mask ids [L, H, W]", got=str(list(stored.shape)))
    low, high = float(stored.min()), float(stored.max())
    # NaN fails every comparison, so it is refused here too.
    if not (low >= NO_LABEL and high < rows):
        got = f"ids from {low:g} to {high:g}"
        hint = "ids are counted on over the levels; those of each level alone must be shifted first"
        raise InvalidFeatures(str(path), expected=f"ids in -1..{rows - 1}", got=got, hint=hint)
    labels = stored.astype(np.int32)
    if stored.dtype.kind == "f" and not np.array_equal(labels, stored):
        raise InvalidFeatures(str(path), expected="whole numbers as mask ids", got="fractions")
    return labels if labels.ndim == 3 else labels[None]
