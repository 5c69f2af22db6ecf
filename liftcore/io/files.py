"""Files that are written whole or not at all, what systems put beside files, and pointers of Git LFS."""

import lzma
import os
import secrets
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import IO

from liftcore.errors import InvalidCameras

LFS_POINTER = b"version https://git-lfs.github.com/spec/"
# What zipfile and its decompressors raise of a broken or foreign file.
BROKEN_ZIP = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError),
    *(NotImplementedError, OSError, RuntimeError, ValueError),
)
# What Windows, macOS and Synology put beside files, in lower case; all else that is theirs begins with a dot.
SYSTEM_FILES = frozenset(("thumbs.db", "ehthumbs.db", "desktop.ini", "__macosx", "@eadir", "$recycle.bin"))
LFS_HINT = "run 'git lfs pull' in the repository where it lies"


def is_system_file(path: PurePath) -> bool:
    """Return whether a path, relative to a folder, is hidden (``._IMG.png``) or what a system put there.

    It is too where a folder on the way is (``__MACOSX/IMG.png``).
    """
    inner = (part for part in path.parts if part not in (".", ".."))
    return any(part.startswith(".") or part.lower() in SYSTEM_FILES for part in inner)


def visible_files(folder: Path, pattern: str = "*") -> list[Path]:
    """The files of a folder that match a pattern, sorted, without those of `is_system_file`."""
    files = (path for path in sorted(folder.glob(pattern)) if path.is_file())
    return [path for path in files if not is_system_file(path.relative_to(folder))]


def refuse_pointer(source: str, head: bytes) -> None:
    """Refuse a Git LFS pointer in a camera file's place.

    Raises:
        InvalidCameras: the first bytes are one's.
    """
    if head.startswith(LFS_POINTER):
        got = "a Git LFS pointer, which stands for the file"
        raise InvalidCameras(source, expected="a camera file", got=got, hint=LFS_HINT)


@contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """Write ``path`` through a draft beside it: synced and renamed at the end, removed after an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with draft.open("wb") as handle:
            yield handle
            handle.flush()
            os.fsync(handle.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
