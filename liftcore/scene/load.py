"""Open scenes by what is in their files, whatever they are called."""

from __future__ import annotations

import zipfile
from typing import TYPE_CHECKING

from liftcore.errors import InvalidCameras, InvalidSplats
from liftcore.scene.cameras import told_of
from liftcore.scene.colmap import MODEL_FILES, has_model, is_whole, model_files, read_colmap
from liftcore.scene.distorted import is_undistorted, refuse_both
from liftcore.scene.foreign import LFS_POINTER, refuse_pointer
from liftcore.scene.inria import parse_inria
from liftcore.scene.json_file import read_json
from liftcore.scene.model_folders import model_folder, models_below
from liftcore.scene.model_zip import models_in_zip, read_model_zip
from liftcore.scene.transforms import parse_transforms

if TYPE_CHECKING:
    from pathlib import Path

    from liftcore.scene.cameras import Cameras
    from liftcore.scene.splats import Kernel, Splats

JSON_FILES = ("transforms.json", "cameras.json")
CAMERA_FORMATS = "a COLMAP sparse model (folder or .zip), a transforms.json or a cameras.json"
PICKLED = (".pt", ".pth", ".ckpt", ".pkl")


def kernel_named(name: str) -> Kernel | None:
    """The kernel that the setting ``kernel`` names, None for ``auto``: the file tells."""
    from liftcore.scene.splats import Kernel

    return None if name == "auto" else Kernel(name)


def load_splats(path: Path, kernel: Kernel | None = None, *, colour: bool = True) -> Splats:
    """Read trained splats from a PLY of any dialect (``liftcore.scene.ply``), with or without their colours.

    Raises:
        InvalidSplats: the file is no splat PLY, or what it holds is malformed.
    """
    from liftcore.scene.ply import read_splats

    if path.suffix.lower() in PICKLED and not _begins(path, LFS_POINTER):
        raise InvalidSplats(
            str(path),
            expected="a PLY file",
            got="a Python pickle, which may run code when it is opened",
            hint="export the splats as PLY from the program that trained them",
        )
    return read_splats(path, kernel, colour=colour)


def _begins(path: Path, first: bytes) -> bool:
    try:
        with path.open("rb") as handle:
            return handle.read(len(first)) == first
    except OSError:
        return False


def load_cameras(path: Path) -> Cameras:
    """Read cameras from a folder, a JSON file or a zipped COLMAP model, recognised by content.

    Raises:
        InvalidCameras: nothing here is a camera format that we know, or what it holds is malformed.
    """
    if path.is_dir():
        return _from_folder(path)
    if not path.is_file():
        raise InvalidCameras(str(path), expected=CAMERA_FORMATS, got="no such file or folder")
    try:
        if zipfile.is_zipfile(path):
            return read_model_zip(path)
        with path.open("rb") as handle:
            start = handle.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")
    except OSError as error:
        got = f"a file that does not open ({error.strerror})"
        raise InvalidCameras(str(path), expected=CAMERA_FORMATS, got=got) from None
    if path.name in MODEL_FILES and has_model(path.parent):
        return read_colmap(path.parent)
    if start[:1] not in (b"[", b"{"):
        refuse_pointer(str(path), start)
        got = f"a file that begins with {start[:8]!r}" if start else "an empty file"
        hint = "of a COLMAP model give the folder, or a zip of its cameras.* and images.* together"
        raise InvalidCameras(str(path), expected=CAMERA_FORMATS, got=got, hint=hint)
    return _from_json(path)


def camera_files(folder: Path) -> list[Path]:
    """The files of a folder that its cameras are read from: a whole model, else a JSON file, else half a model."""
    model = model_folder(folder)
    documents = [folder / name for name in JSON_FILES if (folder / name).is_file()]
    if model is not None and (is_whole(model) or not documents):
        return model_files(model)
    return documents[:1]


def other_models(path: Path) -> list[str]:
    """COLMAP models in a folder or a zip beside the one that its cameras are read from, by their folders.

    COLMAP writes several where photos did not all hang together, each in a frame of its own.
    """
    if path.is_dir():
        files = camera_files(path)
        return [str(model) for model in models_below(path) if len(files) > 1 and path / model != files[0].parent]
    return models_in_zip(path)[1:] if zipfile.is_zipfile(path) else []


def is_of_nerfstudio(path: Path) -> bool:
    """Whether cameras are read from a transforms.json that nerfstudio's own converter wrote."""
    files = camera_files(path) if path.is_dir() else [path]
    if len(files) != 1 or files[0].name in MODEL_FILES or zipfile.is_zipfile(files[0]):
        return False
    document = read_json(files[0])
    return isinstance(document, dict) and ("applied_transform" in document or "ply_file_path" in document)


def _from_folder(folder: Path) -> Cameras:
    files = camera_files(folder)
    if len(files) == 1:
        return _from_json(files[0])
    if not files:
        others = _cameras_below(folder)
        hint = f"name what is meant, such as {_some(others)}" if others else ""
        got = "a folder without any of them" + (" at the usual places" if others else "")
        raise InvalidCameras(str(folder), expected=CAMERA_FORMATS, got=got, hint=hint)
    cameras = read_colmap(files[0].parent)
    if cameras.distorted:
        others = [model for model in models_below(folder) if folder / model != files[0].parent]
        straight = [str(folder / model) for model in others if is_undistorted(folder / model)]
        refuse_both(str(folder), str(files[0].parent), straight, "name the one")
    return cameras


def _cameras_below(scene: Path) -> list[Path]:
    return [scene / model for model in models_below(scene)] + sorted(scene.glob("transforms*.json"))


def _some(paths: list[Path]) -> str:
    return " or ".join(str(path) for path in paths[:2])


def _from_json(path: Path) -> Cameras:
    document = read_json(path)
    with told_of(str(path)):
        return (parse_inria if isinstance(document, list) else parse_transforms)(document, str(path))
