"""A COLMAP model in a zip, as people make them, read under limits."""

from __future__ import annotations

import tempfile
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from liftcore.errors import InvalidCameras
from liftcore.scene.camera_models import UNDISTORT
from liftcore.scene.colmap import MODEL_FILES, read_colmap
from liftcore.scene.model_folders import model_names, whole_models

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from liftcore.scene.cameras import Cameras

MAX_UNZIPPED_BYTES = 512 * 1024 * 1024
MAX_ZIP_MEMBERS = 100_000


def read_model_zip(path: Path) -> Cameras:
    """The cameras of the model in a zip; of several the preferred one (`model_folders`).

    Raises:
        InvalidCameras: there is none, or it is malformed or too large.
    """
    with tempfile.TemporaryDirectory(prefix="splatlift-") as folder:
        try:
            with zipfile.ZipFile(path) as archive:
                budget = MAX_UNZIPPED_BYTES
                for name, member in _model_members(archive, path).items():
                    budget -= _unzip(archive, member, Path(folder) / name, budget)
        except (
            zipfile.BadZipFile,
            EOFError,
            NotImplementedError,
            RuntimeError,
            ValueError,
            zlib.error,
        ) as error:
            got = f"one that does not open ({str(error)[:120]})"
            raise InvalidCameras(str(path), expected="a zip of a COLMAP sparse model", got=got) from None
        try:
            return read_colmap(Path(folder))
        except InvalidCameras as error:
            argument = error.argument.replace(folder, str(path))
            got, hint = error.got.replace(folder, str(path)), error.hint
            others = models_in_zip(path)[1:] if hint == UNDISTORT else []
            if others:
                hint = f"zip what is undistorted already by itself, if it is, such as {others[0]}; else {UNDISTORT}"
            raise InvalidCameras(argument, expected=error.expected, got=got, hint=hint) from None


def models_in_zip(path: Path) -> list[str]:
    """The folders of all whole models in a zip, the one that is read first."""
    with zipfile.ZipFile(path) as archive:
        return [str(root) for root, _ in whole_models(_files(archive))]


def _files(archive: zipfile.ZipFile) -> Mapping[str, zipfile.ZipInfo]:
    """The files by their names, with slashes: Windows' own programs write backslashes, others ``./`` before all."""
    members = [member for member in archive.infolist() if not member.is_dir()]
    return {str(PurePosixPath(member.filename.replace("\\", "/"))): member for member in members}


def _model_members(archive: zipfile.ZipFile, path: Path) -> Mapping[str, zipfile.ZipInfo]:
    """Cameras and images of the preferred model, by the last part of their names, which is one of four."""
    count = len(archive.infolist())
    if count > MAX_ZIP_MEMBERS:
        raise InvalidCameras(str(path), expected=f"at most {MAX_ZIP_MEMBERS} files", got=str(count))
    files = _files(archive)
    for root, kind in whole_models(files):
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
