"""Files that are written whole or not at all, and pointers of Git LFS that lie where a file should."""

import lzma
import os
import secrets
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from liftcore.errors import InvalidCameras

LFS_POINTER = b"version https://git-lfs.github.com/spec/"
# What zipfile and its decompressors raise of a broken or foreign file.
BROKEN_ZIP = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError),
    *(NotImplementedError, OSError, RuntimeError, ValueError),
)
LFS_HINT = "run 'git lfs pull' in the repository where it lies"


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
