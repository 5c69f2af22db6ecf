"""Open scenes by what is in their files, whatever they are called."""

from __future__ import annotations

import zipfile
from typing import TYPE_CHECKING

from liftcore.errors import InvalidCameras
from liftcore.io.camera_source import camera_source
from liftcore.io.camera_zip import models_in_zip, read_camera_zip
from liftcore.io.foreign import refuse_pointer
from liftcore.io.model_folders import models_below
from liftcore.scene.distorted import is_undistorted, refuse_both

if TYPE_CHECKING:
    from pathlib import Path

    from liftcore.scene.cameras import Cameras

CAMERA_FORMATS = "a COLMAP sparse model (folder or .zip), a transforms.json or a cameras.json"


def read_cameras(path: Path, *, choosing: bool = True) -> Cameras:
    """Read cameras from a folder, a JSON file or a zip, recognised by content (`camera_source`).

    Args:
        path: the folder or file.
        choosing: whether distorted cameras beside undistorted ones are refused, as somebody has to choose.

    Raises:
        InvalidCameras: nothing here is a camera format that we know, or what it holds is malformed.
        Unavailable: the temporary folder has no room for what is in a zip.
    """
    if path.is_dir():
        return _from_folder(path, choosing=choosing)
    if not path.is_file():
        raise InvalidCameras(str(path), expected=CAMERA_FORMATS, got="no such file or folder")
    try:
        if zipfile.is_zipfile(path):
            return read_camera_zip(path, camera_source(path).frame, choosing=choosing)
        with path.open("rb") as handle:
            start = handle.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")
    except OSError as error:
        got = f"a file that does not open ({error.strerror})"
        raise InvalidCameras(str(path), expected=CAMERA_FORMATS, got=got) from None
    source = camera_source(path)
    if source.model is None and start[:1] not in (b"[", b"{"):
        refuse_pointer(str(path), start)
        got = f"a file that begins with {start[:8]!r}" if start else "an empty file"
        hint = "of a COLMAP model give the folder, or a zip of its cameras.* and images.* together"
        raise InvalidCameras(str(path), expected=CAMERA_FORMATS, got=got, hint=hint)
    return source.read()


def other_models(path: Path) -> list[str]:
    """COLMAP models in a folder or a zip beside the one that its cameras are read from, by their folders.

    COLMAP writes several where photos did not all hang together, each in a frame of its own.
    """
    if path.is_dir():
        read = camera_source(path).model
        return [] if read is None else [str(model) for model in models_below(path) if path / model != read]
    return models_in_zip(path)[1:] if zipfile.is_zipfile(path) else []


def _from_folder(folder: Path, *, choosing: bool) -> Cameras:
    source = camera_source(folder)
    if source.model is None and source.file is None:
        others = _cameras_below(folder)
        hint = f"name what is meant, such as {_some(others)}" if others else ""
        got = "a folder without any of them" + (" at the usual places" if others else "")
        raise InvalidCameras(str(folder), expected=CAMERA_FORMATS, got=got, hint=hint)
    cameras = source.read()
    if choosing and source.model is not None and cameras.distorted:
        straight = [str(folder / model) for model in other_models(folder) if is_undistorted(folder / model)]
        refuse_both(str(folder), str(source.model), straight, "name the one")
    return cameras


def _cameras_below(scene: Path) -> list[Path]:
    return [scene / model for model in models_below(scene)] + sorted(scene.glob("transforms*.json"))


def _some(paths: list[Path]) -> str:
    return " or ".join(str(path) for path in paths[:2])
