"""Atomic writes of files, checks of outputs, files of the operating system beside others, and Git LFS."""

import errno
import lzma
import os
import secrets
import stat
import sys
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path, PurePath, PurePosixPath
from typing import IO

from liftcore.errors import InvalidCameras, InvalidInput, Unavailable, reading
from liftcore.runtime.arguments import as_list, as_path, check_choice

LFS_POINTER = b"version https://git-lfs.github.com/spec/"
# Errors that zipfile and its decompressors raise for a damaged file.
BROKEN_ZIP = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, OSError, RuntimeError, ValueError)
# Files of Windows, macOS and Synology, in lower case; their other files begin with a dot.
SYSTEM_FILES = frozenset((
    "thumbs.db", "ehthumbs.db", "desktop.ini", "__macosx", "@eadir", "$recycle.bin", "#recycle", "@recycle",
    "lost+found", "system volume information",
))  # fmt: skip
LFS_HINT = "run 'git lfs pull' in the repository where it lies"
OUTPUT_TYPES = {  # name, suffixes, and a word of the kind or name of a file that is replaced; "": of no known kind
    "splats": ("splats", (), "splats"),  # of `liftcore.io.formats`
    "ply": ("a PLY", (".ply",), "splats"),
    "png": ("a picture", (".png",), "a picture"),
    "npy": ("an array", (".npy",), "a NumPy array"),
    "lift": ("a lift", (".safetensors",), "lift"),
    "pack": ("a feature pack", (".safetensors",), "features"),
    "csv": ("a table", (".csv",), ""),
    "json": ("JSON", (".json",), "JSON"),
}
CONVERT_PLY = "write a .ply, and convert it: npx @playcanvas/splat-transform IN.ply OUT"


def first_bytes(head: bytes) -> str:
    """Return the first bytes of a file for a message: text in quotes, else hexadecimal numbers."""
    text = head[:8].decode("latin1")
    return repr(text) if text.isascii() and text.isprintable() else head[:8].hex(" ")


def is_system_file(path: PurePath) -> bool:
    """Return True if a relative path, or a folder in it, is hidden or of the system, such as ``__MACOSX/IMG.png``."""
    inner = (part for part in path.parts if part not in (".", ".."))
    return any(part.startswith((".", "~$")) or part.lower() in SYSTEM_FILES for part in inner)


def visible_files(folder: Path | str, pattern: str = "*") -> list[Path]:
    """Return the files of a folder that match a pattern, sorted, without those of `is_system_file`."""
    folder = Path(folder)
    files = (path for path in sorted(folder.glob(pattern)) if path.is_file())
    return [path for path in files if not is_system_file(path.relative_to(folder))]


def refuse_pointer(source: str, head: bytes) -> None:
    """Refuse a Git LFS pointer in place of a camera file."""
    if head.startswith(LFS_POINTER):
        got = "a Git LFS pointer, which stands for the file"
        raise InvalidCameras(source, expected="a camera file", got=got, hint=LFS_HINT)


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file to read: devices may have no end, and pipes may block forever."""
    waiting = getattr(os, "O_NONBLOCK", 0)  # Windows has no such pipes
    handle = open(path, "rb", opener=lambda name, flags: os.open(name, flags | waiting))  # noqa: SIM115 - its caller's
    if stat.S_ISREG(os.fstat(handle.fileno()).st_mode):
        return handle
    handle.close()
    raise OSError(errno.EINVAL, "no regular file", str(path))


def is_zip(path: Path) -> bool:
    """Return True for a zip. zipfile raises for one of several disks, as damaged bytes may say."""
    try:
        return zipfile.is_zipfile(path)
    except zipfile.BadZipFile:
        return False


def open_zip(path: Path) -> zipfile.ZipFile:
    """Open a zip that is a regular file."""
    open_regular(path).close()
    return zipfile.ZipFile(path)


def files_in_zip(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the files of a zip but the system's by names with slashes: some programs write backslashes or ``./``."""
    files = {}
    for member in archive.infolist():
        parts = PurePosixPath(member.filename.replace("\\", "/")).parts
        inner = [part for part in parts if part not in ("/", "..")]
        if inner and not member.is_dir() and not is_system_file(PurePosixPath(*inner)):
            files["/".join(inner)] = member
    return files


@contextmanager
def whole_file(path: Path | str) -> Iterator[IO[bytes]]:
    """Write ``path`` atomically, through a draft beside it: synced and renamed at the end, removed after an error."""
    path = Path(path)
    if path.is_dir():
        hint = "name a file within it"
        raise InvalidInput(str(path), expected="the path of a file to write", got="a folder there", hint=hint)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with draft.open("wb") as handle:
            yield handle
            handle.flush()
            os.fsync(handle.fileno())
        _replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def _replace(draft: Path, path: Path) -> None:
    try:
        draft.replace(path)
    except PermissionError as error:
        if sys.platform != "win32":
            raise
        expected = "a file that no program has open"
        hint = "close the lift or the program that reads it, or take another path"
        raise Unavailable(str(path), expected=expected, got=error.strerror or str(error), hint=hint) from error


# ---- outputs, checked before the work, so that no hour of it is lost to a misspelt name


def check_output(path: Path | str, inputs: Path | str | Iterable[Path | str], kind: str) -> Path | str:
    """Check that an output can be written, and is no folder, none of the inputs and no file of another kind.

    Args:
        inputs: files, and folders of cameras, that are read for it. kind: one of OUTPUT_TYPES.
    """
    from liftcore.io.formats import WRITERS
    from liftcore.io.kinds import identify

    check_choice("kind", kind, OUTPUT_TYPES)
    path = as_path(path, "output")
    label, suffixes, word = OUTPUT_TYPES[kind]
    suffixes = suffixes or (*WRITERS,)
    with reading("output", InvalidInput, "a file to write"), writing(path):
        if path.is_dir():
            raise ValueError(f"a file to write, got the folder {path}")
        if path.exists() and any(map(path.samefile, _files_of(map(Path, as_list(inputs))))):
            raise ValueError(f"another file than the inputs, got {path}")
        name = path.name.lower()
        if not name.endswith(suffixes) or name.endswith(".compressed.ply"):
            hint = CONVERT_PLY if ".ply" in suffixes else ""
            raise ValueError(f"a name of {label}, ending in {' or '.join(suffixes)}, got {path}; {hint}")
        if path.is_file() and path.stat().st_size:
            present = identify(path)
            if word not in (present.kind or present.name) or (not word and present.recognised):
                hint = "name another file, or remove that one first"
                raise ValueError(
                    f"a new file, or one of {label} to replace, got {path}, which is {present.name}; {hint}"
                )
        folder = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
        if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
            raise ValueError(f"a folder that can be written, got {folder}")
    return path


def _files_of(inputs: Iterable[Path]) -> list[Path]:
    """Return the existing files of inputs; of a folder of cameras those that are read."""
    from liftcore.io.cameras import camera_source

    files = (file for source in inputs for file in (camera_source(source).files if source.is_dir() else [source]))
    return [file for file in files if file.exists()]


@contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Name the output in errors of the operating system: a full disk, a folder without permission."""
    try:
        yield
    except OSError as error:
        got = f"{path} ({error.strerror or error})"
        raise InvalidInput("output", expected="a file that can be written", got=got) from None
