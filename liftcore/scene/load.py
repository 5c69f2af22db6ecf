"""Open scenes by what is in their files, whatever they are called."""

from __future__ import annotations

import tempfile
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from liftcore.errors import InvalidCameras, InvalidSplats
from liftcore.scene.colmap import has_model, model_files, read_colmap
from liftcore.scene.foreign import LFS_POINTER
from liftcore.scene.inria import parse_inria
from liftcore.scene.json_file import read_json
from liftcore.scene.transforms import parse_transforms

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from liftcore.scene.cameras import Cameras
    from liftcore.scene.splats import Kernel, Splats

MAX_UNZIPPED_BYTES = 512 * 1024 * 1024
MAX_ZIP_MEMBERS = 100_000
MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0", "0")
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
            return _from_zip(path)
        with path.open("rb") as handle:
            start = handle.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")
    except OSError as error:
        got = f"a file that does not open ({error.strerror})"
        raise InvalidCameras(str(path), expected=CAMERA_FORMATS, got=got) from None
    if path.name in ("cameras.bin", "cameras.txt", "images.bin", "images.txt") and has_model(path.parent):
        return read_colmap(path.parent)
    if start[:1] not in (b"[", b"{"):
        got = f"a file that begins with {start[:8]!r}" if start else "an empty file"
        raise InvalidCameras(str(path), expected=CAMERA_FORMATS, got=got)
    return _from_json(path)


def camera_files(folder: Path) -> list[Path]:
    """The files of a folder that its cameras are read from."""
    for name in MODEL_FOLDERS:
        if has_model(folder / name):
            return model_files(folder / name)
    return [folder / name for name in JSON_FILES if (folder / name).is_file()][:1]


def other_models(path: Path) -> list[str]:
    """COLMAP models in a folder or a zip beside the one that its cameras are read from, by their folders.

    COLMAP writes several where photos did not all hang together, each in a frame of its own.
    """
    if path.is_dir():
        files = camera_files(path)
        read = files[0].parent if len(files) > 1 else None
        beside = [] if read is None or read == path else sorted(read.parent.iterdir())
        return [str(folder.relative_to(path)) for folder in beside if folder != read and has_model(folder)]
    if not zipfile.is_zipfile(path):
        return []
    with zipfile.ZipFile(path) as archive:
        roots = list(dict.fromkeys(root for root, _ in _model_roots(archive.namelist())))
        return [str(root) for root in roots[1:]]


def _from_folder(folder: Path) -> Cameras:
    files = camera_files(folder)
    if len(files) == 1:
        return _from_json(files[0])
    if files:
        return read_colmap(files[0].parent)
    raise InvalidCameras(str(folder), expected=CAMERA_FORMATS, got="a folder without any of them")


def _from_json(path: Path) -> Cameras:
    document = read_json(path)
    if isinstance(document, list):
        return parse_inria(document, str(path))
    return parse_transforms(document, str(path))


def _from_zip(path: Path) -> Cameras:
    with tempfile.TemporaryDirectory(prefix="splatlift-") as folder:
        try:
            with zipfile.ZipFile(path) as archive:
                budget = MAX_UNZIPPED_BYTES
                for member in _model_members(archive, path):
                    # Only the last part of a member's name is used, and it is one of four.
                    target = Path(folder) / PurePosixPath(member.filename).name
                    budget -= _unzip(archive, member, target, budget)
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
            raise InvalidCameras(
                argument, expected=error.expected, got=error.got.replace(folder, str(path)), hint=error.hint
            ) from None


def _model_members(archive: zipfile.ZipFile, path: Path) -> Iterator[zipfile.ZipInfo]:
    """Cameras and images of the model nearest the root."""
    members = archive.infolist()
    if len(members) > MAX_ZIP_MEMBERS:
        raise InvalidCameras(str(path), expected=f"at most {MAX_ZIP_MEMBERS} files", got=str(len(members)))
    files = {member.filename: member for member in members if not member.is_dir()}
    for root, kind in _model_roots(files):
        yield from (files[name] for name in _model_names(root, kind))
        return
    expected = "a COLMAP model (cameras and images, .bin or .txt) in the zip"
    raise InvalidCameras(str(path), expected=expected, got="none")


def _model_roots(names: Iterable[str]) -> Iterator[tuple[PurePosixPath, str]]:
    """Folders that hold a whole model and of which kind, binary ones first, the one nearest the root first."""
    known = set(names)
    for kind in ("bin", "txt"):
        roots = {PurePosixPath(name).parent for name in known if PurePosixPath(name).name == f"cameras.{kind}"}
        for root in sorted(roots, key=lambda root: (len(root.parts), str(root))):
            if known.issuperset(_model_names(root, kind)):
                yield root, kind


def _model_names(root: PurePosixPath, kind: str) -> list[str]:
    return [str(root / f"{part}.{kind}") for part in ("cameras", "images")]


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
