"""Cameras from a folder, a JSON file or a zip: choice of its files, and their readers.

A folder or zip may hold COLMAP models, a transforms.json or cameras.json, and nerfstudio's ``FRAME_FILE``, which
has the transform to the frame of the splats. A zip is read as the folder that was zipped, under limits.

COLMAP writes several models (``sparse/0``, ``sparse/1``, ...) where photos do not form one connected scene, each in a
frame of its own. The model with cameras for most views of the features is read, else the one with most images.
"""

import errno
import os
import tempfile
import zipfile
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path, PurePath, PurePosixPath
from typing import TypeVar

from liftcore.errors import InvalidCameras, Unavailable
from liftcore.io.colmap import MODEL_FILES, has_model, is_whole, model_files, read_colmap, read_image_names
from liftcore.io.files import BROKEN_ZIP, is_system_file, open_regular, open_zip
from liftcore.io.inria import parse_inria
from liftcore.io.json_file import read_json
from liftcore.io.kinds import wrong_kind
from liftcore.io.photos import PhotosBeside
from liftcore.io.transforms import (
    FISHEYE,
    FRAME_FILE,
    OF_NERFSTUDIO,
    is_export,
    parse_export,
    parse_transforms,
    read_frame,
)
from liftcore.runtime.arguments import as_path
from liftcore.runtime.folders import scratch_folder
from liftcore.scene.cameras import Cameras, cameras_from
from liftcore.scene.distortion import Fisheye
from liftcore.scene.views import cameras_of_views

TRANSFORMS, TRAINED_ON = "transforms.json", "transforms_train.json"
JSON_FILES = (TRANSFORMS, "cameras.json", TRAINED_ON)
FORMATS = "a COLMAP sparse model (folder or .zip), a transforms.json or a cameras.json"
# Places where trainers, COLMAP's reconstructor and its undistorter put models; the first that exists is read.
MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0", "0", "dense/0/sparse", "dense/sparse")
DEPTH = 4  # levels of folders that are searched for other models
MAX_FOLDERS = 10_000  # of that search
MAX_UNZIPPED_BYTES = 512 * 1024 * 1024
MAX_ZIP_MEMBERS = 100_000
MAX_MODELS = 8  # of a zip that are compared
MAX_LISTED = 3  # files or models in a warning
ONE_RUN = "zip those of one run alone"
P = TypeVar("P", bound=PurePath)


@dataclass(frozen=True)
class CameraSource:
    """Source of cameras: a COLMAP model or one file, and the file with the transform to the frame of the splats."""

    model: Path | None = None  # a folder
    file: Path | None = None  # a JSON document or a zip
    frame: Path | None = None  # a FRAME_FILE
    data: Path | None = None  # a transforms.json or a COLMAP model, with the intrinsics of nerfstudio's camera export
    photos: zipfile.Path | None = None  # the folder of the file within its zip; None: on the disk
    warnings: tuple[str, ...] = ()  # about files beside it that are not read

    @property
    def files(self) -> list[Path]:
        """All files that are read."""
        cameras = [self.file] if self.file else model_files(self.model) if self.model else []
        data = [] if self.data is None else model_files(self.data) if self.data.is_dir() else [self.data]
        return cameras + ([self.frame] if self.frame else []) + data

    def read(self) -> Cameras:
        """Read the cameras, in the frame of the splats where ``frame`` has the transform.

        Raises:
            InvalidCameras: a file is missing or malformed.
        """
        cameras = self._read_in_splat_frame()
        cameras.warnings += self.warnings
        return cameras

    def _read_in_splat_frame(self) -> Cameras:
        if self.model is not None:
            source, document, cameras = str(self.model), {}, read_colmap(self.model)
        else:
            assert self.file is not None
            source, document = str(self.file), read_json(self.file)
            cameras = self._parse(document, source)
        if self.frame is None or is_export(document):  # an export is in the frame of the splats
            return cameras
        if isinstance(document, list):
            expected, got = "cameras in another frame", "Inria's, which are in the frame of their splats"
            hint = f"remove {source} or {FRAME_FILE}, whichever is of another run"
            raise InvalidCameras(str(self.frame), expected=expected, got=got, hint=hint)
        similarity = read_frame(self.frame, document, source)
        with cameras_from(str(self.frame)):
            return similarity.transformed(cameras)

    def _parse(self, document: object, source: str) -> Cameras:
        assert self.file is not None
        photos = PhotosBeside(self.photos or Path(os.path.abspath(self.file)).parent)
        with cameras_from(source):
            if is_export(document):
                return parse_export(document, source, _intrinsics_in(self.data) if self.data else None, photos)
            if isinstance(document, list):
                return parse_inria(document, source)
            return parse_transforms(document, source, photos)


def _intrinsics_in(data: Path) -> object:
    """Read a transforms.json, or make one without poses from the intrinsics of a COLMAP model's images."""
    if data.is_file():
        return read_json(data)
    frames = []
    for name, camera in read_colmap(data).items():
        lens = camera.lens
        image = lens or camera
        frame = {"file_path": name, "w": image.width, "h": image.height, "fl_x": image.fx, "fl_y": image.fy}
        frame |= {"cx": image.cx, "cy": image.cy}
        if lens is not None:
            frame |= {key: value for key, value in asdict(lens.distortion).items() if value}
            frame["camera_model"] = FISHEYE if isinstance(lens.distortion, Fisheye) else "OPENCV"
        frames.append(frame)
    intrinsics = [{key: value for key, value in frame.items() if key != "file_path"} for frame in frames]
    return {"frames": frames, **(intrinsics[0] if all(entry == intrinsics[0] for entry in intrinsics) else {})}


def read_cameras(path: Path | str, *, choosing: bool = True, views: Collection[str] = ()) -> Cameras:
    """Read cameras from a folder, a JSON file or a zip, recognised by content (`camera_source`).

    Args:
        path: the folder or file.
        choosing: refuse distorted cameras beside undistorted ones, as the caller has to choose.
        views: names of views of features or a lift, which select one of several COLMAP models.

    Raises:
        InvalidCameras: no camera format is recognised, or the content is malformed.
        Unavailable: the temporary folder has no free space for the files of a zip.
    """
    path = as_path(path)
    try:
        return _read(path, choosing=choosing, views=views)
    except InvalidCameras as error:
        raise wrong_kind(path, "cameras", InvalidCameras, expected=FORMATS) or error from None


def _read(path: Path, *, choosing: bool, views: Collection[str]) -> Cameras:
    if path.is_dir():
        return _from_folder(path, choosing=choosing, views=views)
    if not path.exists():
        raise InvalidCameras(str(path), expected=FORMATS, got="no such file or folder")
    try:
        with open_regular(path) as handle:
            start = handle.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")
        if zipfile.is_zipfile(path):
            return _from_zip(path, camera_source(path).frame, choosing=choosing, views=views)
    except OSError as error:
        got = f"a file that does not open ({error.strerror})"
        raise InvalidCameras(str(path), expected=FORMATS, got=got) from None
    source = camera_source(path)
    if source.model is None and start[:1] not in (b"[", b"{"):
        got = f"a file that begins with {start[:8]!r}" if start else "an empty file"
        hint = "of a COLMAP model give the folder, or a zip of its cameras.* and images.* together"
        raise InvalidCameras(str(path), expected=FORMATS, got=got, hint=hint)
    return source.read()


def camera_source(path: Path, views: Collection[str] = ()) -> CameraSource:
    """Return the source of a path: in a folder a complete model, else a JSON file, else an incomplete model.

    A ``FRAME_FILE`` applies from the folder, from beside the file, and from a model's folder up to its scene's. Where
    there is one, a transforms.json is preferred, as nerfstudio trains on its intrinsics. nerfstudio's camera export
    is preferred to all, as it is in the frame of the splats.

    Args:
        path: the folder or file.
        views: as `read_cameras` has them.
    """
    if path.is_dir():
        return _source_in_folder(path, views)
    return _of_model(path.parent) if path.name in MODEL_FILES and has_model(path.parent) else _of_document(path)


def camera_files(path: Path | str) -> list[Path]:
    """Return the files that `read_cameras` reads of a path, also those that do not exist."""
    return camera_source(Path(path)).files


def _source_in_folder(path: Path, views: Collection[str]) -> CameraSource:
    documents = [path / name for name in JSON_FILES if (path / name).is_file()]
    export = path / TRAINED_ON
    if export in documents and _begins_a_list(export):
        return _of_document(export, folder=path)
    if (path / TRANSFORMS) in documents and _frame_in(path):
        return _of_document(path / TRANSFORMS)
    models = _usual_models(path)
    if models:
        model, warnings = choose_model(models, path, views)
        return replace(_of_model(model), warnings=warnings)
    halves = [path / name for name in MODEL_FOLDERS if has_model(path / name)]
    if halves and not documents:
        return _of_model(halves[0])
    return _of_document(documents[0], folder=path) if documents else CameraSource(frame=_frame_in(path))


def other_models(path: Path) -> list[str]:
    """Return the folders of COLMAP models in a folder or a zip that are of another reconstruction than the one read.

    The warnings of the cameras name models of the same reconstruction (`choose_model`).
    """
    if path.is_dir():
        chosen_model = camera_source(path).model
        return (
            []
            if chosen_model is None
            else [
                str(model) for model in _models_below(path) if not _is_same_reconstruction(path / model, chosen_model)
            ]
        )
    if not zipfile.is_zipfile(path):
        return []
    with open_zip(path) as archive:
        first, *remaining = _complete_models(_files(archive)) or [PurePosixPath()]
    return [str(model) for model in remaining if not _is_same_reconstruction(model, first)]


def choose_model(models: Sequence[Path], scene: Path, views: Collection[str]) -> tuple[Path, tuple[str, ...]]:
    """Choose one of COLMAP's several models, and return it with a warning that names the others and their sizes.

    Args:
        models: folders, in the order of COLMAP's numbers; the first of equal ones wins.
        scene: the folder that names are relative to.
        views: names of views of features, which the model should have cameras for.
    """
    if len(models) == 1:
        return models[0], ()
    names: dict[Path, list[str]] = {model: [] for model in models}
    for model in models:
        with suppress(InvalidCameras):  # the error of the chosen model is raised when it is read
            names[model] = read_image_names(model)
    paired = {model: len(cameras_of_views(views, names[model])) for model in models}
    best = max(models, key=lambda model: (paired[model], len(names[model])))

    def describe_model(model: Path) -> str:
        cameras = f", cameras of {paired[model]} of the {len(views)} views" if views else ""
        return f"{model.relative_to(scene).as_posix()} ({len(names[model])} images{cameras})"

    descriptions = [describe_model(model) for model in models if model != best]
    suffix = f" and {len(descriptions) - MAX_LISTED} more" if len(descriptions) > MAX_LISTED else ""
    were = "was not" if len(descriptions) == 1 else "were not"
    frames = "COLMAP's models have a frame each, so the splats must be those of the one that was read"
    return best, (
        f"{describe_model(best)} was read, and {', '.join(descriptions[:MAX_LISTED])}{suffix} {were}: {frames}",
    )


def _better_models(model: Path, cameras: Collection[str], views: Collection[str]) -> tuple[str, ...]:
    """Warn if another COLMAP model of the scene has cameras of more views than the one that the caller named."""
    paired = len(cameras_of_views(views, cameras))
    if paired == len(views):
        return ()
    folder = Path(os.path.abspath(model))
    scene, alternatives = _scene_of(folder), list[str]()
    for other in _models_below(scene)[:MAX_MODELS]:
        if scene / other == folder:
            continue
        with suppress(InvalidCameras):
            names = read_image_names(scene / other)
            if (count := len(cameras_of_views(views, names))) > paired:
                alternatives.append(f"{other} ({len(names)} images) has cameras of {count}")
    if not alternatives:
        return ()
    name = folder.relative_to(scene).as_posix()
    summary = f"{name} was read, and has cameras of {paired} of the {len(views)} views"
    listing = ", ".join(alternatives[:MAX_LISTED])
    return (f"{summary}; {listing}: the splats must be those of the one that is read",)


def has_nerfstudio_beside(path: Path) -> bool:
    """Return True if poses in nerfstudio's frame lie beside the COLMAP model read from a folder, file or zip."""
    source = camera_source(path)
    if source.model is not None:
        candidates = (folder / TRANSFORMS for folder in _up_to_scene(source.model))
        return any(_is_of_nerfstudio(document) for document in candidates if document.is_file())
    if source.file is None or not zipfile.is_zipfile(source.file):
        return False
    with open_zip(source.file) as archive:
        files = _files(archive)
        return bool(_complete_models(files) and _names_matching(files, lambda name: name == TRANSFORMS))


def _is_of_nerfstudio(document: Path) -> bool:
    """Return True if a transforms.json parses and was written by nerfstudio's own converter."""
    try:
        content = read_json(document)
    except InvalidCameras:
        return False
    return isinstance(content, dict) and any(key in content for key in OF_NERFSTUDIO)


# ---- folders


def _from_folder(folder: Path, *, choosing: bool, views: Collection[str]) -> Cameras:
    source = camera_source(folder, views)
    if source.model is None and source.file is None:
        candidates = [folder / model for model in _models_below(folder)] + sorted(folder.glob("transforms*.json"))
        hint = (
            f"name one of the models or files, such as {' or '.join(map(str, candidates[:2]))}" if candidates else ""
        )
        got = "a folder without any of them" + (" at the usual places" if candidates else "")
        raise InvalidCameras(str(folder), expected=FORMATS, got=got, hint=hint)
    cameras = source.read()
    if source.model is not None and not source.warnings:
        cameras.warnings += _better_models(source.model, cameras, views)
    if choosing and source.model is not None and cameras.distorted:
        candidates = [folder / model for model in _models_below(folder) if folder / model != source.model]
        straight = [str(model) for model in candidates if _is_undistorted(model)]
        _refuse_both(str(folder), str(source.model), straight, "name the one")
    return cameras


def _is_undistorted(model: Path) -> bool:
    """Return True if a folder has a valid model whose cameras are all pinholes."""
    try:
        return not read_colmap(model).distorted
    except InvalidCameras:
        return False


def _refuse_both(source: str, distorted: str, undistorted: list[str], choose: str) -> None:
    """Refuse the distorted model that was read if undistorted ones lie beside it: the caller must choose."""
    if undistorted:
        got = f"distorted ones in {distorted} and undistorted ones in {undistorted[0]}"
        hint = f"{choose} whose photos the features were made of"
        raise InvalidCameras(source, expected="distorted or undistorted cameras, not both", got=got, hint=hint)


def _of_document(path: Path, folder: Path | None = None) -> CameraSource:
    """Return the source of a JSON file or zip; if the caller named its ``folder``, warn of others in it."""
    data = path.with_name(TRANSFORMS)
    may_export = path != data and path.name.startswith("transforms") and _begins_a_list(path)
    models = _usual_models(path.parent) if may_export and not data.is_file() else []
    if models:
        data = choose_model(models, path.parent, ())[0]
    siblings = (
        sorted(other.name for other in folder.glob("transforms*.json") if other not in (path, data)) if folder else []
    )
    file_name, *unread = [path.name, *siblings]
    warning = f"{file_name} was read, and {', '.join(unread)} not: name a file to read that one" if unread else ""
    return CameraSource(
        file=path,
        frame=_frame_in(path.parent),
        data=data if may_export and (models or data.is_file()) else None,
        warnings=(warning,) if warning and file_name != TRANSFORMS else (),
    )


def _begins_a_list(path: Path) -> bool:
    """Return True if a file begins as a JSON list, as camera exports do and a transforms.json does not."""
    with suppress(OSError), path.open("rb") as handle:
        return handle.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")[:1] == b"["
    return False


def _usual_models(scene: Path) -> list[Path]:
    """Return the complete models at the first of the usual places that has any, in the order of their numbers."""
    for place in MODEL_FOLDERS:
        parts = _split_at_number(PurePosixPath(place))
        if parts is None:
            models = [scene / place] if is_whole(scene / place) else []
        else:
            above, inner = parts
            folders = _numbered_in(scene / above) if above.parts or is_whole(scene / place) else []
            models = [folder / inner for folder in folders if is_whole(folder / inner)]
        if models:
            return models
    return []


def _numbered_in(folder: Path) -> list[Path]:
    """Return the folders in a folder whose names are numbers, sorted by these."""
    inner = [path for path in folder.iterdir() if path.name.isdecimal() and path.is_dir()] if folder.is_dir() else []
    return sorted(inner, key=lambda path: int(path.name))


def _split_at_number(model: P) -> tuple[P, P] | None:
    """Split the path of a numbered model into the folder of the numbers and the path below; None without a number."""
    parts = model.parts
    for last in (1, 2):  # sparse/0, dense/0/sparse
        if len(parts) >= last and parts[-last].isdecimal() and (last == 1 or parts[-1] == "sparse"):
            cut = len(parts) - last
            return type(model)(*parts[:cut]), type(model)(*parts[cut + 1 :])
    return None


def _is_same_reconstruction(model: P, reference: P) -> bool:
    """Return True if two models are equal, or of one reconstruction: their paths differ by COLMAP's number alone."""
    return model == reference or (_split_at_number(model) or 0) == (_split_at_number(reference) or 1)


def _of_model(model: Path) -> CameraSource:
    frames = filter(None, map(_frame_in, _up_to_scene(model)))
    return CameraSource(model=model, frame=next(frames, None))


def _up_to_scene(model: Path) -> list[Path]:
    """Return the folders from a model's up to its scene's."""
    folder = Path(os.path.abspath(model))  # links are not resolved: files beside the link count
    return [folder, *(parent for parent in folder.parents if parent.is_relative_to(_scene_of(folder)))]


def _frame_in(folder: Path) -> Path | None:
    """Return the ``FRAME_FILE`` in a folder; None if there is none.

    Raises:
        InvalidCameras: there is something else of that name, such as a broken link.
    """
    path = folder / FRAME_FILE
    if path.is_file():
        return path
    if os.path.lexists(path):
        got = "a broken link" if path.is_symlink() else "no regular file"
        raise InvalidCameras(str(path), expected="a file", got=got, hint="copy the file itself, or remove it")
    return None


def _models_below(folder: Path) -> list[PurePosixPath]:
    """Return folders with complete models below one, relative to it, in the order of ``_preference``.

    Hidden folders, links and deep levels are left out, so that a folder of many scenes is searched fast.
    """
    names: list[str] = []
    for parent, inner, files in islice(os.walk(folder), MAX_FOLDERS):
        relative = Path(parent).relative_to(folder)
        names += [(relative / name).as_posix() for name in files if name in MODEL_FILES]
        inner[:] = [name for name in sorted(inner) if len(relative.parts) < DEPTH and not is_system_file(Path(name))]
    return _complete_models(names)


def _complete_models(names: Iterable[str]) -> list[PurePosixPath]:
    """Return the folders with both files of a model among names of files, the preferred first."""
    paths = {PurePosixPath(name) for name in names}
    folders = {
        path.parent
        for path in paths
        if path.stem == "cameras" and path.with_stem("images") in paths and path.name in MODEL_FILES
    }
    return sorted(folders, key=_preference)


def _preference(model: PurePosixPath) -> tuple[bool, int, str, int, int]:
    """Return the sort key of models: as if folders were opened as scenes one by one, the outermost first.

    So the first model of a zip is the one that is read from the same files in a folder. Models in a folder
    ``distorted`` come last: 3DGS's ``convert.py`` keeps the input of its undistortion there.
    """
    scene = _scene_of(model)
    place = MODEL_FOLDERS.index(str(_at_nought(model).relative_to(scene)))
    number = int("".join(filter(str.isdecimal, model.relative_to(scene).as_posix())) or 0)
    return "distorted" in model.parts, len(scene.parts), str(scene), place, number


def _scene_of(model: P) -> P:
    """Return the outermost folder in which a model has one of the usual places; its own folder at least."""
    places, parts = [PurePosixPath(place).parts for place in MODEL_FOLDERS], _at_nought(model).parts
    cut = max(len(place) for place in places if parts[len(parts) - len(place) :] == place)
    return type(model)(*model.parts[: len(model.parts) - cut])


def _at_nought(model: P) -> P:
    """Return the path with COLMAP's number of the model replaced by 0; a folder that is a mere number stays."""
    above, inner = _split_at_number(model) or (None, None)
    if above is None or inner is None or (above.name != "sparse" and not inner.parts):
        return model
    return above / "0" / inner


# ---- zips


def _from_zip(path: Path, frame_file: Path | None, *, choosing: bool, views: Collection[str]) -> Cameras:
    """Read the cameras of the preferred model in a zip; with a ``FRAME_FILE`` in or beside it, a transforms.json."""
    try:
        archive = open_zip(path)
    except BROKEN_ZIP as error:
        raise _broken_zip(path, error) from None
    with archive, scratch_folder("splatlift-") as root:
        names = _unzip(archive, path, root)
        try:
            source = _source_in_zip(names, root, path, frame_file, views)
            if source.file is not None:
                inner = source.file.parent.relative_to(root).as_posix()
                source = replace(source, photos=zipfile.Path(archive, "" if inner == "." else f"{inner}/"))
            cameras = source.read()
        except InvalidCameras as error:
            argument, got, hint = (
                text.replace(str(root), str(path)) for text in (error.argument, error.got, error.hint)
            )
            raise InvalidCameras(argument, expected=error.expected, got=got, hint=hint) from None
        if choosing and source.model is not None and cameras.distorted:
            model_folder = source.model.relative_to(root)
            candidates = [model for model in _complete_models(names)[:MAX_MODELS] if root / model != source.model]
            straight = [str(model) for model in candidates if _is_undistorted(root / model)]
            _refuse_both(str(path), str(model_folder), straight, "zip the one alone")
    return cameras


def _source_in_zip(
    names: list[str], root: Path, path: Path, frame_file: Path | None, views: Collection[str]
) -> CameraSource:
    """Return the source of a zip whose camera files lie unzipped in ``root``, at any depth."""
    models, frames = _complete_models(names), _names_matching(names, lambda name: name == FRAME_FILE)
    transforms = _names_matching(names, _is_transforms)
    exports = [name for name in transforms if _begins_a_list(root / name)]
    if exports:
        return _of_document(root / _train_first(exports), folder=root / PurePosixPath(exports[0]).parent)
    documents = [name for name in transforms if PurePosixPath(name).name == TRANSFORMS] or transforms
    if documents and (frames or frame_file):
        frame = root / _require_one(frames, FRAME_FILE, path) if frames else frame_file
        return CameraSource(file=root / _require_one(documents, TRANSFORMS, path), frame=frame)
    if not models and documents:
        first = _train_first(documents)
        siblings = [name for name in documents if PurePosixPath(name).parent == PurePosixPath(first).parent]
        if len(siblings) < len(documents):
            _require_one(documents, TRANSFORMS, path)
        return _of_document(root / first, folder=(root / first).parent)
    if not models:
        got, hint = _what_else(names)
        expected = "a COLMAP model (cameras and images, .bin or .txt) in the zip"
        raise InvalidCameras(str(path), expected=expected, got=got, hint=hint)
    above = [name for name in frames if models[0].is_relative_to(PurePosixPath(name).parent)]
    if frames and not above and len({_scene_of(model) for model in models}) > 1:
        got = f"one of {PurePosixPath(frames[0]).parent} and the model {models[0]}"
        raise InvalidCameras(str(path), expected=f"the {FRAME_FILE} of the model", got=got, hint=ONE_RUN)
    frames = above[-1:] or frames
    frame = root / _require_one(frames, FRAME_FILE, path) if frames else frame_file
    parts = [root / model for model in models if _is_same_reconstruction(model, models[0])]
    model, warnings = choose_model(parts, root, views)
    return CameraSource(model=model, frame=frame, warnings=warnings)


def _train_first(documents: list[str]) -> str:
    """Return the one of several documents of cameras that trainers train on."""
    return next((name for name in documents if PurePosixPath(name).name == TRAINED_ON), documents[0])


def _files(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the files by their normalised names, with slashes: some programs write backslashes or ``./``.

    Hidden files and folders are left out, as in folders.
    """
    files = {}
    for member in archive.infolist():
        if member.is_dir():
            continue
        parts = PurePosixPath(member.filename.replace("\\", "/")).parts
        inner = [part for part in parts if part not in ("/", "..")]
        if inner and not is_system_file(PurePosixPath(*inner)):
            files["/".join(inner)] = member
    return files


def _unzip(archive: zipfile.ZipFile, path: Path, folder: Path) -> list[str]:
    """Unzip the camera files to ``folder``, and return the names of all files in the zip."""
    count, budget = len(archive.infolist()), MAX_UNZIPPED_BYTES
    if count > MAX_ZIP_MEMBERS:
        raise InvalidCameras(str(path), expected=f"at most {MAX_ZIP_MEMBERS} files", got=str(count))
    files = _files(archive)
    try:
        for name, member in files.items():
            last = PurePosixPath(name).name
            if last in (*MODEL_FILES, FRAME_FILE) or _is_transforms(last):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                budget -= _unzip_one(archive, member, folder / name, budget)
    except BROKEN_ZIP as error:
        raise _broken_zip(path, error) from None
    return list(files)


def _broken_zip(path: Path, error: Exception) -> InvalidCameras | Unavailable:
    """Return the error of a zip that does not open, or does not fit on the disk."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        expected, hint = f"free space in {tempfile.gettempdir()} for the zip's files", "free some, or set TMPDIR"
        return Unavailable(str(path), expected=expected, got="a full disk", hint=hint)
    got = f"one that does not open ({str(error)[:120]})"
    return InvalidCameras(str(path), expected="a zip of a COLMAP sparse model", got=got)


def _unzip_one(archive: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path, budget: int) -> int:
    size = 0
    with archive.open(member) as source, target.open("wb") as sink:
        while block := source.read(min(1 << 20, budget - size + 1)):
            size += len(block)
            if size > budget:
                limit = f"at most {MAX_UNZIPPED_BYTES} bytes unzipped"
                raise InvalidCameras(
                    member.filename, expected=limit, got="more", hint="leave the points out of the zip"
                )
            sink.write(block)
    return size


def _names_matching(names: Iterable[str], fits: Callable[[str], bool]) -> list[str]:
    """Return the names whose last part fits, the outermost first."""
    matches = [name for name in names if fits(PurePosixPath(name).name)]
    return sorted(matches, key=lambda name: (name.count("/"), name))


def _is_transforms(name: str) -> bool:
    return name.startswith("transforms") and name.endswith(".json")


def _require_one(matches: list[str], name: str, path: Path) -> str:
    """Return the only one of these files.

    Raises:
        InvalidCameras: there are several.
    """
    if len(matches) > 1:
        raise InvalidCameras(str(path), expected=f"one {name}", got=" and ".join(matches[:2]), hint=ONE_RUN)
    return matches[0]


def _what_else(names: Iterable[str]) -> tuple[str, str]:
    """Describe a zip without a complete model, and advise what to do."""
    for name in sorted(names):
        file = PurePosixPath(name).name
        if file in MODEL_FILES:
            parts = ("cameras", "images") if file.startswith("cameras") else ("images", "cameras")
            return f"{name!r} without {file.replace(*parts)!r}", "zip both files together"
        if file == "cameras.json":
            return f"{name!r}", "give the JSON file itself"
    return "none", "zip the folder that has cameras.bin and images.bin"
