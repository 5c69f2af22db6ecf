"""Files that are written whole or not at all, and what a file is that should have been another."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

from liftcore.errors import InvalidCameras

LFS_POINTER = b"version https://git-lfs.github.com/spec/"
CONVERT = "convert it with PlayCanvas's splat-transform: npx @playcanvas/splat-transform IN OUT.ply"
SUFFIXES = {
    ".splat": "splats in antimatter15's .splat format",
    ".ksplat": "splats in GaussianSplats3D's .ksplat format",
    ".spz": "splats in Niantic's .spz format",
    ".sog": "splats in PlayCanvas's .sog format",
}


class Foreign(NamedTuple):
    """Another kind of file than a PLY."""

    what: str
    hint: str


_SPZ = Foreign(SUFFIXES[".spz"], CONVERT)
_WEB_PAGE = Foreign("a web page", "the download went wrong: fetch the file itself")
_BY_FIRST_BYTES = {
    LFS_POINTER: Foreign(
        "a Git LFS pointer, which stands for the file", "run 'git lfs pull' in the repository where it lies"
    ),
    b"NGSP": _SPZ,
    b"\x1f\x8b": Foreign("a gzip file", "unzip it, or upload it with the header 'Content-Encoding: gzip'"),
    b"PK\x03\x04": Foreign("a zip", "unzip it and give the PLY in it"),
    b"\x93NUMPY": Foreign("a NumPy array", "export the splats as PLY from the program that trained them"),
    b"<!doctype": _WEB_PAGE,
    b"<html": _WEB_PAGE,
}


def refuse_pointer(source: str, head: bytes) -> None:
    """Refuse a Git LFS pointer in a camera file's place.

    Raises:
        InvalidCameras: the first bytes are one's.
    """
    if head.startswith(LFS_POINTER):
        pointer = _BY_FIRST_BYTES[LFS_POINTER]
        raise InvalidCameras(source, expected="a camera file", got=pointer.what, hint=pointer.hint)


def foreign_format(head: bytes, suffix: str) -> Foreign | None:
    """What a file that is no PLY is, by its first bytes or its name's suffix; None when neither tells."""
    named = SUFFIXES.get(suffix.lower())
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n").lower() if head[:1] != b"\x1f" else head
    found = next((foreign for first, foreign in _BY_FIRST_BYTES.items() if start.startswith(first.lower())), None)
    if named and (found is None or found.what in ("a gzip file", "a zip")):  # .spz and .sog are such files inside
        return Foreign(named, CONVERT)
    return found


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
