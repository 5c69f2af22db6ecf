"""NumPy files from strangers: mapped, never unpickled, believed as far as their size goes; and folders of them.

In a folder a file is of one view. ``camA/000.npy`` is of the view ``camA/000``, as rigs have them, and
``IMG.jpg.npy`` of the view ``IMG``, as the camera of ``IMG.jpg`` is. Hidden sub-folders are left out.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from tokenize import TokenError
from typing import Literal, TypeVar

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.features.views import FeatureGrid, ViewFeatures
from liftcore.scene.views import without_image_suffix

# Version 3 is for named columns only, which no array of numbers has.
READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
# What NumPy raises over a header that is no Python literal, besides its own ValueError.
PARSE_ERRORS = (ValueError, TypeError, SyntaxError, EOFError, RecursionError, MemoryError, TokenError)
NUMBERS = "fiu"  # kinds of NumPy: floats, integers, unsigned integers
HINT = "save plain arrays with numpy.save"
PICKLED = (".pt", ".pth", ".pkl")

Layout = Literal["hwc", "chw"]
V_co = TypeVar("V_co", bound=ViewFeatures, covariant=True)


def open_npy(path: Path, kinds: str = NUMBERS) -> np.ndarray:
    """Map a ``.npy`` file of numbers, or of what else ``kinds`` allows, in NumPy's letters.

    Raises:
        InvalidFeatures: the file is no ``.npy`` file, holds Python objects, or has another size than it says.
    """
    try:
        with path.open("rb") as handle:
            version = np.lib.format.read_magic(handle)
            if version not in READERS:
                raise ValueError(f"format version {version}")
            shape, _, dtype = READERS[version](handle)
            offset, size = handle.tell(), handle.seek(0, 2)
        if dtype.hasobject or dtype.kind not in kinds:
            got = "Python objects, which may run code" if dtype.hasobject else str(dtype)
            raise InvalidFeatures(str(path), expected="an array of numbers", got=got, hint=HINT)
        if any(side < 1 for side in shape) or offset + math.prod(shape) * dtype.itemsize != size:
            expected = f"{dtype} {list(shape)} as its header says"
            raise InvalidFeatures(str(path), expected=expected, got=f"a file of {size} bytes", hint=HINT)
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        got = f"one that does not open ({error.strerror})"
        raise InvalidFeatures(str(path), expected="a .npy file", got=got) from None
    except PARSE_ERRORS as error:
        got = f"one that does not parse ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected="a .npy file", got=got, hint=HINT) from None


def read_floats(path: Path, axes: str) -> np.ndarray:
    """An array of floats of such axes, "M, F": f16, or f32 where it is stored wider; perhaps not finite.

    Raises:
        InvalidFeatures: as `open_npy`, or it has other axes or no floats.
    """
    stored = open_npy(path)
    if stored.ndim != len(axes.split()) or stored.dtype.kind != "f" or stored.dtype.itemsize > 8:
        got = f"{stored.dtype} {list(stored.shape)}"
        raise InvalidFeatures(str(path), expected=f"floats [{axes}]", got=got)
    with np.errstate(over="ignore"):  # becomes infinite, and is refused as such where values are made
        return stored.astype(np.float16 if stored.dtype.itemsize == 2 else np.float32)


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


def array_views(folder: Path, layout: Layout = "hwc") -> ViewFolder[FeatureGrid]:
    """The grids of a folder of ``.npy`` files [h, w, F], or [F, h, w] with the layout ``chw``.

    Raises:
        InvalidFeatures: the folder has no such files, or two of one view.
    """
    return grids_of(files_by_view(npy_files(folder, ".npy"), folder, ".npy"), layout)


def grids_of(files: Mapping[str, Path], layout: Layout = "hwc") -> ViewFolder[FeatureGrid]:
    """The grids of ``.npy`` files by view."""

    def read(view: str) -> FeatureGrid:
        grid = read_floats(files[view], "F, h, w" if layout == "chw" else "h, w, F")
        return FeatureGrid(grid.transpose(1, 2, 0) if layout == "chw" else grid, where=f"view {view!r}")

    return ViewFolder(files, read)


def files_below(folder: Path) -> list[Path]:
    """The files of a folder and its sub-folders, sorted; hidden sub-folders are left out."""
    inner = {path: path.relative_to(folder).parts[:-1] for path in sorted(folder.rglob("*")) if path.is_file()}
    return [path for path, parts in inner.items() if not any(part.startswith(".") for part in parts)]


def npy_files(folder: Path, suffix: str) -> list[Path]:
    """The files in the folder and its sub-folders whose names end so, sorted.

    Raises:
        InvalidFeatures: there is none; pickles are named as the reason where there are some.
    """
    if not folder.is_dir():
        raise InvalidFeatures(str(folder), expected=f"a folder of *{suffix} files", got="no such folder")
    files = files_below(folder)
    found = [path for path in files if path.name.endswith(suffix)]
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
