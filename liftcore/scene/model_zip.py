"""A COLMAP model in a zip, as people make them, read under limits."""

from __future__ import annotations

import tempfile
import zipfile
import zlib
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from liftcore.errors import InvalidCameras
from liftcore.scene.colmap import MODEL_FILES, read_colmap
from liftcore.scene.distorted import is_undistorted, refuse_both
from liftcore.scene.model_folders import model_names, whole_models

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from liftcore.scene.cameras import Cameras

MAX_UNZIPPED_BYTES = 512 * 1024 * 1024
MAX_ZIP_MEMBERS = 100_000
MOST_MODELS = 8  # of a zip that are looked at


def read_model_zip(path: Path) -> Cameras:
    """The cameras of the model in a zip; of several the preferred one (`model_folders`).

    Raises:
        InvalidCameras: there is none, or it is malformed or too large.
    """
    with tempfile.TemporaryDirectory(prefix="splatlift-") as folder:
        first = Path(folder)
        _unzip_model(path, 0, first)
        try:
            cameras = read_colmap(first)
        except InvalidCameras as error:
            argument, got = (text.replace(folder, str(path)) for text in (error.argument, error.got))
            raise InvalidCameras(argument, expected=error.expected, got=got, hint=error.hint) from None
    if cameras.distorted:
        read, *others = models_in_zip(path)[:MOST_MODELS]
        undistorted = [name for place, name in enumerate(others, start=1) if _is_undistorted(path, place)]
        refuse_both(str(path), read, undistorted, "zip the one alone")
    return cameras


def models_in_zip(path: Path) -> list[str]:
    """The folders of all whole models in a zip, the one that is read first."""
    with zipfile.ZipFile(path) as archive:
        return [str(root) for root, _ in whole_models(_files(archive))]


def _files(archive: zipfile.ZipFile) -> Mapping[str, zipfile.ZipInfo]:
    """The files by their names, with slashes: Windows' own programs write backslashes, others ``./`` before all."""
    members = [member for member in archive.infolist() if not member.is_dir()]
    return {str(PurePosixPath(member.filename.replace("\\", "/"))): member for member in members}


def _is_undistorted(path: Path, place: int) -> bool:
    """Whether the zip's model of this place among all reads, and is of pinholes alone."""
    with tempfile.TemporaryDirectory(prefix="splatlift-") as folder:
        try:
            _unzip_model(path, place, Path(folder))
        except InvalidCameras:
            return False
        return is_undistorted(Path(folder))


def _unzip_model(path: Path, place: int, folder: Path) -> None:
    """Unzip the cameras and images of the model of this place among all, by the last part of their names."""
    try:
        with zipfile.ZipFile(path) as archive:
            budget = MAX_UNZIPPED_BYTES
            for name, member in _model_members(archive, path, place).items():
                budget -= _unzip(archive, member, folder / name, budget)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError, zlib.error) as error:
        got = f"one that does not open ({str(error)[:120]})"
        raise InvalidCameras(str(path), expected="a zip of a COLMAP sparse model", got=got) from None


def _model_members(archive: zipfile.ZipFile, path: Path, place: int) -> Mapping[str, zipfile.ZipInfo]:
    count = len(archive.infolist())
    if count > MAX_ZIP_MEMBERS:
        raise InvalidCameras(str(path), expected=f"at most {MAX_ZIP_MEMBERS} files", got=str(count))
    files = _files(archive)
    for root, kind in islice(whole_models(files), place, None):
        return {PurePosixPath(name).name: files[name] for name in model_names(root, kind)}
    got, hint = _what_else(files)
    expected = "a COLMAP model (cameras and images, .bin or .txt) in the zip"
    raise InvalidCameras(str(path), expected=expected, got=got, hint=hint)


def _what_else(names: Iterable[str]) -> tuple[str, str]:
    """What a zip without a whole model has, and what to do."""
    for name in sorted(names):
        file = PurePosixPath(name).name
        if file in MODEL_FILES:
            parts = ("cameras", "images") if file.startswith("cameras") else ("images", "cameras")
            return f"{name!r} without {file.replace(*parts)!r}", "zip both files together"
        if file == "cameras.json" or (file.startswith("transforms") and file.endswith(".json")):
            return f"{name!r}", "give the JSON file itself, without a zip"
    return "none", "zip the folder that has cameras.bin and images.bin"


def _unzip(archive: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path, budget: int) -> int:
    written = 0
    with archive.open(member) as source, target.open("wb") as sink:
        while block := source.read(min(1 << 20, budget - written + 1)):
            written += len(block)
            if written > budget:
                limit = f"at most {MAX_UNZIPPED_BYTES} bytes unzipped"
                raise InvalidCameras(member.filename, expected=limit, got="more", hint="leave points out of the zip")
            sink.write(block)
    return written
