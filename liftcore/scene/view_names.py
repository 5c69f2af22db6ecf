"""The name that pairs a camera, a photo and its features."""

from __future__ import annotations

import re
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

from liftcore.errors import InvalidCameras

if TYPE_CHECKING:
    from collections.abc import Sequence

# Only these are cut off, so that "frame.0001", which some files name without its extension, stays whole.
IMAGE_SUFFIXES = frozenset(
    [
        ".jpg",
        ".jpeg",
        ".png",
        ".webp",
        ".bmp",
        ".tif",
        ".tiff",
        ".exr",
        ".ppm",
        ".pgm",
        ".gif",
        ".heic",
        ".dng",
    ]
)
UNSAYABLE = re.compile("[\\x00-\\x1f\\x7f\\ud800-\\udfff]")


def view_names(images: Sequence[str]) -> list[str]:
    """One view name an image: the file's stem; where any stems of the scene collide, all keep their folders.

    Were it only those that collide, the longer of two cameras of a rig would have its last photos named otherwise
    than its first.

    Raises:
        InvalidCameras: a name with control characters, or with half of a surrogate pair, which no UTF-8 can say.
    """
    for image in images:
        if UNSAYABLE.search(image):
            raise InvalidCameras("image name", expected="one of printable characters", got=ascii(image)[:60])
    paths = [without_image_suffix(image) for image in images]
    stems = [PurePosixPath(path).name for path in paths]
    return stems if len(set(stems)) == len(stems) else paths


def without_image_suffix(image: str) -> str:
    """The relative path of an image without its extension, if that is one of images."""
    path = PurePosixPath(image.replace("\\", "/").removeprefix("./"))
    return str(path.with_suffix("")) if path.suffix.lower() in IMAGE_SUFFIXES else str(path)
