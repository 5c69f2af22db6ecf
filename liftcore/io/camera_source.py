"""Which of the files of a folder cameras are read from, and reading them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from liftcore.errors import InvalidCameras
from liftcore.io.colmap import MODEL_FILES, has_model, is_whole, model_files, read_colmap
from liftcore.io.frame import FRAME_FILE, read_frame
from liftcore.io.inria import parse_inria
from liftcore.io.json_file import read_json
from liftcore.io.model_folders import model_folder, scene_of
from liftcore.io.transforms import OF_NERFSTUDIO, parse_transforms
from liftcore.scene.cameras import told_of

if TYPE_CHECKING:
    from liftcore.scene.cameras import Cameras

TRANSFORMS = "transforms.json"
JSON_FILES = (TRANSFORMS, "cameras.json")


@dataclass(frozen=True)
class CameraSource:
    """What cameras are read from: a COLMAP model or one file, and the file that tells the frame of the splats."""

    model: Path | None = None  # a folder
    file: Path | None = None  # a JSON document or a zip
    frame: Path | None = None  # a FRAME_FILE

    @property
    def files(self) -> list[Path]:
        """All files that are read."""
        cameras = [self.file] if self.file else model_files(self.model) if self.model else []
        return cameras + ([self.frame] if self.frame else [])

    def read(self) -> Cameras:
        """The cameras, in the frame of the splats where a file tells it.

        Raises:
            InvalidCameras: a file is missing or malformed.
        """
        if self.model is not None:
            source, document, cameras = str(self.model), {}, read_colmap(self.model)
        else:
            assert self.file is not None
            source, document = str(self.file), read_json(self.file)
            with told_of(source):
                cameras = (parse_inria if isinstance(document, list) else parse_transforms)(document, source)
        if self.frame is None:
            return cameras
        if isinstance(document, list):
            expected, got = "cameras that are still to be moved", "Inria's, which are in the frame of their splats"
            hint = f"take {source} or {FRAME_FILE} away, whichever is of another run"
            raise InvalidCameras(str(self.frame), expected=expected, got=got, hint=hint)
        similarity = read_frame(self.frame, document, source)
        with told_of(str(self.frame)):
            return similarity.moved(cameras)


def camera_source(path: Path) -> CameraSource:
    """The source of a path: of a folder a whole model, else a JSON file, else half a model; of a file itself.

    A ``FRAME_FILE`` counts in the folder, beside the file, and from a model's folder up to its scene's. In a folder
    with one a transforms.json comes first: nerfstudio trains on its intrinsics.
    """
    if path.is_dir():
        return _of_folder(path)
    if path.name in MODEL_FILES and has_model(path.parent):
        return _of_model(path.parent)
    return CameraSource(file=path, frame=_frame_in(path.parent))


def is_of_nerfstudio(document: Path) -> bool:
    """Whether a transforms.json reads, and was written by nerfstudio's own converter."""
    try:
        found = read_json(document)
    except InvalidCameras:
        return False
    return isinstance(found, dict) and any(key in found for key in OF_NERFSTUDIO)


def _of_folder(folder: Path) -> CameraSource:
    frame, model = _frame_in(folder), model_folder(folder)
    documents = [folder / name for name in JSON_FILES if (folder / name).is_file()]
    if frame and (folder / TRANSFORMS).is_file():
        return CameraSource(file=folder / TRANSFORMS, frame=frame)
    if model is not None and (is_whole(model) or not documents):
        return _of_model(model)
    return CameraSource(file=next(iter(documents), None), frame=frame)


def found_near(model: Path, name: str) -> list[Path]:
    """Files of a name from a model's folder up to its scene's, the nearest first."""
    return [folder / name for folder in _up_to_scene(model) if (folder / name).is_file()]


def _of_model(model: Path) -> CameraSource:
    frames = filter(None, map(_frame_in, _up_to_scene(model)))
    return CameraSource(model=model, frame=next(frames, None))


def _up_to_scene(model: Path) -> list[Path]:
    folder = Path(os.path.abspath(model))  # links stay: files lie where somebody put them
    return [folder, *(parent for parent in folder.parents if parent.is_relative_to(scene_of(folder)))]


def _frame_in(folder: Path) -> Path | None:
    """The frame's file in a folder, if there is one.

    Raises:
        InvalidCameras: there is something else of that name, such as a link that leads nowhere.
    """
    path = folder / FRAME_FILE
    if path.is_file():
        return path
    if os.path.lexists(path):
        got = "a link that leads to none" if path.is_symlink() else "none"
        raise InvalidCameras(str(path), expected="a file", got=got, hint="copy the file itself, or take it away")
    return None
