"""Folders of arrays of NumPy or torch, one file a view: dense maps, LangSplat's regions, and masks.

``camA/000.npy`` belongs to the view ``camA/000`` of a rig, and ``IMG.jpg.npy`` to the view ``IMG``, like the camera
of ``IMG.jpg``. Hidden files and folders are skipped, as are files that operating systems add.

LangSplat's ``IMG_s.npy`` [L, H, W] contains mask ids, -1 for none, numbered through all levels, so an id is a row of
``IMG_f.npy`` [M, F]. Occam's LGS, OpenGaussian, LaGa and VALA write the same files.

What opens a folder, here and beside, raises ``ValueError`` about its files (`liftcore.errors.reading`).
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from liftcore.errors import InvalidFeatures, reading
from liftcore.io.files import visible_files
from liftcore.io.npy import ARRAYS, TENSORS, open_array, read_floats
from liftcore.scene.views import composed, without_image_suffix
from liftcore.values.fit import Fit
from liftcore.values.views import FeatureGrid, Regions, ViewFeatures

PICKLED = (".pt", ".pth", ".pkl")
# The suffix of feature-3dgs after the name of an image, for its layout [F, h, w].
CHANNELS_FIRST = "_fmap_CxHxW"
LABELS, CODEBOOK = "_s.npy", "_f.npy"  # of LangSplat

Layout = Literal["hwc", "chw"]
V_co = TypeVar("V_co", bound=ViewFeatures, covariant=True)
FLATTEST = 16  # largest ratio of the sides of a grid: a larger one is a list of cells or of channels, not a photo


class ViewFolder(Mapping[str, V_co]):
    """Views of a folder by name. Each is read and checked at every access.

    Args:
        files: view name -> the file that names the view.
        load: view name -> its grid or regions.
        inputs: further files that are read.
    """

    def __init__(self, files: Mapping[str, Path], load: Callable[[str], V_co], inputs: Iterable[Path] = ()) -> None:
        self.files = files
        self.inputs = [*files.values(), *inputs]
        self._load = load

    def __getitem__(self, view: str) -> V_co:
        with reading(self.files[view], InvalidFeatures, "features of a view"):
            return self._load(view)

    def __iter__(self) -> Iterator[str]:
        return iter(self.files)

    def __len__(self) -> int:
        return len(self.files)


def folders_of(views: Iterable[str]) -> list[str]:
    """Return the folders that are part of names like ``camA/000``, sorted."""
    return sorted({view.rpartition("/")[0] for view in views if "/" in view})


def array_views(folder: Path, layout: Layout = "hwc", fit: Fit | Literal[""] = "") -> ViewFolder[FeatureGrid]:
    """Open the grids of a folder of ``.npy``, ``.npz`` or ``.pt`` files [h, w, F], or [F, h, w] for layout ``chw``.

    ``fit`` is that of all maps to their photos (`FeatureGrid`).

    Leading axes of length 1 are removed. ``IMG_fmap_CxHxW.pt``, as feature-3dgs writes it, is [F, h, w].
    """
    suffixes = (*ARRAYS, *TENSORS)
    files = npy_files(folder, *suffixes)
    image_suffixes = [f"{CHANNELS_FIRST}{suffix}" for suffix in suffixes]
    return grids_of(files_by_view(files, folder, *image_suffixes, *suffixes), layout, fit)


def grids_of(
    files: Mapping[str, Path], layout: Layout = "hwc", fit: Fit | Literal[""] = ""
) -> ViewFolder[FeatureGrid]:
    """Open the grids of files of arrays by view."""

    def read(view: str) -> FeatureGrid:
        first = layout == "chw" or files[view].stem.endswith(CHANNELS_FIRST)
        grid = read_floats(files[view], "F, h, w" if first else "h, w, F")
        if first and len(grid) == 1:  # ambiguous: a batch of one flat list [1, F, N], or one channel
            hint = "of a flat list of cells save array.reshape(F, h, w); of one channel array.reshape(h, w, 1) as hwc"
            raise ValueError(f"[F, h, w], got {list(grid.shape)}; {hint}")
        grid = grid.transpose(1, 2, 0) if first else grid
        height, width, channels = grid.shape
        if max(height, width) > FLATTEST * min(height, width):
            got = f"{height} x {width} cells in {list(grid.shape)}"
            hint = (
                f"give a flat list of cells its rows and columns, array.reshape(h, w, {channels}), without the class "
                "token; where channels come first, array.reshape(F, h, w).transpose(1, 2, 0)"
            )
            raise ValueError(f"a map [h, w, F] of a photo, got {got}; {hint}")
        return FeatureGrid(grid, fit=fit, context=f"view {view!r}")

    return ViewFolder(files, read)


def langsplat_views(folder: Path) -> ViewFolder[Regions]:
    """Open the regions of a folder of ``IMG_s.npy`` and ``IMG_f.npy`` files, and of its sub-folders."""
    files = npy_files(folder, LABELS)
    labels = {composed(path.relative_to(folder).as_posix().removesuffix(LABELS)): path for path in files}
    codebooks = {view: path.with_name(path.name.removesuffix(LABELS) + CODEBOOK) for view, path in labels.items()}
    for view, path in codebooks.items():
        if not path.is_file():
            raise ValueError(f"embeddings in {path.name}, got {labels[view].name} alone")

    def read(view: str) -> Regions:
        codebook = read_floats(codebooks[view], "M, F")
        ids = whole_numbers(open_array(labels[view]))
        return Regions(ids, codebook, context=f"view {view!r}")

    return ViewFolder(labels, read, codebooks.values())


def whole_numbers(stored: np.ndarray) -> np.ndarray:
    """Return mask ids as integers, which `Regions` checks; LangSplat and others store them as floats."""
    if stored.dtype.kind != "f":
        return stored
    with np.errstate(invalid="ignore"):
        labels = stored.astype(np.int32)
    if not np.array_equal(labels, stored):
        raise ValueError("whole numbers as mask ids, got fractions or numbers beyond 2^31")
    return labels


def files_below(folder: Path) -> list[Path]:
    """List the files of a folder and its sub-folders, sorted, without those of `is_system_file`."""
    if not folder.is_dir():
        raise ValueError("a folder of features or masks, got no such folder")
    return visible_files(folder, "**/*")


def npy_files(folder: Path, *suffixes: str) -> list[Path]:
    """List the files in a folder and its sub-folders with one of these suffixes, sorted."""
    files = files_below(folder)
    matches = [path for path in files if path.name.endswith(suffixes)]
    pickles = [path.name for path in files if path.suffix.lower() in PICKLED]
    if not matches:
        got, hint = f"{len(files)} other files", ""
        if pickles:
            got = f"{len(pickles)} pickles ({pickles[0]}), which can run code when they are opened"
            hint = "save them as .npy with the program that wrote them: numpy.save(name, tensor.cpu().numpy())"
        raise ValueError(f"*{suffixes[0]} files, got {got}; {hint}")
    return matches


def files_by_view(
    paths: Iterable[Path], folder: Path, *suffixes: str, noun: str = "file", hint: str = ""
) -> dict[str, Path]:
    """Return view name -> file. A view name is the file's without the first matching suffix and an image suffix."""
    by_view: dict[str, Path] = {}
    for path in paths:
        inner = path.relative_to(folder).as_posix()
        suffix = next((suffix for suffix in suffixes if inner.endswith(suffix)), path.suffix)
        view = without_image_suffix(inner.removesuffix(suffix))
        if view in by_view:
            got = f"{by_view[view].name} and {path.name}, both of the view {view!r}"
            raise ValueError(f"one {noun} a view, got {got}; {hint}")
        by_view[view] = path
    return by_view
