"""Cameras from a folder, a JSON file or a zip: choice of its files, and their readers.

A folder or zip may hold a COLMAP model, a transforms.json or cameras.json, and nerfstudio's ``FRAME_FILE``, which has
the transform to the frame of the splats. A zip is read as the folder that was zipped, under limits.

COLMAP writes several models (``sparse/0``, ``sparse/1``, ...) where photos do not form one connected scene, each in a
frame of its own. Only the user knows which is that of the splats, so a folder of several is refused.
"""

import errno
import os
import re
import shutil
import tempfile
import zipfile
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from liftcore.errors import InvalidCameras, Unavailable, naming, reading
from liftcore.io.colmap import MODEL_FILES, has_model, is_whole, model_files, read_colmap, read_image_names
from liftcore.io.files import BROKEN_ZIP, files_in_zip, first_bytes, is_zip, open_regular, open_zip
from liftcore.io.json_file import FORMATS as JSON_FORMATS
from liftcore.io.json_file import matrix, number, pixels, read_json
from liftcore.io.kinds import wrong_kind
from liftcore.io.photos import PhotosBeside
from liftcore.io.transforms import FRAME_FILE, cameras_in_frame, is_export, parse_export, parse_transforms, read_frame
from liftcore.runtime.arguments import as_path
from liftcore.runtime.folders import scratch_folder
from liftcore.scene.cameras import Camera, Cameras, InvalidPose, read_views, viewmat_of
from liftcore.scene.views import view_names

TRANSFORMS, TRAINED_ON = "transforms.json", "transforms_train.json"
JSON_FILES = (TRANSFORMS, "cameras.json", TRAINED_ON)
FORMATS = "a COLMAP sparse model (folder or .zip), a transforms.json or a cameras.json"
# Places where trainers, COLMAP's reconstructor and its undistorter put models; N is a number.
MODEL_PLACES = (".", "sparse/N", "sparse", "colmap/sparse/N", "N", "dense/N/sparse", "dense/sparse")
_PLACE = re.compile(r"(^|/)((colmap/)?sparse/\d+|dense/(\d+/)?sparse|sparse|\d+)$")  # the same, at a path's end
MAX_UNZIPPED_BYTES = 512 * 1024 * 1024
MAX_ZIP_MEMBERS = 100_000
MAX_LISTED = 3  # models in an error
OTHER_FRAME = (
    f"the COLMAP model was read, and {TRANSFORMS} beside it was not: splats that nerfstudio trained are in a frame "
    f"of their own, so put its run's {FRAME_FILE} beside them"
)


@dataclass(frozen=True)
class CameraSource:
    """Source of cameras: a COLMAP model or one file, and the file with the transform to the frame of the splats."""

    model: Path | None = None  # a folder
    file: Path | None = None  # a JSON document or a zip
    frame: Path | None = None  # a FRAME_FILE
    data: Path | None = None  # a transforms.json with the intrinsics of nerfstudio's camera export
    photos: zipfile.Path | None = None  # the folder of the file within its zip; None: on the disk
    warnings: tuple[str, ...] = ()  # about files beside it that are not read

    @property
    def files(self) -> list[Path]:
        """All files that are read."""
        cameras = [self.file] if self.file else model_files(self.model) if self.model else []
        return [*cameras, *(path for path in (self.frame, self.data) if path is not None)]

    def read(self) -> Cameras:
        """Read the cameras, in the frame of the splats where ``frame`` has the transform."""
        if self.model is not None:
            source, document, cameras = str(self.model), {}, read_colmap(self.model)
        else:
            assert self.file is not None
            source, document = str(self.file), read_json(self.file)
            photos = PhotosBeside(self.photos or Path(os.path.abspath(self.file)).parent)
            with naming(source):
                if is_export(document):
                    data = read_json(self.data) if self.data else None
                    cameras = parse_export(document, source, data, photos)
                elif isinstance(document, list):
                    cameras = _parse_inria(document, source)
                else:
                    cameras = parse_transforms(document, source, photos)
        if self.frame is not None and not is_export(document):  # an export is in the frame of the splats
            if isinstance(document, list):
                expected, got = "cameras in another frame", "Inria's, which are in the frame of their splats"
                hint = f"remove {source} or {FRAME_FILE}, whichever is of another run"
                raise InvalidCameras(str(self.frame), expected=expected, got=got, hint=hint)
            matrix = read_frame(self.frame, document, source)
            with naming(self.frame):
                cameras = cameras_in_frame(cameras, matrix)
        cameras.warnings += self.warnings
        return cameras


def read_cameras(path: Path | str) -> Cameras:
    """Read cameras from a folder, a JSON file or a zip, recognised by content (`camera_source`).

    Raises:
        InvalidCameras: no camera format is recognised, several models are, or the content is malformed.
        Unavailable: the temporary folder has no free space for the files of a zip.
    """
    path = as_path(path)
    try:
        with reading(path, InvalidCameras, FORMATS):
            return _read(path)
    except InvalidCameras as error:
        raise wrong_kind(path, "cameras", InvalidCameras, expected=FORMATS) or error from None


def _read(path: Path) -> Cameras:
    if not path.exists():
        raise ValueError(f"{FORMATS}, got no such file or folder")
    source = camera_source(path)
    if source.file is None:
        if source.model is not None:
            return source.read()
        candidates = sorted(path.glob("transforms*.json"))
        hint = f"name one of the files, such as {candidates[0]}" if candidates else ""
        raise ValueError(f"{FORMATS}, got a folder without any of them; {hint}")
    with open_regular(source.file) as handle:
        start = handle.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")
    if is_zip(source.file):
        return _from_zip(source.file, source.frame)
    if start[:1] not in (b"[", b"{"):
        hint = "of a COLMAP model give the folder, or a zip of its cameras.* and images.* together"
        raise ValueError(f"{FORMATS}, got a file that begins with {first_bytes(start)}; {hint}")
    return source.read()


def camera_source(path: Path) -> CameraSource:
    """Return the source of a path: in a folder a complete model, else a JSON file, else an incomplete model.

    A ``FRAME_FILE`` applies from the folder, from beside the file, and from a model's folder up to its scene's. Where
    there is one, a transforms.json is preferred, as nerfstudio trains on its intrinsics. nerfstudio's camera export
    is preferred to all, as it is in the frame of the splats.
    """
    if path.is_dir():
        return _source_in_folder(path, _frame_in(path))
    return _of_model(path.parent) if path.name in MODEL_FILES and has_model(path.parent) else _of_document(path)


def _source_in_folder(path: Path, frame: Path | None) -> CameraSource:
    documents = [path / name for name in JSON_FILES if (path / name).is_file()]
    export = path / TRAINED_ON
    if export in documents and _begins_a_list(export):
        return _of_document(export, folder=path)
    if (path / TRANSFORMS) in documents and frame is not None:
        return replace(_of_document(path / TRANSFORMS), frame=frame)
    models = [model for place in MODEL_PLACES for model in _models_at(path, place) if is_whole(model)]
    models = models[:1] if is_whole(path) else models  # what is named is read
    if len(models) > 1:
        raise _several_models(path, models)
    if models:
        source = _of_model(models[0])
        warnings = (OTHER_FRAME,) if (path / TRANSFORMS) in documents else ()
        return replace(source, frame=source.frame or frame, warnings=warnings)
    halves = [model for place in MODEL_PLACES for model in _models_at(path, place) if has_model(model)]
    if halves and not documents:
        return _of_model(halves[0])
    if not documents:
        return CameraSource(frame=frame)
    return replace(_of_document(documents[0], folder=path), frame=frame)


def _models_at(scene: Path, place: str) -> list[Path]:
    """Return the folders at one of MODEL_PLACES, in the order of their numbers."""
    above, number, inner = place.partition("N")
    if not number:
        return [scene / place]
    folder = scene / above
    folders = [path for path in folder.iterdir() if path.name.isdecimal()] if folder.is_dir() else []
    return [path / inner.strip("/") for path in sorted(folders, key=lambda path: int(path.name))]


def _several_models(scene: Path, models: list[Path]) -> InvalidCameras:
    """Return the error that lists the models of a scene with their numbers of images."""
    listing = []
    for model in models[:MAX_LISTED]:
        count = "not read"
        with suppress(InvalidCameras):
            count = f"{len(read_image_names(model))} images"
        listing.append(f"{model.relative_to(scene).as_posix()} ({count})")
    rest = f" and {len(models) - MAX_LISTED} more" if len(models) > MAX_LISTED else ""
    hint = f"name the folder of the one that the splats were trained on, as {models[0]}: each has a frame of its own"
    return InvalidCameras(str(scene), expected="one COLMAP model", got=f"{', '.join(listing)}{rest}", hint=hint)


def _of_document(path: Path, folder: Path | None = None) -> CameraSource:
    """Return the source of a JSON file or zip; if the caller named its ``folder``, warn of documents in it."""
    data = path.with_name(TRANSFORMS)
    documents = sorted(folder.glob("transforms*.json")) if folder and path.name != TRANSFORMS else []
    unread = [other.name for other in documents if other not in (path, data)]
    warning = f"{path.name} was read, and {', '.join(unread)} not: name a file to read that one"
    return CameraSource(
        file=path,
        frame=_frame_in(path.parent),
        data=data if path != data and data.is_file() and _begins_a_list(path) else None,
        warnings=(warning,) if unread else (),
    )


def _begins_a_list(path: Path) -> bool:
    """Return True if a file begins as a JSON list, as camera exports do and a transforms.json does not."""
    with suppress(OSError), path.open("rb") as handle:
        return handle.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")[:1] == b"["
    return False


def _of_model(model: Path) -> CameraSource:
    folder = Path(os.path.abspath(model))  # links are not resolved: files beside the link count
    scene = Path(_scene_of(PurePosixPath(folder.as_posix())))
    upwards = [folder, *(parent for parent in folder.parents if parent.is_relative_to(scene))]
    return CameraSource(model=model, frame=next(filter(None, map(_frame_in, upwards)), None))


def _frame_in(folder: Path) -> Path | None:
    """Return the ``FRAME_FILE`` in a folder; None if there is none."""
    path = folder / FRAME_FILE
    if path.is_file():
        return path
    if os.path.lexists(path):
        got = "a broken link" if path.is_symlink() else "no regular file"
        raise InvalidCameras(str(path), expected="a file", got=got, hint="copy the file itself, or remove it")
    return None


def _scene_of(model: PurePosixPath) -> PurePosixPath:
    """Return the outermost folder in which a model has one of MODEL_PLACES; its own folder at least."""
    return PurePosixPath(_PLACE.sub("", model.as_posix()))


def _parse_inria(document: list[Any], source: str) -> Cameras:
    """Parse the cameras.json of Inria's trainer; its successors add ``cx`` and ``cy``, else the image's centre."""
    with reading(source, InvalidCameras, JSON_FORMATS):
        foreign = [record for record in document if not isinstance(record, dict) or "img_name" not in record]
        if foreign:
            hint = "a COLMAP model, or poses as a transforms.json, are read too"
            raise ValueError(f"{JSON_FORMATS}, got a list with {repr(foreign[0])[:60]}; {hint}")
        names = view_names([str(record["img_name"]) for record in document])

    def camera(name: str, record: dict[str, Any]) -> Camera:
        with reading(f"{source} camera {name!r}", InvalidCameras, "a camera"):
            width, height = (pixels(record[key], key) for key in ("width", "height"))
            centre = {"cx": width / 2, "cy": height / 2}
            fx, fy, cx, cy = (number((centre | record)[key], key) for key in ("fx", "fy", "cx", "cy"))
        with reading(f"{source} camera {name!r}", InvalidPose, "a pose"):
            rotation = matrix(record["rotation"], (3,), 3, "rotation")
            position = matrix([record["position"]], (1,), 3, "position")
        viewmat = viewmat_of(np.concatenate([rotation, position.T], axis=1), "opencv")
        return Camera.pinhole(name, width, height, fx, fy, cx, cy, viewmat)

    views, warnings = read_views(zip(names, document, strict=True), camera)
    return Cameras(views, warnings=warnings)


# ---- zips


def _from_zip(path: Path, frame_file: Path | None) -> Cameras:
    """Read the cameras of a zip as those of the folder; ``frame_file`` lies beside the zip."""
    try:
        with open_zip(path) as archive, scratch_folder("splatlift-") as root:
            return _from_unzipped(archive, path, root, frame_file)
    except BROKEN_ZIP as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            expected, hint = f"free space in {tempfile.gettempdir()} for the zip's files", "free some, or set TMPDIR"
            raise Unavailable(str(path), expected=expected, got="a full disk", hint=hint) from None
        if ", got " in str(error):
            raise
        raise ValueError(f"a zip of cameras, got one that does not open ({str(error)[:120]})") from None


def _from_unzipped(archive: zipfile.ZipFile, path: Path, root: Path, frame_file: Path | None) -> Cameras:
    """Read the cameras of a zip through a folder ``root``, and name the zip in errors of its files."""
    names = _unzip(archive, root)
    try:
        source = _source_in_zip(names, root, frame_file)
        if source.file is not None:
            inner = source.file.parent.relative_to(root).as_posix()
            source = replace(source, photos=zipfile.Path(archive, "" if inner == "." else f"{inner}/"))
        return source.read()
    except InvalidCameras as error:
        argument, got = (text.replace(str(root), str(path)) for text in (error.argument, error.got))
        hint = "unzip it, and " + error.hint.replace(f"{root}/", "") if str(root) in error.hint else error.hint
        raise InvalidCameras(argument, expected=error.expected, got=got, hint=hint) from None


def _source_in_zip(names: list[str], root: Path, frame_file: Path | None) -> CameraSource:
    """Return the source of a zip whose camera files lie unzipped in ``root``, at any depth."""
    files = sorted(map(PurePosixPath, names), key=lambda file: (len(file.parts), file))
    frames = [file for file in files if file.name == FRAME_FILE]
    models = {file.parent for file in files if file.name in MODEL_FILES and is_whole(root / file.parent)}
    # 3DGS's convert.py keeps the input of its undistortion in a folder "distorted".
    models = {model for model in models if "distorted" not in model.parts} or models
    scenes = {_scene_of(model) for model in models} | {file.parent for file in files if _is_transforms(file.name)}
    for noun, places in (("scene", sorted(map(str, scenes))), (FRAME_FILE, [str(frame) for frame in frames])):
        if len(places) > 1:
            raise ValueError(f"one {noun}, got {' and '.join(places[:2])}; zip those of one run alone")
    if not scenes:
        hint = "zip the folder that has both files together, or give a cameras.json itself"
        raise ValueError(f"a COLMAP model (cameras and images, .bin or .txt) in the zip, got none; {hint}")
    folder = root / scenes.pop()
    source = _source_in_folder(folder, root / frames[0] if frames else frame_file)
    if source.file is None and source.model is None:  # transforms of another name
        documents = sorted(file for file in files if _is_transforms(file.name))
        return replace(_of_document(root / documents[0], folder=folder), frame=source.frame)
    return source


def _unzip(archive: zipfile.ZipFile, folder: Path) -> list[str]:
    """Unzip the camera files to ``folder``, and return the names of all files in the zip."""
    if (count := len(archive.infolist())) > MAX_ZIP_MEMBERS:
        raise ValueError(f"at most {MAX_ZIP_MEMBERS} files, got {count}")
    files = files_in_zip(archive)
    lasts = {name: PurePosixPath(name).name for name in files}
    of_cameras = {
        name: files[name]
        for name, last in lasts.items()
        if last in (*MODEL_FILES, FRAME_FILE) or _is_transforms(last)
    }
    if (size := sum(member.file_size for member in of_cameras.values())) > MAX_UNZIPPED_BYTES:
        hint = "leave the points out of the zip"
        raise ValueError(f"at most {MAX_UNZIPPED_BYTES} bytes unzipped, got {size} bytes; {hint}")
    for name, member in of_cameras.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with archive.open(member) as source, (folder / name).open("wb") as sink:
            shutil.copyfileobj(source, sink)  # no more than the size that was added up
    return list(files)


def _is_transforms(name: str) -> bool:
    return name.startswith("transforms") and name.endswith(".json")
