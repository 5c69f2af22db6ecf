"""Dense feature maps in ``.npy`` files, one a view: DINO, CLIP or any other encoder's grids."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.features.folder import ViewFolder, npy_files
from liftcore.features.views import FeatureGrid
from liftcore.io.npy import open_npy
from liftcore.scene.views import without_image_suffix

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

Layout = Literal["hwc", "chw"]


class ArrayViews(ViewFolder):
    """The maps of a folder; each is checked when it is read."""

    def __init__(self, files: Mapping[str, Path], layout: Layout) -> None:
        super().__init__(files)
        self.layout = layout

    def read(self, view: str) -> FeatureGrid:
        """The grid of one view.

        Raises:
            InvalidFeatures: the file is malformed or has another shape.
        """
        path = self.files[view]
        stored = open_npy(path)
        if stored.ndim != 3 or stored.dtype.kind != "f" or stored.dtype.itemsize > 8:
            axes = ", ".join("Fhw" if self.layout == "chw" else "hwF")
            got = f"{stored.dtype} {list(stored.shape)}"
            raise InvalidFeatures(str(path), expected=f"floats [{axes}]", got=got)
        grid = stored.transpose(1, 2, 0) if self.layout == "chw" else stored
        dtype = np.float16 if stored.dtype.itemsize == 2 else np.float32
        with np.errstate(over="ignore"):  # becomes infinite, and is refused as such where packs are written
            return FeatureGrid(grid.astype(dtype, order="C"), where=f"view {view!r}")


def array_views(folder: Path, layout: Layout = "hwc") -> ArrayViews:
    """The views of a folder of ``IMG.npy`` files [h, w, F], or [F, h, w] with the layout ``chw``, or its sub-folders.

    ``IMG.jpg.npy`` is of the view ``IMG``, as the camera of ``IMG.jpg`` is.

    Raises:
        InvalidFeatures: the folder has no such files, or two of one view.
    """
    files: dict[str, Path] = {}
    for name, path in npy_files(folder, ".npy").items():
        view = without_image_suffix(name)
        if view in files:
            got = f"{files[view].name} and {path.name}, both of the view {view!r}"
            raise InvalidFeatures(str(folder), expected="one file a view", got=got)
        files[view] = path
    return ArrayViews(files, layout)
