"""Cameras in a zip, as people make them, read under limits."""

from __future__ import annotations

import errno
import lzma
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from liftcore.errors import InvalidCameras, Unavailable
from liftcore.io.camera_source import TRANSFORMS, camera_source
from liftcore.io.colmap import MODEL_FILES
from liftcore.io.frame import FRAME_FILE
from liftcore.io.model_folders import model_names, scene_of, whole_models
from liftcore.scene.distorted import is_undistorted, refuse_both

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from liftcore.scene.cameras import Cameras

MAX_UNZIPPED_BYTES = 512 * 1024 * 1024
MAX_ZIP_MEMBERS = 100_000
ONE_RUN = "zip those of one run alone"
# What zipfile and its decompressors raise of a broken or foreign file, bar what they name themselves.
OTHERS = (EOFError, NotImplementedError, OSError, RuntimeError, ValueError)
BROKEN = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, *OTHERS)
MOST_MODELS = 8  # of a zip that are looked at
Files = Mapping[str, zipfile.ZipInfo]  # by their names in the zip


def read_camera_zip(path: Path, beside: Path | None = None, *, choosing: bool = True) -> Cameras:
    """The cameras of the model in a zip, of several the preferred one (`model_folders`), in their splats' frame.

    With a ``FRAME_FILE``, wherever it lies, those of a transforms.json before those of a model, as in a folder.

    Args:
        beside: the frame's file beside the zip, if the zip itself has none.
        choosing: whether a distorted model beside an undistorted one is refused.

    Raises:
        InvalidCameras: there is none, or it is malformed or too large.
        Unavailable: the temporary folder has no room to unzip it.
    """
    with tempfile.TemporaryDirectory(prefix="splatlift-") as folder:
        first = Path(folder)
        _unzip(path, lambda files: _camera_members(files, path, framed=beside is not None), first)
        source = camera_source(first)
        source = replace(source, frame=source.frame or beside)
        try:
            cameras = source.read()
        except InvalidCameras as error:
            argument, got, hint = (
                text.replace(folder, str(path)) for text in (error.argument, error.got, error.hint)
            )
            raise InvalidCameras(argument, expected=error.expected, got=got, hint=hint) from None
    if choosing and source.model is not None and cameras.distorted:
        read, *others = models_in_zip(path)[:MOST_MODELS]
        undistorted = [name for place, name in enumerate(others, start=1) if _is_undistorted(path, place)]
        refuse_both(str(path), read, undistorted, "zip the one alone")
    return cameras


def models_in_zip(path: Path) -> list[str]:
    """The folders of all whole models in a zip, the one that is read first."""
    with zipfile.ZipFile(path) as archive:
        return [str(root) for root, _ in whole_models(_files(archive))]


def has_transforms(path: Path) -> bool:
    """Whether a zip has a transforms.json, too."""
    with zipfile.ZipFile(path) as archive:
        return bool(_named(_files(archive), lambda name: name == TRANSFORMS))


def _files(archive: zipfile.ZipFile) -> Files:
    """The files by their names, with slashes: Windows' own programs write backslashes, others ``./`` before all.

    What is hidden, or below a hidden folder, is left out, as it is of folders.
    """
    members = {
        PurePosixPath(member.filename.replace("\\", "/")): member
        for member in archive.infolist()
        if not member.is_dir()
    }
    return {
        str(name): member
        for name, member in members.items()
        if not any(part.startswith(".") and part != ".." for part in name.parts)
    }


def _is_undistorted(path: Path, place: int) -> bool:
    """Whether the zip's model of this place among all reads, and is of pinholes alone."""
    with tempfile.TemporaryDirectory(prefix="splatlift-") as folder:
        try:
            _unzip(path, lambda files: _model_members(files, path, place), Path(folder))
        except InvalidCameras:
            return False
        return is_undistorted(Path(folder))


def _unzip(path: Path, pick: Callable[[Files], Files], folder: Path) -> None:
    """Unzip what is picked of all files, under the names that are picked."""
    try:
        with zipfile.ZipFile(path) as archive:
            count, budget = len(archive.infolist()), MAX_UNZIPPED_BYTES
            if count > MAX_ZIP_MEMBERS:
                raise InvalidCameras(str(path), expected=f"at most {MAX_ZIP_MEMBERS} files", got=str(count))
            for name, member in pick(_files(archive)).items():
                budget -= _unzip_one(archive, member, folder / name, budget)
    except BROKEN as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            expected = f"room in {tempfile.gettempdir()} for what is in the zip"
            raise Unavailable(
                str(path), expected=expected, got="a full disk", hint="make room, or set TMPDIR"
            ) from None
        got = f"one that does not open ({str(error)[:120]})"
        raise InvalidCameras(str(path), expected="a zip of a COLMAP sparse model", got=got) from None


def _camera_members(files: Files, path: Path, *, framed: bool) -> Files:
    """What the cameras are read from, with the frame of the splats if the zip tells it."""
    frames = _named(files, lambda name: name == FRAME_FILE)
    if not (frames or framed):
        return _model_members(files, path, 0)
    documents = _named(files, lambda name: name == TRANSFORMS) or _named(files, _is_transforms)
    if documents:
        chosen = {TRANSFORMS: files[_only(documents, TRANSFORMS, path)]}
    else:
        chosen = dict(_model_members(files, path, 0))
        model = next(whole_models(files))[0]
        above = [name for name in frames if model.is_relative_to(PurePosixPath(name).parent)]
        if frames and not above and len({scene_of(root) for root, _ in whole_models(files)}) > 1:
            got = f"one of {PurePosixPath(frames[0]).parent} and the model {model}"
            raise InvalidCameras(str(path), expected=f"the {FRAME_FILE} of the model", got=got, hint=ONE_RUN)
        frames = sorted(above, key=lambda name: -name.count("/"))[:1] or frames
    return {**chosen, **({FRAME_FILE: files[_only(frames, FRAME_FILE, path)]} if frames else {})}


def _named(files: Files, fits: Callable[[str], bool]) -> list[str]:
    found = [place for place in files if fits(PurePosixPath(place).name)]
    return sorted(found, key=lambda place: (place.count("/"), place))


def _is_transforms(name: str) -> bool:
    return name.startswith("transforms") and name.endswith(".json")


def _only(found: list[str], name: str, path: Path) -> str:
    """The one file of these.

    Raises:
        InvalidCameras: there are several.
    """
    if len(found) > 1:
        raise InvalidCameras(str(path), expected=f"one {name}", got=" and ".join(found[:2]), hint=ONE_RUN)
    return found[0]


def _model_members(files: Files, path: Path, place: int) -> Files:
    """The cameras and images of the model of this place among all."""
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
        if file == "cameras.json" or _is_transforms(file):
            framed = "" if file == "cameras.json" else f", or zip it with its run's {FRAME_FILE}"
            return f"{name!r}", f"give the JSON file itself{framed}"
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
