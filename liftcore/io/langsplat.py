"""LangSplat's language features: masks at several levels and one embedding a mask.

``IMG_s.npy`` [L, H, W] holds mask ids, -1 for none, counted on over the levels, so that an id is a row of
``IMG_f.npy`` [M, F]. Occam's LGS, OpenGaussian, LaGa and VALA write the same files.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.errors import InvalidFeatures
from liftcore.features.folder import ViewFolder, npy_files
from liftcore.features.mask_ids import mask_ids
from liftcore.features.mask_vectors import mask_vectors
from liftcore.features.views import Regions
from liftcore.io.npy import open_npy

if TYPE_CHECKING:
    from pathlib import Path


class LangSplatViews(ViewFolder):
    """The views of a LangSplat folder; ids and embeddings are checked when a view is read."""

    @property
    def inputs(self) -> list[Path]:
        """All files that are read."""
        return [*super().inputs, *map(_codebook_file, super().inputs)]

    def read(self, view: str) -> Regions:
        """The region map of one view.

        Raises:
            InvalidFeatures: a file is malformed, an id has no embedding, or an embedding is not finite.
        """
        labels_file = self.files[view]
        codebook = mask_vectors(_codebook_file(labels_file))
        labels = mask_ids(open_npy(labels_file), len(codebook), labels_file)
        return Regions(labels, codebook, where=f"view {view!r}")


def langsplat_views(folder: Path) -> LangSplatViews:
    """The views of a folder of ``IMG_s.npy`` and ``IMG_f.npy`` files, and of its sub-folders.

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
