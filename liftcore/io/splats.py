"""Splat files: which format one is of, told by its content, and reading and copying it.

All have a row a splat, and ours are the file's rows in their order. What is of none of these formats is refused with
what it is and what to do.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.io import ply
from liftcore.io.checkpoint import EXPORT_PLY, read_checkpoint
from liftcore.io.compressed_ply import read_compressed_ply
from liftcore.io.files import BROKEN_ZIP, LFS_HINT, LFS_POINTER
from liftcore.io.quantised import Fields
from liftcore.io.remote import local_path
from liftcore.io.sog import META, read_sog
from liftcore.io.splat import looks_like_splat, read_splat, splat_blocks
from liftcore.io.spz import begins_like_spz, read_spz, spz_blocks
from liftcore.scene.harmonics import constant_terms
from liftcore.scene.kernel import Kernel, kernel_named

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats


class SplatFormat(StrEnum):
    """A format that is read, as people call it."""

    PLY = "PLY"  # of every dialect
    COMPRESSED_PLY = "compressed PLY"
    SPLAT = ".splat"
    SPZ = ".spz"
    SOG = ".sog"
    CHECKPOINT = "checkpoint"  # of gsplat or nerfstudio: a pickle, if only of tensors


SUFFIX = {
    SplatFormat.PLY: ".ply",
    SplatFormat.COMPRESSED_PLY: ".ply",
    SplatFormat.SPLAT: ".splat",
    SplatFormat.SPZ: ".spz",
    SplatFormat.SOG: ".sog",
    SplatFormat.CHECKPOINT: ".pt",
}
PICKLED = (".pt", ".pth", ".ckpt", ".pkl")
SUFFIXES = frozenset([*SUFFIX.values(), *PICKLED, ".ksplat"])
EXPECTED = "splats as PLY, compressed PLY, .splat, .spz, .sog or a checkpoint"
CONVERT = "convert it with PlayCanvas's splat-transform: npx @playcanvas/splat-transform IN OUT.ply"
_READERS: dict[SplatFormat, Callable[..., Fields]] = {
    SplatFormat.COMPRESSED_PLY: read_compressed_ply,
    SplatFormat.SPLAT: read_splat,
    SplatFormat.SPZ: read_spz,
    SplatFormat.SOG: read_sog,
    SplatFormat.CHECKPOINT: read_checkpoint,
}
_WRITERS: dict[str, Callable[[Splats], Iterator[bytes]]] = {".splat": splat_blocks, ".spz": spz_blocks}
_WEB_PAGE = ("a web page", "the download went wrong: fetch the file itself")
_OTHERS = {  # by their first bytes
    LFS_POINTER: ("a Git LFS pointer, which stands for the file", LFS_HINT),
    b"\x1f\x8b": ("a gzip file", "unzip it, or upload it with the header 'Content-Encoding: gzip'"),
    b"PK\x03\x04": ("a zip", "unzip it and give the splats in it"),
    b"\x80": ("a Python pickle, which may run code when it is opened", EXPORT_PLY),
    b"\x93NUMPY": ("a NumPy array", "export the splats as PLY from the program that trained them"),
    b"<!doctype": _WEB_PAGE,
    b"<html": _WEB_PAGE,
}


def read_splats(path: Path | str, kernel: Kernel | str = "auto", *, colour: bool = True) -> Splats:
    """Read trained splats from a file of any `SplatFormat`, recognised by content.

    With the kernel ``auto`` the columns of a PLY tell it, and what else there is are 3D Gaussians. Without ``colour``
    neither colours nor what else a lift has no use for are read or allocated, and what comes cannot be written back.
    More of PLYs is in `liftcore.io.ply.read_ply`. Checkpoints are opened for tensors alone: no code of theirs runs.

    Raises:
        InvalidInput: it lies elsewhere (`io.remote`), and does not come.
        InvalidSplats: the file is malformed or of no such format, lacks a property of the kernel, or holds no splat
            of finite numbers.
    """
    path = local_path(path)
    found = format_of(path)
    with _naming(path):
        if found is SplatFormat.PLY:
            return ply.read_ply(path, kernel, colour=colour)
        chosen = Kernel.GAUSSIAN_3D if kernel == "auto" else kernel_named(kernel)
        require_kernel(path, chosen, str(path))
        from liftcore.scene.splats import Splats

        fields = _READERS[found](path, colour=colour)
        if chosen is Kernel.GAUSSIAN_2D:
            fields["log_scales"] = np.ascontiguousarray(fields["log_scales"][:, :2])
        return Splats(**fields, kernel=chosen)


def read_places(path: Path) -> np.ndarray:
    """[P, 3] f32, the means alone of a file that `read_splats` takes, in its frame and unit. Only checkpoints need
    torch for that, which takes a second to import. Places that are no number become the first that is.

    Raises:
        InvalidSplats: the file is of no format of splats.
    """
    found = format_of(path)
    places = ply.read_places(path) if found is SplatFormat.PLY else _READERS[found](path, colour=False)["means"]
    finite = np.isfinite(places).all(axis=1)
    if not finite.all():
        places[~finite] = places[finite.argmax()]
    return places


def format_of(path: Path) -> SplatFormat:
    """The format of a file, by its content.

    Raises:
        InvalidSplats: it is of none; the error says what it is, if that can be told.
    """
    if (path / META).is_file():
        return SplatFormat.SOG
    head, size = ply.read_head(path)
    suffix = path.suffix.lower()
    if head[:4] in (b"ply\n", b"ply\r"):
        first = head.partition(b"\nelement ")[2]
        return SplatFormat.COMPRESSED_PLY if first.startswith(b"chunk ") else SplatFormat.PLY
    if begins_like_spz(head):
        return SplatFormat.SPZ
    if head[:4] == b"PK\x03\x04" and (inner := _in_zip(path)):
        return inner
    known = _known_as(head)
    if suffix == ".splat" or (known is None and suffix != ".ksplat" and looks_like_splat(head, size)):
        return SplatFormat.SPLAT
    if suffix == ".ksplat":
        known = ("splats in GaussianSplats3D's .ksplat format", CONVERT)
    begins = f"a file that begins with {head[:8]!r}" if head else "an empty file"
    got, hint = known or (begins, f"{ply.EXPORT}; or {CONVERT}")
    raise InvalidSplats(str(path), expected=EXPECTED, got=got, hint=hint)


def require_kernel(path: Path, kernel: Kernel, source: str) -> None:
    """Refuse a kernel that a file lacks a property of, by its header alone.

    Raises:
        InvalidSplats: it does; ``source`` is named.
    """
    found = format_of(path)
    if found is SplatFormat.PLY:
        ply.model_slots(ply.read_header(path).names, kernel, source)
    elif kernel is Kernel.BETA:
        raise InvalidSplats(source, expected="the property 'beta' of a dbs splat", got=f"{found}, which has none")


def some_rows(path: Path, kept: np.ndarray, suffix: str = ".ply") -> Iterator[bytes]:
    """Some rows of a file, in its order, as the bytes of a PLY, a ``.splat`` or an ``.spz`` in blocks.

    A PLY gives its own bytes to one (`liftcore.io.ply.some_rows`); of another format comes a PLY of 3DGS.

    Args:
        path: the file. kept: [P] bool, the rows to keep. suffix: of what is written; a PLY where it is unknown.

    Raises:
        InvalidSplats: the file is malformed, or has another number of splats.
    """
    write = _WRITERS.get(suffix, ply.ply_blocks)
    if write is ply.ply_blocks and format_of(path) is SplatFormat.PLY:
        return ply.some_rows(path, kept)
    splats = _of_count(path, len(kept))
    import torch

    rows = torch.from_numpy(np.flatnonzero(kept))
    fields = ("means", "quats", "log_scales", "opacity_logits", "beta", "sh", "sb_params")
    values = {name: getattr(splats, name)[rows] for name in fields if getattr(splats, name) is not None}
    return write(replace(splats, **values, extras={}, layout=(), header=()))


def with_columns(path: Path, columns: Mapping[str, np.ndarray]) -> Iterator[bytes]:
    """A file with more properties a splat, as the bytes of a PLY in blocks; those that it has are replaced.

    Args:
        path: the file. columns: name -> [P] i32 or f32.

    Raises:
        InvalidSplats: the file is malformed, or has another number of splats.
    """
    if format_of(path) is SplatFormat.PLY:
        return ply.with_columns(path, columns)
    import torch

    splats = _of_count(path, len(next(iter(columns.values()))))
    return ply.ply_blocks(replace(splats, extras={name: torch.from_numpy(told) for name, told in columns.items()}))


def recoloured(path: Path, colours: np.ndarray) -> Iterator[bytes]:
    """A file with one colour a splat, the same from everywhere, as the bytes of a PLY in blocks.

    All else of a PLY is of its own bytes (`liftcore.io.ply.recoloured`); another format becomes a PLY of 3DGS.

    Args:
        path: the file. colours: [P, 3] u8 sRGB.

    Raises:
        InvalidSplats: the file is malformed, has another number of splats, or is a PLY that holds no colours.
    """
    terms = constant_terms(colours / 255).astype(np.float32)
    if format_of(path) is SplatFormat.PLY:
        return ply.recoloured(path, terms)
    return ply.ply_blocks(replace(_of_count(path, len(terms), colour=False), sh=terms[:, None]))


def is_splats(path: Path) -> bool:
    """Whether a file begins like splats, or is named like them, if only to be refused."""
    if path.suffix.lower() in SUFFIXES:
        return True
    try:
        return (path.is_file() or (path / META).is_file()) and bool(format_of(path))
    except InvalidSplats:
        return False


def _in_zip(path: Path) -> SplatFormat | None:
    """What splats a zip holds, by the names of its members."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except BROKEN_ZIP:
        return None
    if META in names:
        return SplatFormat.SOG
    return SplatFormat.CHECKPOINT if any(name.endswith("/data.pkl") for name in names) else None


def _known_as(head: bytes) -> tuple[str, str] | None:
    """What a file of no splats is, and what to do."""
    start = head[:64].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    return next(
        (told for first, told in _OTHERS.items() if start.startswith(first.lower()) or head.startswith(first)), None
    )


def _of_count(path: Path, count: int, *, colour: bool = True) -> Splats:
    splats = read_splats(path, colour=colour)
    if splats.count != count:
        raise InvalidSplats(str(path), expected=f"{count} splats, as many as were lifted", got=str(splats.count))
    return splats


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
