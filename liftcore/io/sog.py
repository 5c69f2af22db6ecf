"""PlayCanvas's ``.sog`` of version 2: a zip or folder of lossless WebP pictures, a pixel a splat, and ``meta.json``.

Unbundled, it is named by its folder or, as in other programs, by the ``meta.json`` in it.

Means have 16 bits an axis in two pictures, between bounds, of ``sign(v) log(1 + |v|)``; quaternions their smallest
three parts and 252 to 255 for the largest of w x y z; log scales and constant terms are rows of codebooks of 256;
opacities u8. Higher harmonics are rows of a palette, 64 entries a line of its picture. The writer sorts the rows;
ours are the file's.
"""

import io
import json
import zipfile
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from liftcore.io.files import BROKEN_ZIP, open_regular, open_zip
from liftcore.io.photos import open_image
from liftcore.io.quantised import MOST_GROWTH, Fields, decoded, logits, smallest_three
from liftcore.scene.render_mode import mode_of_word

META = "meta.json"
MAX_META_BYTES = 1 << 20
FIELD_BYTES, TERM_BYTES = 44, 12  # of a decoded splat without its colour, and of a row of harmonics
PALETTE_COLUMNS = 64
MAX_PALETTE = 1 << 16
SH_ROWS = (0, 3, 8, 15)  # higher harmonics by degree
MAX_TERM = 1e6  # of a codebook's or bound's numbers: exp of log scales apart, none has one
HINT = "export it again with SuperSplat or splat-transform, or as PLY"


def read_sog(path: Path, *, colour: bool) -> Fields:
    """Read the fields of a ``.sog`` file, of an unpacked folder, or of the ``meta.json`` in one."""
    try:
        if not is_bundled(path):
            meta = _meta_of(path)
            size = sum(file.stat().st_size for file in sog_files(path))
            return _Pictures(meta.parent, meta.name, size).fields(colour=colour)
        with open_zip(path) as archive:
            folder = zipfile.Path(archive, sog_folder(archive.namelist()) or "")
            return _Pictures(folder, META, path.stat().st_size).fields(colour=colour)
    except (*BROKEN_ZIP, AttributeError, LookupError, TypeError) as error:
        if ", got " in str(error):
            raise
        raise _broken("a .sog file", f"one that does not open ({error!r})") from None


def is_sog_document(document: Any) -> bool:
    """Return True if a JSON document is the ``meta.json`` of a SOG of any version."""
    parts = ("means", "scales", "quats")
    return isinstance(document, dict) and all(isinstance(document.get(part), dict) for part in parts)


def sog_folder(names: Iterable[str]) -> str | None:
    """Return the folder, with a slash if any, in which a zip of these names holds a SOG; None if in none."""
    members = set(names)
    if META in members:
        return ""
    folders = (name.removesuffix(META) for name in members if name.endswith(f"/{META}") and "__MACOSX/" not in name)
    return min((folder for folder in folders if f"{folder}means_l.webp" in members), default=None)


def sog_files(path: Path) -> list[Path]:
    """Return the files of an unbundled SOG, sorted: its ``meta.json`` and the pictures that this names."""
    meta = _meta_of(path)
    try:
        with open_regular(meta) as handle:
            document = json.loads(handle.read(MAX_META_BYTES))
    except (ValueError, RecursionError):
        document = None
    parts = document.values() if document and is_sog_document(document) else ()
    lists = [part["files"] for part in parts if isinstance(part, dict) and isinstance(part.get("files"), list)]
    names = {name for files in lists for name in files if _is_beside(name)}
    return sorted([meta, *(meta.parent / name for name in names if (meta.parent / name).is_file())])


def _is_beside(name: Any) -> bool:
    return isinstance(name, str) and name not in ("", META) and PurePosixPath(name).name == name and "\0" not in name


def is_bundled(path: Path) -> bool:
    """Return True if a SOG is one file, a zip, and not a folder or the ``meta.json`` in one."""
    if path.is_dir():
        return False
    with open_regular(path) as handle:
        return handle.read(2) == b"PK"


def _meta_of(path: Path) -> Path:
    return path / META if path.is_dir() else path


class _Pictures:
    """Decoder of pictures in a folder, on the disk or in an open zip, by ``meta``; they have ``size`` bytes."""

    def __init__(self, folder: Path | zipfile.Path, meta: str, size: int) -> None:
        self.folder, self.size = folder, size
        document = self._member(meta, MAX_META_BYTES)
        try:
            self.meta: Any = json.loads(document)
        except (ValueError, RecursionError) as error:
            raise _broken(f"{META} as JSON", str(error)[:120]) from None
        version, count = self.meta.get("version"), self.meta.get("count")
        if version != 2:
            raise _broken("version 2", repr(version)[:60])
        bands = (self.meta.get("shN") or {}).get("bands")
        higher = SH_ROWS[bands] if bands in (1, 2, 3) else 0
        row_bytes = FIELD_BYTES + TERM_BYTES * (1 + higher)
        if type(count) is not int or not 0 < count * row_bytes <= MOST_GROWTH * self.size:
            raise _broken("a count of splats that the file's size can be of", repr(count)[:60])
        self.count: int = count  # P

    def fields(self, *, colour: bool) -> Fields:
        """Return the splats' fields."""
        low, high = (self._numbers("means", key, 3) for key in ("mins", "maxs"))
        lower, upper = (self._pixels("means", i) for i in (0, 1))
        quats, scales, colours = (self._pixels(part, 0) for part in ("quats", "scales", "sh0"))
        scale_book, colour_book = (self._numbers(part, "codebook", 256) for part in ("scales", "sh0"))
        palette, labels = np.empty((1, 0, 3)), np.zeros(self.count, np.int64)
        if colour and self.meta.get("shN"):
            palette, labels = self._harmonics()

        def decode(rows: slice) -> Fields:
            levels = lower[rows, :3] + 256.0 * upper[rows, :3]
            folded = low + np.where(high > low, high - low, 1.0) * (levels / 65_535)
            largest = quats[rows, 3].astype(np.int64) - 252
            parts = (quats[rows, :3] / 127.5 - 1) * np.sqrt(0.5)
            rotations = smallest_three(parts, largest.clip(0))
            rotations[largest < 0] = (1, 0, 0, 0)
            fields = {
                "means": np.sign(folded) * np.expm1(np.abs(folded)),
                "quats": rotations,
                "log_scales": scale_book[scales[rows, :3]],
                "opacity_logits": logits(colours[rows, 3] / 255.0),
            }
            if colour:
                terms = colour_book[colours[rows, None, :3]]
                fields["sh"] = np.concatenate([terms, palette[labels[rows]]], axis=1)
            return fields

        mode, warnings = None, ()
        if (model := self.meta.get("model")) is not None:
            mode, warnings = mode_of_word(model, f"'model' {repr(model)[:60]} in {META}")
        fields = decoded(self.count, decode)
        return fields | {"render_mode": mode, "warnings": warnings}

    def _harmonics(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the palette [n, K - 1, 3], and each splat's row in it [P]."""
        bands, count = (self.meta["shN"][key] for key in ("bands", "count"))
        if bands not in (1, 2, 3) or type(count) is not int or not 0 < count <= MAX_PALETTE:
            raise _broken(f"1 to 3 bands and a palette of at most {MAX_PALETTE}", f"{bands} and {count}"[:60])
        book, higher = self._numbers("shN", "codebook", 256), SH_ROWS[bands]
        picture = self._picture("shN", 0, -(-count // PALETTE_COLUMNS) * PALETTE_COLUMNS * higher)
        if picture.shape[1] != PALETTE_COLUMNS * higher:
            raise _broken(f"a palette {PALETTE_COLUMNS * higher} pixels wide", f"{picture.shape[1]}")
        palette = book[picture[..., :3]].reshape(-1, higher, 3)[:count]
        bits = self._pixels("shN", 1).astype(np.int64)
        labels = bits[:, 0] | bits[:, 1] << 8
        if labels.max() >= count:
            raise _broken(f"labels below {count}", f"the label {labels.max()}")
        return palette, labels

    def _numbers(self, part: str, key: str, count: int) -> np.ndarray:
        values = (self.meta.get(part) or {}).get(key)
        numbers = np.array(values if isinstance(values, list) else [], np.float64)
        if numbers.shape != (count,) or not np.abs(numbers).max() <= MAX_TERM:
            raise _broken(f"{count} finite numbers as {key!r} of {part!r}", repr(values)[:60])
        return numbers

    def _pixels(self, part: str, index: int) -> np.ndarray:
        """Read a pixel of each splat, [P, 4] u8."""
        return self._picture(part, index, self.count).reshape(-1, 4)[: self.count]

    def _picture(self, part: str, index: int, least: int) -> np.ndarray:
        """Read a picture [h, w, 4] u8 of at least ``least`` pixels and not many more."""
        name = self.meta[part]["files"][index]
        content = self._member(name, self.size)
        try:
            with open_image(io.BytesIO(content), "WEBP") as picture:
                pixels = picture.width * picture.height
                if least <= pixels <= 2 * least + (1 << 16):
                    return np.asarray(picture.convert("RGBA"))
        except (OSError, ValueError, SyntaxError) as error:
            raise _broken(f"a WebP picture as {name!r}", str(error)[:120]) from None
        raise _broken(f"{least} pixels in {name!r}", f"{pixels}")

    def _member(self, name: str, limit: int) -> bytes:
        file = self.folder / name
        if PurePosixPath(name).name != name or not file.is_file():
            raise _broken(f"{name!r} beside {META}", "none")
        with file.open("rb") as handle:
            content = handle.read(limit + 1)
        if len(content) > limit:
            raise _broken(f"at most {limit} bytes of {name!r}", "more")
        return content


def _broken(expected: str, got: str) -> ValueError:
    return ValueError(f"{expected}, got {got}; {HINT}")
