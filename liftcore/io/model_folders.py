"""Where COLMAP models lie in a folder or in a zip, and which of several is read."""

from __future__ import annotations

import os
from itertools import islice
from pathlib import Path, PurePath, PurePosixPath
from typing import TYPE_CHECKING, TypeVar

from liftcore.io.colmap import MODEL_FILES, has_model, is_whole

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

# As trainers, COLMAP's reconstructor and its undistorter lay them out; the first that is there is read.
MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0", "0", "dense/0/sparse", "dense/sparse")
PLACE_PARTS = tuple(PurePosixPath(place).parts for place in MODEL_FOLDERS)
DEPTH = 4  # folders down that models are looked for, if only to be named
MAX_FOLDERS = 10_000  # that are looked into for it
P = TypeVar("P", bound=PurePath)


def model_folder(folder: Path) -> Path | None:
    """The folder whose model is read: a usual one, whole models first; None when there is none."""
    found = [folder / name for name in MODEL_FOLDERS if has_model(folder / name)]
    return next(iter([model for model in found if is_whole(model)] + found), None)


def models_below(folder: Path) -> list[PurePosixPath]:
    """Folders with whole models below one, relative to it, in the order of ``preference``.

    Hidden folders, links and what lies deep down are left out, so that a folder of many scenes costs little.
    """
    names: list[str] = []
    for parent, inner, files in islice(os.walk(folder), MAX_FOLDERS):
        here = Path(parent).relative_to(folder)
        names += [(here / name).as_posix() for name in files if name in MODEL_FILES]
        inner[:] = [name for name in sorted(inner) if not name.startswith(".") and len(here.parts) < DEPTH]
    return [root for root, _ in whole_models(names)]


def preference(model: PurePosixPath) -> tuple[bool, int, str, int]:
    """What models are sorted by: as if folders were opened as scenes one by one, the outermost first.

    So the first model of a zip is the one that is read from the same files in a folder. What lies in a folder
    ``distorted`` comes last: 3DGS's ``convert.py`` keeps there what it has undistorted.
    """
    scene = scene_of(model)
    place = MODEL_FOLDERS.index(str(model.relative_to(scene)))
    return "distorted" in model.parts, len(scene.parts), str(scene), place


def scene_of(model: P) -> P:
    """The outermost folder in which a model has one of the usual places; its own folder at least."""
    cut = max(len(place) for place in PLACE_PARTS if model.parts[len(model.parts) - len(place) :] == place)
    return type(model)(*model.parts[: len(model.parts) - cut])


def whole_models(names: Iterable[str]) -> Iterator[tuple[PurePosixPath, str]]:
    """The folders with both files of a model among such names of a zip, and of which kind, the preferred first."""
    known = set(names)
    found: dict[PurePosixPath, str] = {}
    for kind in ("txt", "bin"):  # of two kinds in a folder the binary one
        for name in known:
            path = PurePosixPath(name)
            if path.name == f"cameras.{kind}" and known.issuperset(model_names(path.parent, kind)):
                found[path.parent] = kind
    yield from sorted(found.items(), key=lambda item: preference(item[0]))


def model_names(root: PurePosixPath, kind: str) -> list[str]:
    """The names of a model's files in a zip."""
    return [str(root / f"{part}.{kind}") for part in ("cameras", "images")]
