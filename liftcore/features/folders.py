"""Folders of arrays, of NumPy or torch, a view a file: dense maps, LangSplat's regions, and what masks are read from.

``camA/000.npy`` is of the view ``camA/000``, as rigs have them, and ``IMG.jpg.npy`` of the view ``IMG``, as the
camera of ``IMG.jpg`` is. Hidden files and folders are left out, and what systems put beside files.

LangSplat's ``IMG_s.npy`` [L, H, W] holds mask ids, -1 for none, counted on over the levels, so that an id is a row of
``IMG_f.npy`` [M, F]. Occam's LGS, OpenGaussian, LaGa and VALA write the same files.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.io.files import visible_files
from liftcore.io.npy import ARRAYS, TENSORS, open_npy, read_floats, without_unit_axes
from liftcore.scene.views import composed, without_image_suffix
from liftcore.values.views import NO_LABEL, FeatureGrid, Regions, ViewFeatures

PICKLED = (".pt", ".pth", ".pkl")
# What feature-3dgs writes after the name of an image, and the layout that it speaks of.
CHANNELS_FIRST = "_fmap_CxHxW"
LABELS, CODEBOOK = "_s.npy", "_f.npy"  # of LangSplat

Layout = Literal["hwc", "chw"]
V_co = TypeVar("V_co", bound=ViewFeatures, covariant=True)
FLATTEST = 16  # times longer than wide, or wider: no photo is, but a list of cells or of channels


class ViewFolder(Mapping[str, V_co]):
    """Views of a folder by name; each is read and checked anew when it is asked for.

    Args:
        files: view name -> the file that names the view.
        read: view name -> what it observes.
        inputs: all files that are read.
    """

    def __init__(self, files: Mapping[str, Path], read: Callable[[str], V_co], inputs: Iterable[Path] = ()) -> None:
        self.files = files
        self.inputs = [*files.values(), *inputs]
        self._read = read

    def __getitem__(self, view: str) -> V_co:
        return self._read(view)

    def __iter__(self) -> Iterator[str]:
        return iter(self.files)

    def __len__(self) -> int:
        return len(self.files)


def folders_of(views: Iterable[str]) -> list[str]:
    """The folders that are part of names like ``camA/000``, sorted."""
    return sorted({view.rpartition("/")[0] for view in views if "/" in view})


def array_views(folder: Path, layout: Layout = "hwc") -> ViewFolder[FeatureGrid]:
    """The grids of a folder of ``.npy``, ``.npz`` or ``.pt`` files [h, w, F], or [F, h, w] with the layout ``chw``.

    Axes of length 1 before these are taken off. ``IMG_fmap_CxHxW.pt``, as feature-3dgs writes it, is [F, h, w].

    Raises:
        InvalidFeatures: the folder has no such files, or two of one view.
    """
    suffixes = (*ARRAYS, *TENSORS)
    files = npy_files(folder, *suffixes)
    named = [f"{CHANNELS_FIRST}{suffix}" for suffix in suffixes]
    return grids_of(files_by_view(files, folder, *named, *suffixes), layout)


def grids_of(files: Mapping[str, Path], layout: Layout = "hwc") -> ViewFolder[FeatureGrid]:
    """The grids of files of arrays by view."""

    def read(view: str) -> FeatureGrid:
        first = layout == "chw" or files[view].stem.endswith(CHANNELS_FIRST)
        grid = read_floats(files[view], "F, h, w" if first else "h, w, F")
        if first and len(grid) == 1:  # a batch of one flat list [1, F, N], or one channel: nothing tells which
            hint = "of a flat list of cells save array.reshape(F, h, w); of one channel array.reshape(h, w, 1) as hwc"
            raise InvalidFeatures(str(files[view]), expected="[F, h, w]", got=f"{list(grid.shape)}", hint=hint)
        grid = grid.transpose(1, 2, 0) if first else grid
        height, width, channels = grid.shape
        if max(height, width) > FLATTEST * min(height, width):
            got = f"{height} x {width} cells in {list(grid.shape)}"
            hint = (
                f"give a flat list of cells its rows and columns, array.reshape(h, w, {channels}), without the class"
            )
            hint = f"{hint} token; where channels come first, array.reshape(F, h, w).transpose(1, 2, 0)"
            raise InvalidFeatures(f"view {view!r} grid", expected="a map [h, w, F] of a photo", got=got, hint=hint)
        return FeatureGrid(grid, where=f"view {view!r}")

    return ViewFolder(files, read)


def langsplat_views(folder: Path) -> ViewFolder[Regions]:
    """The regions of a folder of ``IMG_s.npy`` and ``IMG_f.npy`` files, and of its sub-folders.

    Raises:
        InvalidFeatures: the folder has no such files, or a map lacks its embeddings. Reading a view: a file is
            malformed, an id has no embedding, or an embedding is not finite.
    """
    files = npy_files(folder, LABELS)
    labels = {composed(path.relative_to(folder).as_posix().removesuffix(LABELS)): path for path in files}
    codebooks = {view: path.with_name(path.name.removesuffix(LABELS) + CODEBOOK) for view, path in labels.items()}
    for view, path in codebooks.items():
        if not path.is_file():
            got = f"{labels[view].name} alone"
            raise InvalidFeatures(str(folder), expected=f"embeddings in {path.name}", got=got)

    def read(view: str) -> Regions:
        codebook = read_floats(codebooks[view], "M, F")
        ids = mask_ids(open_npy(labels[view]), len(codebook), labels[view])
        return Regions(ids, codebook, where=f"view {view!r}")

    return ViewFolder(labels, read, codebooks.values())


def mask_ids(stored: np.ndarray, rows: int, path: Path) -> np.ndarray:
    """[L, H, W] i32 of ids, -1 for none, stored as integers or as floats.

    Args:
        stored: [L, H, W], or [H, W] for one level; axes of length 1 before these are taken off.
        rows: vectors that there are. path: named in errors.

    Raises:
        InvalidFeatures: other axes, an id without a vector, or one that is no whole number.
    """
    shape, stored = list(stored.shape), without_unit_axes(stored, 3)
    if stored.ndim == 3 and stored.shape[-1] == 1 < len(stored):  # [H, W, 1]: no photo is a pixel wide
        stored = stored[..., 0]
    if stored.ndim not in (2, 3):
        raise InvalidFeatures(str(path), expected="mask ids [L, H, W]", got=str(shape))
    low, high = float(stored.min()), float(stored.max())
    # NaN fails every comparison, so it is refused here too.
    if not (low >= NO_LABEL and high < rows):
        got = f"ids from {low:g} to {high:g}"
        hint = "ids are counted on over the levels; those of each level alone must be shifted first"
        if low == 0 and high == rows:
            hint = "id k is of row k of the vectors, and -1 is none: where 0 means none, save ids - 1"
        elif float(stored.max()) == 255 and len(np.unique(stored)) == 2:
            hint = "masks, a plane each, are booleans: numpy.save(name, masks > 0)"
        raise InvalidFeatures(str(path), expected=f"ids in -1..{rows - 1}", got=got, hint=hint)
    labels = stored.astype(np.int32)
    if stored.dtype.kind == "f" and not np.array_equal(labels, stored):
        raise InvalidFeatures(str(path), expected="whole numbers as mask ids", got="fractions")
    return labels if labels.ndim == 3 else labels[None]


def files_below(folder: Path) -> list[Path]:
    """The files of a folder and its sub-folders, sorted, without those of `is_system_file`."""
    return visible_files(folder, "**/*")


def npy_files(folder: Path, *suffixes: str) -> list[Path]:
    """The files in the folder and its sub-folders whose names end in one of these ways, sorted.

    Raises:
        InvalidFeatures: there is none; pickles are named as the reason where there are some.
    """
    suffix = suffixes[0]
    if not folder.is_dir():
        raise InvalidFeatures(str(folder), expected=f"a folder of *{suffix} files", got="no such folder")
    files = files_below(folder)
    found = [path for path in files if path.name.endswith(suffixes)]
    pickles = [path.name for path in files if path.suffix.lower() in PICKLED]
    if not found and pickles:
        raise InvalidFeatures(
            str(folder),
            expected=f"*{suffix} files",
            got=f"{len(pickles)} pickles ({pickles[0]}), which may run code when they are opened",
            hint="save them as .npy with the program that wrote them: numpy.save(name, tensor.cpu().numpy())",
        )
    if not found:
        raise InvalidFeatures(str(folder), expected=f"*{suffix} files", got=f"{len(files)} other files")
    return found


def files_by_view(
    paths: Iterable[Path], folder: Path, *suffixes: str, what: str = "file", hint: str = ""
) -> dict[str, Path]:
    """View name -> file, the first of the suffixes that a file has cut off its name, and that of an image before it.

    Raises:
        InvalidFeatures: two files are of one view; ``what`` names them.
    """
    found: dict[str, Path] = {}
    for path in paths:
        inner = path.relative_to(folder).as_posix()
        suffix = next((suffix for suffix in suffixes if inner.endswith(suffix)), path.suffix)
        view = without_image_suffix(inner.removesuffix(suffix))
        if view in found:
            got = f"{found[view].name} and {path.name}, both of the view {view!r}"
            raise InvalidFeatures(str(folder), expected=f"one {what} a view", got=got, hint=hint)
        found[view] = path
    return found
