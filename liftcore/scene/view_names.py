"""The name that pairs a camera, a photo and its features."""

from __future__ import annotations

from collections import Counter
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

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


def view_names(images: Sequence[str]) -> list[str]:
    """One view name an image: the file's stem, or the relative path without extension where stems collide."""
    paths = [_without_suffix(image) for image in images]
    stems = [PurePosixPath(path).name for path in paths]
    uses = Counter(stems)
    return [stem if uses[stem] == 1 else path for stem, path in zip(stems, paths, strict=True)]


def _without_suffix(image: str) -> str:
    path = PurePosixPath(image.replace("\\", "/").removeprefix("./"))
    return str(path.with_suffix("")) if path.suffix.lower() in IMAGE_SUFFIXES else str(path)
