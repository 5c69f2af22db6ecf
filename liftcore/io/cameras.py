"""Cameras from a folder, a JSON file or a zip: which of its files are read, and reading them.

A folder or zip may hold COLMAP models, a transforms.json or cameras.json, and nerfstudio's ``FRAME_FILE``, which
tells the frame of the splats. A zip is read as the folder that was zipped, under limits.
"""

import errno
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePath, PurePosixPath
from typing import TypeVar

from liftcore.errors import InvalidCameras, Unavailable
from liftcore.io.colmap import MODEL_FILES, has_model, is_whole, model_files, read_colmap
from liftcore.io.files import BROKEN_ZIP, is_system_file, open_regular, open_zip
from liftcore.io.inria import parse_inria
from liftcore.io.json_file import read_json
from liftcore.io.kinds import wrong_kind
from liftcore.io.remote import local_path
from liftcore.io.transforms import FRAME_FILE, OF_NERFSTUDIO, parse_transforms, read_frame
from liftcore.scene.cameras import Cameras, cameras_from

TRANSFORMS = "transforms.json"
JSON_FILES = (TRANSFORMS, "cameras.json")
FORMATS = "a COLMAP sparse model (folder or .zip), a transforms.json or a cameras.json"
# As trainers, COLMAP's reconstructor and its undistorter lay models out; the first that is there is read.
MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0", "0", "dense/0/sparse", "dense/sparse")
DEPTH = 4  # folders down that models are looked for, if only to be named
MAX_FOLDERS = 10_000  # that are looked into for it
MAX_UNZIPPED_BYTES = 512 * 1024 * 1024
MAX_ZIP_MEMBERS = 100_000
MOST_MODELS = 8  # of a zip that are looked at
ONE_RUN = "zip those of one run alone"
P = TypeVar("P", bound=PurePath)


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
            with cameras_from(source):
                cameras = (parse_inria if isinstance(document, list) else parse_transforms)(document, source)
        if self.frame is None:
            return cameras
        if isinstance(document, list):
            expected, got = "cameras that are still to be moved", "Inria's, which are in the frame of their splats"
            hint = f"take {source} or {FRAME_FILE} away, whichever is of another run"
            raise InvalidCameras(str(self.frame), expected=expected, got=got, hint=hint)
        similarity = read_frame(self.frame, document, source)
        with cameras_from(str(self.frame)):
            return similarity.moved(cameras)


def read_cameras(path: Path | str, *, choosing: bool = True) -> Cameras:
    """Read cameras from a folder, a JSON file or a zip, recognised by content (`camera_source`).

    Args:
        path: the folder or file.
        choosing: whether distorted cameras beside undistorted ones are refused, as somebody has to choose.

    Raises:
        InvalidInput: it lies elsewhere (`io.remote`), and does not come.
        InvalidCameras: nothing here is a camera format that we know, or what it holds is malformed.
        Unavailable: the temporary folder has no room for what is in a zip.
    """
    path = local_path(path)
    try:
        return _read(path, choosing=choosing)
    except InvalidCameras as error:
        raise wrong_kind(path, "cameras", InvalidCameras, expected=FORMATS) or error from None


def _read(path: Path, *, choosing: bool) -> Cameras:
    if path.is_dir():
        return _from_folder(path, choosing=choosing)
    if not path.exists():
        raise InvalidCameras(str(path), expected=FORMATS, got="no such file or folder")
    try:
        with open_regular(path) as handle:
            start = handle.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")
        if zipfile.is_zipfile(path):
            return _from_zip(path, camera_source(path).frame, choosing=choosing)
    except OSError as error:
        got = f"a file that does not open ({error.strerror})"
        raise InvalidCameras(str(path), expected=FORMATS, got=got) from None
    source = camera_source(path)
    if source.model is None and start[:1] not in (b"[", b"{"):
        got = f"a file that begins with {start[:8]!r}" if start else "an empty file"
        hint = "of a COLMAP model give the folder, or a zip of its cameras.* and images.* together"
        raise InvalidCameras(str(path), expected=FORMATS, got=got, hint=hint)
    return source.read()


def camera_source(path: Path) -> CameraSource:
    """The source of a path: of a folder a whole model, else a JSON file, else half a model; of a file itself.

    A ``FRAME_FILE`` counts in the folder, beside the file, and from a model's folder up to its scene's. In a folder
    with one a transforms.json comes first: nerfstudio trains on its intrinsics.
    """
    if not path.is_dir():
        if path.name in MODEL_FILES and has_model(path.parent):
            return _of_model(path.parent)
        return CameraSource(file=path, frame=_frame_in(path.parent))
    frame, models = _frame_in(path), [path / name for name in MODEL_FOLDERS if has_model(path / name)]
    documents = [path / name for name in JSON_FILES if (path / name).is_file()]
    if frame and (path / TRANSFORMS).is_file():
        return CameraSource(file=path / TRANSFORMS, frame=frame)
    whole = [model for model in models if is_whole(model)]
    if whole or (models and not documents):
        return _of_model((whole + models)[0])
    return CameraSource(file=next(iter(documents), None), frame=frame)


def other_models(path: Path) -> list[str]:
    """COLMAP models in a folder or a zip beside the one that its cameras are read from, by their folders.

    COLMAP writes several where photos did not all hang together, each in a frame of its own.
    """
    if path.is_dir():
        read = camera_source(path).model
        return [] if read is None else [str(model) for model in _models_below(path) if path / model != read]
    if not zipfile.is_zipfile(path):
        return []
    with open_zip(path) as archive:
        return [str(model) for model in _whole_models(_files(archive))[1:]]


def has_nerfstudio_beside(path: Path) -> bool:
    """Whether poses of nerfstudio's own frame lie beside the COLMAP model that is read from a folder, file or zip."""
    source = camera_source(path)
    if source.model is not None:
        beside = (folder / TRANSFORMS for folder in _up_to_scene(source.model))
        return any(_is_of_nerfstudio(document) for document in beside if document.is_file())
    if source.file is None or not zipfile.is_zipfile(source.file):
        return False
    with open_zip(source.file) as archive:
        return bool(_named(_files(archive), lambda name: name == TRANSFORMS))


def _is_of_nerfstudio(document: Path) -> bool:
    """Whether a transforms.json reads, and was written by nerfstudio's own converter."""
    try:
        found = read_json(document)
    except InvalidCameras:
        return False
    return isinstance(found, dict) and any(key in found for key in OF_NERFSTUDIO)


# ---- folders


def _from_folder(folder: Path, *, choosing: bool) -> Cameras:
    source = camera_source(folder)
    if source.model is None and source.file is None:
        others = [folder / model for model in _models_below(folder)] + sorted(folder.glob("transforms*.json"))
        hint = f"name what is meant, such as {' or '.join(map(str, others[:2]))}" if others else ""
        got = "a folder without any of them" + (" at the usual places" if others else "")
        raise InvalidCameras(str(folder), expected=FORMATS, got=got, hint=hint)
    cameras = source.read()
    if choosing and source.model is not None and cameras.distorted:
        straight = [str(folder / model) for model in other_models(folder) if _is_undistorted(folder / model)]
        _refuse_both(str(folder), str(source.model), straight, "name the one")
    return cameras


def _is_undistorted(model: Path) -> bool:
    """Whether a folder has a model that reads, of pinholes alone."""
    try:
        return not read_colmap(model).distorted
    except InvalidCameras:
        return False


def _refuse_both(source: str, read: str, undistorted: list[str], choose: str) -> None:
    """Refuse the distorted model that was read where undistorted ones lie beside it: which is meant is no guess."""
    if undistorted:
        got = f"distorted ones in {read} and undistorted ones in {undistorted[0]}"
        hint = f"{choose} whose photos the features were made of"
        raise InvalidCameras(source, expected="distorted or undistorted cameras, not both", got=got, hint=hint)


def _of_model(model: Path) -> CameraSource:
    frames = filter(None, map(_frame_in, _up_to_scene(model)))
    return CameraSource(model=model, frame=next(frames, None))


def _up_to_scene(model: Path) -> list[Path]:
    """The folders from a model's up to its scene's."""
    folder = Path(os.path.abspath(model))  # links stay: files lie where somebody put them
    return [folder, *(parent for parent in folder.parents if parent.is_relative_to(_scene_of(folder)))]


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


def _models_below(folder: Path) -> list[PurePosixPath]:
    """Folders with whole models below one, relative to it, in the order of ``_preference``.

    Hidden folders, links and what lies deep down are left out, so that a folder of many scenes costs little.
    """
    names: list[str] = []
    for parent, inner, files in islice(os.walk(folder), MAX_FOLDERS):
        here = Path(parent).relative_to(folder)
        names += [(here / name).as_posix() for name in files if name in MODEL_FILES]
        inner[:] = [name for name in sorted(inner) if len(here.parts) < DEPTH and not is_system_file(Path(name))]
    return _whole_models(names)


def _whole_models(names: Iterable[str]) -> list[PurePosixPath]:
    """The folders with both files of a model among such names, the preferred first."""
    known = {PurePosixPath(name) for name in names}
    found = {
        path.parent
        for path in known
        if path.stem == "cameras" and path.with_stem("images") in known and path.name in MODEL_FILES
    }
    return sorted(found, key=_preference)


def _preference(model: PurePosixPath) -> tuple[bool, int, str, int]:
    """What models are sorted by: as if folders were opened as scenes one by one, the outermost first.

    So the first model of a zip is the one that is read from the same files in a folder. What lies in a folder
    ``distorted`` comes last: 3DGS's ``convert.py`` keeps there what it has undistorted.
    """
    scene = _scene_of(model)
    place = MODEL_FOLDERS.index(str(model.relative_to(scene)))
    return "distorted" in model.parts, len(scene.parts), str(scene), place


def _scene_of(model: P) -> P:
    """The outermost folder in which a model has one of the usual places; its own folder at least."""
    places = [PurePosixPath(place).parts for place in MODEL_FOLDERS]
    cut = max(len(place) for place in places if model.parts[len(model.parts) - len(place) :] == place)
    return type(model)(*model.parts[: len(model.parts) - cut])


# ---- zips


def _from_zip(path: Path, beside: Path | None, *, choosing: bool) -> Cameras:
    """The cameras of the preferred model in a zip; with a frame's file in it or ``beside`` it, a transforms first."""
    with tempfile.TemporaryDirectory(prefix="splatlift-") as folder:
        root = Path(folder)
        names = _unzip(path, root)
        source = _source_in_zip(names, root, path, beside)
        try:
            cameras = source.read()
        except InvalidCameras as error:
            argument, got, hint = (
                text.replace(folder, str(path)) for text in (error.argument, error.got, error.hint)
            )
            raise InvalidCameras(argument, expected=error.expected, got=got, hint=hint) from None
        if choosing and source.model is not None and cameras.distorted:
            read, *others = _whole_models(names)[:MOST_MODELS]
            straight = [str(model) for model in others if _is_undistorted(root / model)]
            _refuse_both(str(path), str(read), straight, "zip the one alone")
    return cameras


def _source_in_zip(names: list[str], root: Path, path: Path, beside: Path | None) -> CameraSource:
    """What is read of a zip whose camera files lie unzipped in ``root``, wherever they are there."""
    models, frames = _whole_models(names), _named(names, lambda name: name == FRAME_FILE)
    documents = _named(names, lambda name: name == TRANSFORMS) or _named(names, _is_transforms)
    if documents and (frames or beside):
        frame = root / _only(frames, FRAME_FILE, path) if frames else beside
        return CameraSource(file=root / _only(documents, TRANSFORMS, path), frame=frame)
    if not models:
        got, hint = _what_else(names)
        expected = "a COLMAP model (cameras and images, .bin or .txt) in the zip"
        raise InvalidCameras(str(path), expected=expected, got=got, hint=hint)
    above = [name for name in frames if models[0].is_relative_to(PurePosixPath(name).parent)]
    if frames and not above and len({_scene_of(model) for model in models}) > 1:
        got = f"one of {PurePosixPath(frames[0]).parent} and the model {models[0]}"
        raise InvalidCameras(str(path), expected=f"the {FRAME_FILE} of the model", got=got, hint=ONE_RUN)
    frames = above[-1:] or frames
    return CameraSource(model=root / models[0], frame=root / _only(frames, FRAME_FILE, path) if frames else beside)


def _files(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """The files by their names in a folder of the zip's own, with slashes: some programs write backslashes or ``./``.

    What is hidden, or below a hidden folder, is left out, as it is of folders.
    """
    files = {}
    for member in archive.infolist():
        parts = PurePosixPath(member.filename.replace("\\", "/")).parts
        inner = [part for part in parts if part not in ("/", "..")]
        if inner and not member.is_dir() and not is_system_file(PurePosixPath(*inner)):
            files["/".join(inner)] = member
    return files


def _unzip(path: Path, folder: Path) -> list[str]:
    """Unzip what cameras may be read from, each file at its place; the names of all files in the zip."""
    try:
        with open_zip(path) as archive:
            count, budget = len(archive.infolist()), MAX_UNZIPPED_BYTES
            if count > MAX_ZIP_MEMBERS:
                raise InvalidCameras(str(path), expected=f"at most {MAX_ZIP_MEMBERS} files", got=str(count))
            files = _files(archive)
            for name, member in files.items():
                last = PurePosixPath(name).name
                if last in (*MODEL_FILES, FRAME_FILE) or _is_transforms(last):
                    (folder / name).parent.mkdir(parents=True, exist_ok=True)
                    budget -= _unzip_one(archive, member, folder / name, budget)
            return list(files)
    except BROKEN_ZIP as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            expected, hint = f"room in {tempfile.gettempdir()} for what is in the zip", "make room, or set TMPDIR"
            raise Unavailable(str(path), expected=expected, got="a full disk", hint=hint) from None
        got = f"one that does not open ({str(error)[:120]})"
        raise InvalidCameras(str(path), expected="a zip of a COLMAP sparse model", got=got) from None


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


def _named(names: Iterable[str], fits: Callable[[str], bool]) -> list[str]:
    """Those whose last part fits, the outermost first."""
    found = [name for name in names if fits(PurePosixPath(name).name)]
    return sorted(found, key=lambda name: (name.count("/"), name))


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
