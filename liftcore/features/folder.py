"""Folders of one file a view, read when a view is asked for."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from liftcore.errors import InvalidFeatures
from liftcore.features.views import ViewFeatures

if TYPE_CHECKING:
    from pathlib import Path

PICKLED = (".pt", ".pth", ".pkl")


class ViewFolder(Mapping[str, ViewFeatures]):
    """Views of a folder by name; each is read anew when it is asked for."""

    def __init__(self, files: Mapping[str, Path]) -> None:
        self.files = files

    @property
    def inputs(self) -> list[Path]:
        """All files that are read."""
        return list(self.files.values())

    @abstractmethod
    def read(self, view: str) -> ViewFeatures:
        """Read and check one view."""

    def __getitem__(self, view: str) -> ViewFeatures:
        return self.read(view)

    def __iter__(self) -> Iterator[str]:
        return iter(self.files)

    def __len__(self) -> int:
        return len(self.files)


def files_below(folder: Path) -> list[Path]:
    """The files of a folder and its sub-folders, sorted; hidden sub-folders are left out."""
    inner = {path: path.relative_to(folder).parts[:-1] for path in sorted(folder.rglob("*")) if path.is_file()}
    return [path for path, parts in inner.items() if not any(part.startswith(".") for part in parts)]


def npy_files(folder: Path, suffix: str) -> dict[str, Path]:
    """View name -> file, of the files in the folder and its sub-folders whose names end so, sorted.

    A file of a sub-folder is of the view ``camA/000``, as rigs have them. Hidden sub-folders are left out.

    Raises:
        InvalidFeatures: there is none; pickles are named as the reason where there are some.
    """
    if not folder.is_dir():
        raise InvalidFeatures(str(folder), expected=f"a folder of *{suffix} files", got="no such folder")
    files = files_below(folder)
    named = {path.relative_to(folder).as_posix(): path for path in files if path.name.endswith(suffix)}
    found = {name.removesuffix(suffix): path for name, path in named.items()}
    if found:
        return found
    pickles = [path.name for path in files if path.suffix.lower() in PICKLED]
    if pickles:
        raise InvalidFeatures(
            str(folder),
            expected=f"*{suffix} files",
            got=f"{len(pickles)} pickles ({pickles[0]}), which may run code when they are opened",
            hint="save them as .npy with the program that wrote them: numpy.save(name, tensor.cpu().numpy())",
        )
    raise InvalidFeatures(str(folder), expected=f"*{suffix} files", got=f"{len(files)} other files")
