"""Label pictures: a PNG of one channel in which a value names a mask.

Where 0 means unlabelled, as most programs have it, value v is mask v - 1. Where another value does (255, 65535),
value v is mask v. Whoever takes the one for the other is one off in every mask, so with 0 the values must end at the
number of vectors.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, UnidentifiedImageError

from liftcore.errors import InvalidFeatures
from liftcore.features.views import NO_LABEL

if TYPE_CHECKING:
    from pathlib import Path

SIGNATURE = b"\x89PNG\r\n\x1a\n"
HEADER_BYTES = 26  # up to the depth and the kind of colours
GREY, PALETTE = 0, 3
KINDS = {
    0: "grey",
    2: "red, green and blue",
    3: "a palette",
    4: "grey with transparency",
    6: "colours with transparency",
}
EXPECTED = "a PNG of one channel, 8 or 16 bits of grey or a palette"


def picture_labels(path: Path, rows: int, unlabelled: int) -> np.ndarray:
    """[1, h, w] i32 of masks, -1 for none.

    Args:
        path: the picture. rows: vectors that there are. unlabelled: the value of pixels without a mask.

    Raises:
        InvalidFeatures: the file is no such PNG, or a value has no vector; with 0 for unlabelled also when vectors
            are left over at the end.
    """
    values = _values(path)
    labelled = values != unlabelled
    high = int(values.max(initial=0, where=labelled))
    if unlabelled == 0 and high != rows:
        hint = (
            "is there a vector for 0 too, or does another value mean none (--unlabelled 255)?" if high < rows
            else "name the value that means none with --unlabelled (255, 65535)"
        )  # fmt: skip
        expected = f"values 1..{rows} for {rows} vectors, and 0 for none"
        raise InvalidFeatures(str(path), expected=expected, got=f"values up to {high}", hint=hint)
    if unlabelled and high >= rows:
        expected = f"values 0..{rows - 1} for {rows} vectors, and {unlabelled} for none"
        hint = "where 0 means none, value 1 has the first vector: --unlabelled 0"
        raise InvalidFeatures(str(path), expected=expected, got=f"the value {high}", hint=hint)
    first = 1 if unlabelled == 0 else 0
    return np.where(labelled, values - first, NO_LABEL).astype(np.int32)[None]


def _values(path: Path) -> np.ndarray:
    """[h, w] i32, the numbers as they are stored."""
    try:
        with path.open("rb") as handle:
            header = handle.read(HEADER_BYTES)
        _check_header(header, path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # it opens, up to twice the limit
            with Image.open(path, formats=["PNG"]) as image:
                return np.asarray(image).astype(np.int32)
    except Image.DecompressionBombError:
        most = 2 * (Image.MAX_IMAGE_PIXELS or 0)
        raise InvalidFeatures(str(path), expected=f"at most {most} pixels", got="a larger picture") from None
    except UnidentifiedImageError:
        raise InvalidFeatures(str(path), expected=EXPECTED, got="one that Pillow does not know") from None
    except (OSError, SyntaxError, ValueError, EOFError) as error:  # Pillow's kinds for files that are cut or broken
        got = f"one that does not open ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected=EXPECTED, got=got, hint="write it anew") from None


def _check_header(header: bytes, path: Path) -> None:
    """Refuse what Pillow would open as other numbers than are stored: it spreads grey of few bits over 0 to 255."""
    if len(header) < HEADER_BYTES or not header.startswith(SIGNATURE):
        raise InvalidFeatures(str(path), expected=EXPECTED, got="a file that is no PNG")
    depth, kind = header[24], header[25]
    if kind != PALETTE and not (kind == GREY and depth in (8, 16)):
        hint = "a photo belongs in another folder; a picture of colours is one of labels once each has a number"
        got = f"{KINDS.get(kind, 'an unknown kind')} of {depth} bits"
        raise InvalidFeatures(str(path), expected=EXPECTED, got=got, hint=hint)
