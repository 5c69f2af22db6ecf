"""Splat files: which format one is of, told by its content, and reading and copying it.

| format | begins with |
|---|---|
| PLY of every dialect (`liftcore.io.ply`) | ``ply`` |

What is none of these is refused with what it is and what to do.
"""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from liftcore.errors import InvalidSplats
from liftcore.io import ply
from liftcore.io.files import LFS_HINT, LFS_POINTER
from liftcore.io.ply import CONVERT
from liftcore.scene.kernel import Kernel

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np

    from liftcore.scene.splats import Splats

HEAD_BYTES = 64
EXPORT_PLY = (
    "export the splats as PLY from the program that trained them (nerfstudio: ns-export gaussian-splat; gsplat's "
    "simple_trainer: --save-ply)"
)
PICKLED = (".pt", ".pth", ".ckpt", ".pkl")
OTHER_FORMATS = {
    ".splat": "splats in antimatter15's .splat format",
    ".ksplat": "splats in GaussianSplats3D's .ksplat format",
    ".spz": "splats in Niantic's .spz format",
    ".sog": "splats in PlayCanvas's .sog format",
}
SUFFIXES = (".ply", *PICKLED, *OTHER_FORMATS)
_WEB_PAGE = ("a web page", "the download went wrong: fetch the file itself")
_BY_FIRST_BYTES = {
    LFS_POINTER: ("a Git LFS pointer, which stands for the file", LFS_HINT),
    b"NGSP": (OTHER_FORMATS[".spz"], CONVERT),
    b"\x1f\x8b": ("a gzip file", "unzip it, or upload it with the header 'Content-Encoding: gzip'"),
    b"PK\x03\x04": ("a zip", "unzip it and give the PLY in it"),
    b"\x93NUMPY": ("a NumPy array", "export the splats as PLY from the program that trained them"),
    b"<!doctype": _WEB_PAGE,
    b"<html": _WEB_PAGE,
}


def read_splats(path: Path | str, kernel: Kernel | str = "auto", *, colour: bool = True) -> Splats:
    """Read trained splats from a file of any format of the table above.

    With the kernel ``auto`` the file tells it. Without ``colour`` neither colours nor what else a lift has no use for
    are read or allocated, and what comes cannot be written back. Of a PLY `liftcore.io.ply.read_ply` has the rest.

    Raises:
        InvalidSplats: the file is malformed or of no such format, lacks a property of the kernel, or holds NaN or no
            splats.
    """
    path = Path(path)
    _require_ply(path)
    with _naming(path):
        return ply.read_ply(path, kernel, colour=colour)


def require_kernel(path: Path, kernel: Kernel, source: str) -> None:
    """Refuse a kernel that a file lacks a property of, by its header alone.

    Raises:
        InvalidSplats: it does; ``source`` is named.
    """
    ply.model_slots(ply.read_header(path).names, kernel, source)


def some_rows(path: Path, kept: np.ndarray) -> Iterator[bytes]:
    """The file with some of its rows alone (`liftcore.io.ply.some_rows`); ``kept`` is [P] bool."""
    return ply.some_rows(path, kept)


def recoloured(path: Path, colours: np.ndarray) -> Iterator[bytes]:
    """The file with a colour of each splat's own (`liftcore.io.ply.recoloured`); ``colours`` are [P, 3] f32."""
    return ply.recoloured(path, colours)


def is_splats(path: Path) -> bool:
    """Whether the file begins like splats, or is named like them or like a checkpoint, if only to be refused."""
    if path.suffix.lower() in SUFFIXES:
        return True
    return path.is_file() and (_head(path).startswith((b"ply\n", b"ply\r", b"NGSP")))


def _head(path: Path) -> bytes:
    """The first bytes.

    Raises:
        InvalidSplats: the file does not open.
    """
    try:
        with path.open("rb") as handle:
            return handle.read(HEAD_BYTES)
    except OSError as error:
        got = f"one that does not open ({error.strerror})"
        raise InvalidSplats(str(path), expected="a splat file", got=got) from None


def _require_ply(path: Path) -> None:
    suffix = path.suffix.lower()
    if suffix in PICKLED and not (path.is_file() and _head(path).startswith(LFS_POINTER)):
        got = "a Python pickle, which may run code when it is opened"
        raise InvalidSplats(str(path), expected="a PLY file", got=got, hint=EXPORT_PLY)
    head = _head(path)
    if head[:4] in (b"ply\n", b"ply\r"):
        return
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n").lower() if head[:1] != b"\x1f" else head
    begins = f"a file that begins with {head[:8]!r}" if head else "an empty file"
    got, hint = next(
        (told for first, told in _BY_FIRST_BYTES.items() if start.startswith(first.lower())),
        (begins, f"{ply.EXPORT}; if it is a .splat or a .ksplat, {CONVERT}"),
    )
    if suffix in OTHER_FORMATS and got in (begins, "a gzip file", "a zip"):  # .spz and .sog are such files inside
        got, hint = OTHER_FORMATS[suffix], CONVERT
    raise InvalidSplats(str(path), expected="a PLY file (first line 'ply')", got=got, hint=hint)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Name the file in what the splats themselves find wrong."""
    try:
        yield
    except InvalidSplats as error:
        if str(path) in error.argument:
            raise
        argument = f"{path} {error.argument}"
        raise InvalidSplats(argument, expected=error.expected, got=error.got, hint=error.hint) from None
