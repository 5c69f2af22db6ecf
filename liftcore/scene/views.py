"""The names that pair cameras, photos and their features."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import PurePosixPath

from liftcore.errors import InvalidCameras, InvalidFeatures

# Only these are cut off, so that "frame.0001", which some files name without its extension, stays whole.
IMAGE_SUFFIXES = frozenset(
    (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".exr", ".ppm", ".pgm", ".gif", ".heic", ".dng")
)
NAMED_AFTER = (
    "a view is named after its image, without the extension, and with its folders where file names of the scene "
    "repeat (camA/000)"
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


def cameras_of_views(views: Collection[str], cameras: Collection[str]) -> dict[str, str]:
    """View -> camera, of the views that have one.

    Names pair as they are. Else one may have folders before it that the other leaves out, where no other view and no
    other camera has the same last part: ``camA/000`` and ``000``, but never ``train/000`` and ``test/000``.
    """
    known = set(cameras)
    named, seen = Counter(map(_last, views)), Counter(map(_last, cameras))
    alone = {_last(camera): camera for camera in cameras if seen[_last(camera)] == 1}
    pairs = {}
    for view in views:
        other = alone.get(_last(view)) if named[_last(view)] == 1 else None
        if view in known:
            pairs[view] = view
        elif other is not None and (_ends(view, other) or _ends(other, view)):
            pairs[view] = other
    return pairs


def require_pairs(views: Collection[str], cameras: Collection[str]) -> dict[str, str]:
    """`cameras_of_views` of the views of features.

    Raises:
        InvalidFeatures: no view has a camera.
    """
    pairs = cameras_of_views(views, cameras)
    if not pairs:
        raise InvalidFeatures(
            "features",
            expected="views named like the cameras",
            got=f"views {some_of(views)} and cameras {some_of(cameras)}, none in common",
            hint=NAMED_AFTER,
        )
    return pairs


def some_of(names: Collection[str]) -> str:
    """The first few, for an error."""
    return ", ".join(repr(name) for name in sorted(names)[:3])


def _last(name: str) -> str:
    return name.rpartition("/")[2]


def _ends(name: str, end: str) -> bool:
    return name.endswith(f"/{end}")
