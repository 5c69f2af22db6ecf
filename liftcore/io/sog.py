"""PlayCanvas's ``.sog`` of version 2: a zip or folder of lossless WebP pictures, a pixel a splat, and ``meta.json``.

Means have 16 bits an axis in two pictures, between bounds, of ``sign(v) log(1 + |v|)``; quaternions their smallest
three parts and 252 to 255 for the largest of w x y z; log scales and constant terms are rows of codebooks of 256;
opacities u8. Higher harmonics are rows of a palette, 64 entries a line of its picture. The writer sorts the rows;
ours are the file's.
"""

import io
import json
import warnings
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.io.files import BROKEN_ZIP, visible_files
from liftcore.io.quantised import MOST_GROWTH, Fields, decoded, field_shapes, logits, smallest_three

META = "meta.json"
MAX_META_BYTES = 1 << 20
SPLAT_BYTES = 18  # of a splat's pixels
PALETTE_COLUMNS = 64
MAX_PALETTE = 1 << 16
SH_ROWS = (0, 3, 8, 15)  # higher harmonics by degree
MAX_TERM = 1e6  # of a codebook's or bound's numbers: exp of log scales apart, none has one
HINT = "export it again with SuperSplat or splat-transform, or as PLY"


def read_sog(path: Path, *, colour: bool = True) -> Fields:
    """The fields of a ``.sog`` file, or of a folder of what such a file holds.

    Raises:
        InvalidSplats: the file is malformed, of another version, or has more splats than its size can be of.
    """
    try:
        if path.is_dir():
            return _Pictures(path, path, sum(file.stat().st_size for file in visible_files(path))).fields(
                colour=colour
            )
        with zipfile.ZipFile(path) as archive:
            return _Pictures(zipfile.Path(archive), path, path.stat().st_size).fields(colour=colour)
    except BROKEN_ZIP as error:
        got = f"one that does not open ({str(error)[:120]})"
        raise InvalidSplats(str(path), expected="a .sog file", got=got, hint=HINT) from None


class _Pictures:
    """What is in an open file, or a folder."""

    def __init__(self, members: zipfile.Path | Path, path: Path, size: int) -> None:
        self.members, self.path, self.size = members, path, size
        try:
            self.meta: Any = json.loads(self._member(META, MAX_META_BYTES))
        except (ValueError, RecursionError) as error:
            raise self._refused(f"{META} as JSON", str(error)[:120]) from None
        version = self.meta.get("version") if isinstance(self.meta, dict) else None
        if version != 2:
            raise self._refused("version 2", repr(version)[:60])
        count = self.meta.get("count")
        if type(count) is not int or not 0 < count * SPLAT_BYTES <= MOST_GROWTH * self.size:
            raise self._refused("a count of splats that the file's size can be of", repr(count)[:60])
        self.count: int = count  # P

    def fields(self, *, colour: bool) -> Fields:
        """The splats' fields."""
        low, high = (self._numbers("means", key, 3) for key in ("mins", "maxs"))
        lower, upper = (self._pixels("means", i) for i in (0, 1))
        quats, scales, colours = (self._pixels(part, 0) for part in ("quats", "scales", "sh0"))
        scale_book, colour_book = (self._numbers(part, "codebook", 256) for part in ("scales", "sh0"))
        palette, labels = self._harmonics() if colour and self.meta.get("shN") else (np.empty((1, 0, 3)), None)

        def decode(rows: slice) -> Fields:
            levels = lower[rows, :3] + 256.0 * upper[rows, :3]
            folded = low + np.where(high > low, high - low, 1.0) * (levels / 65_535)
            largest = quats[rows, 3].astype(np.int64) - 252
            parts = (quats[rows, :3] / 127.5 - 1) * np.sqrt(0.5)
            turned = smallest_three(parts, largest.clip(0))
            turned[largest < 0] = (1, 0, 0, 0)
            fields = {
                "means": np.sign(folded) * np.expm1(np.abs(folded)),
                "quats": turned,
                "log_scales": scale_book[scales[rows, :3]],
                "opacity_logits": logits(colours[rows, 3] / 255.0),
            }
            if colour:
                higher = palette[labels[rows] if labels is not None else np.zeros(len(parts), int)]
                fields["sh"] = np.concatenate([colour_book[colours[rows, None, :3]], higher], axis=1)
            return fields

        return decoded(self.count, field_shapes(1 + palette.shape[1] if colour else 0), decode)

    def _harmonics(self) -> tuple[np.ndarray, np.ndarray]:
        """The palette [n, K - 1, 3], and each splat's row in it [P]."""
        bands, count = (self._part("shN").get(key) for key in ("bands", "count"))
        if bands not in (1, 2, 3) or type(count) is not int or not 0 < count <= MAX_PALETTE:
            raise self._refused(f"1 to 3 bands and a palette of at most {MAX_PALETTE}", f"{bands} and {count}"[:60])
        book, higher = self._numbers("shN", "codebook", 256), SH_ROWS[bands]
        picture = self._picture("shN", 0, -(-count // PALETTE_COLUMNS) * PALETTE_COLUMNS * higher)
        if picture.shape[1] != PALETTE_COLUMNS * higher:
            raise self._refused(f"a palette {PALETTE_COLUMNS * higher} pixels wide", f"{picture.shape[1]}")
        palette = book[picture[..., :3]].reshape(-1, higher, 3)[:count]
        bits = self._pixels("shN", 1).astype(np.int64)
        labels = bits[:, 0] | bits[:, 1] << 8
        if labels.max() >= count:
            raise self._refused(f"labels below {count}", f"the label {labels.max()}")
        return palette, labels

    def _part(self, name: str) -> dict[str, Any]:
        part = self.meta.get(name)
        if not isinstance(part, dict):
            raise self._refused(f"{name!r} in {META}", "none")
        return part

    def _numbers(self, part: str, key: str, count: int) -> np.ndarray:
        values = self._part(part).get(key)
        try:
            found = np.array(values, np.float64)
        except (TypeError, ValueError, OverflowError):
            found = np.empty(0)
        if found.shape != (count,) or not np.abs(found).max() <= MAX_TERM:
            raise self._refused(f"{count} finite numbers as {key!r} of {part!r}", repr(values)[:60])
        return found

    def _pixels(self, part: str, index: int) -> np.ndarray:
        """[P, 4] u8, a pixel a splat."""
        return self._picture(part, index, self.count).reshape(-1, 4)[: self.count]

    def _picture(self, part: str, index: int, least: int) -> np.ndarray:
        """[h, w, 4] u8, of at least so many pixels and not many more."""
        from PIL import Image, UnidentifiedImageError

        names = self._part(part).get("files")
        if not isinstance(names, list) or len(names) <= index or not isinstance(names[index], str):
            raise self._refused(f"{index + 1} files of {part!r} in {META}", repr(names)[:60])
        content = self._member(names[index], self.size)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)
                with Image.open(io.BytesIO(content), formats=["WEBP"]) as picture:
                    pixels = picture.width * picture.height
                    if not least <= pixels <= 2 * least + (1 << 16):
                        raise self._refused(f"{least} pixels in {names[index]!r}", f"{pixels}")
                    return np.asarray(picture.convert("RGBA"))
        except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
            raise self._refused(f"a WebP picture as {names[index]!r}", str(error)[:120]) from None

    def _member(self, name: str, most: int) -> bytes:
        member = self.members / name
        if PurePosixPath(name).name != name or not member.is_file():  # beside meta.json, and nowhere else
            raise self._refused(f"{name!r} beside {META}", "none")
        with member.open("rb") as file:
            content = file.read(most + 1)
        if len(content) > most:
            raise self._refused(f"at most {most} bytes of {name!r}", "more")
        return content

    def _refused(self, expected: str, got: str) -> InvalidSplats:
        return InvalidSplats(str(self.path), expected=expected, got=got, hint=HINT)
