"""Cameras in a zip, as people make them, read under limits."""

from __future__ import annotations

import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from liftcore.errors import InvalidCameras
from liftcore.scene.camera_source import TRANSFORMS, camera_source
from liftcore.scene.colmap import MODEL_FILES
from liftcore.scene.distorted import is_undistorted, refuse_both
from liftcore.scene.frame import FRAME_FILE
from liftcore.scene.model_folders import model_names, whole_models

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from liftcore.scene.cameras import Cameras

MAX_UNZIPPED_BYTES = 512 * 1024 * 1024
MAX_ZIP_MEMBERS = 100_000
MOST_MODELS = 8  # of a zip that are looked at
Files = Mapping[str, zipfile.ZipInfo]  # by their names in the zip


def read_camera_zip(path: Path) -> Cameras:
    """The cameras of the model in a zip, of several the preferred one (`model_folders`), in their splats' frame.

    With a ``FRAME_FILE``, wherever it lies, those of a transforms.json before those of a model, as in a folder.

    Raises:
        InvalidCameras: there is none, or it is malformed or too large.
    """
    with tempfile.TemporaryDirectory(prefix="splatlift-") as folder:
        first = Path(folder)
        _unzip(path, lambda files: _camera_members(files, path), first)
        source = camera_source(first)
        try:
            cameras = source.read()
        except InvalidCameras as error:
            argument, got, hint = (
                text.replace(folder, str(path)) for text in (error.argument, error.got, error.hint)
            )
            raise InvalidCameras(argument, expected=error.expected, got=got, hint=hint) from None
    if source.model is not None and cameras.distorted:
        read, *others = models_in_zip(path)[:MOST_MODELS]
        undistorted = [name for place, name in enumerate(others, start=1) if _is_undistorted(path, place)]
        refuse_both(str(path), read, undistorted, "zip the one alone")
    return cameras


def models_in_zip(path: Path) -> list[str]:
    """The folders of all whole models in a zip, the one that is read first."""
    with zipfile.ZipFile(path) as archive:
        return [str(root) for root, _ in whole_models(_files(archive))]


def _files(archive: zipfile.ZipFile) -> Files:
    """The files by their names, with slashes: Windows' own programs write backslashes, others ``./`` before all."""
    members = [member for member in archive.infolist() if not member.is_dir()]
    return {str(PurePosixPath(member.filename.replace("\\", "/"))): member for member in members}


def _is_undistorted(path: Path, place: int) -> bool:
    """Whether the zip's model of this place among all reads, and is of pinholes alone."""
    with tempfile.TemporaryDirectory(prefix="splatlift-") as folder:
        try:
            _unzip(path, lambda files: _model_members(files, path, place), Path(folder))
        except InvalidCameras:
            return False
        return is_undistorted(Path(folder))


def _unzip(path: Path, pick: Callable[[Files], Files], folder: Path) -> None:
    """Unzip what is picked of all files, by the last part of their names."""
    try:
        with zipfile.ZipFile(path) as archive:
            count, budget = len(archive.infolist()), MAX_UNZIPPED_BYTES
            if count > MAX_ZIP_MEMBERS:
                raise InvalidCameras(str(path), expected=f"at most {MAX_ZIP_MEMBERS} files", got=str(count))
            for name, member in pick(_files(archive)).items():
                budget -= _unzip_one(archive, member, folder / PurePosixPath(name).name, budget)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError, zlib.error) as error:
        got = f"one that does not open ({str(error)[:120]})"
        raise InvalidCameras(str(path), expected="a zip of a COLMAP sparse model", got=got) from None


def _camera_members(files: Files, path: Path) -> Files:
    """What the cameras are read from, with the frame of the splats if the zip tells it."""
    frame = _only(files, FRAME_FILE, path)
    document = _only(files, TRANSFORMS, path) if frame else {}
    return {**(document or _model_members(files, path, 0)), **frame}


def _only(files: Files, name: str, path: Path) -> Files:
    """The file of this name, if there is one.

    Raises:
        InvalidCameras: there are several.
    """
    found = {place: member for place, member in files.items() if PurePosixPath(place).name == name}
    if len(found) > 1:
        got = " and ".join(sorted(found, key=lambda place: (place.count("/"), place))[:2])
        raise InvalidCameras(str(path), expected=f"one {name}", got=got, hint="zip those of one run alone")
    return found


def _model_members(files: Files, path: Path, place: int) -> Files:
    """The cameras and images of the model of this place among all."""
    for root, kind in islice(whole_models(files), place, None):
        return {name: files[name] for name in model_names(root, kind)}
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
            return f"{name!r}", f"give the JSON file itself, or zip it with its run's {FRAME_FILE}"
    return "none", "zip the folder that has cameras.bin and images.bin"


def _unzip_one(archive: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path, budget: int) -> int:
    written = 0
    with archive.open(member) as source, target.open("wb") as sink:
        while block := source.read(min(1 << 20, budget - written + 1)):
            written += len(block)
            if written > budget:
                limit = f"at most {MAX_UNZIPPED_BYTES} bytes unzipped"
                raise InvalidCameras(member.filename, expected=limit, got="more", hint="leave points out of the zip")
            sink.write(block)
    return written
