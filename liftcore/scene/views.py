"""The names that pair cameras, photos and their features.

Names are compared, and made, in Unicode's composed form (NFC): macOS stores the name of a file decomposed (NFD), and
other systems and JSON hold the same name composed.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import PurePosixPath

from liftcore.errors import InvalidCameras, InvalidFeatures, InvalidInput

# Only these are cut off, so that "frame.0001", which some files name without its extension, stays whole.
IMAGE_SUFFIXES = frozenset({
    ".jpg", ".jpeg", ".jfif", ".jp2", ".jxl", ".png", ".webp", ".avif", ".bmp", ".tif", ".tiff", ".exr", ".ppm",
    ".pgm", ".gif", ".heic", ".heif", ".dng", ".arw", ".cr2", ".nef",
})  # fmt: skip
NAMED_AFTER = (
    "a view is named after its image, without the extension, and with its folders where file names of the scene "
    "repeat (camA/000)"
)
NOT_UTF8 = "names of cameras are not UTF-8: rename the photos, and their names in the camera file"
REPLACED = "\ufffd"  # in the place of bytes that are no UTF-8
MAX_VIEWS = 100_000  # of a scene: far more than real ones have, and still read and checked in seconds
FEWER_VIEWS = "lift fewer photos, such as every second one"
UNSAYABLE = re.compile("[\\x00-\\x1f\\x7f\\ud800-\\udfff]")


def composed(name: str) -> str:
    """Return the name in Unicode's composed form (NFC)."""
    return unicodedata.normalize("NFC", name)


def view_names(images: Sequence[str]) -> list[str]:
    """Return one view name an image: the file's stem; where any stems of the scene collide, all keep their folders.

    Were it only those that collide, the longer of two cameras of a rig would have its last photos named otherwise
    than its first.
    """
    require_few(images)
    for image in images:
        require_name(image, "image name", InvalidCameras)
    paths = [without_image_suffix(image) for image in images]
    stems = [PurePosixPath(path).name for path in paths]
    return stems if len(set(stems)) == len(stems) else paths


def require_few(views: Collection[object]) -> None:
    """Refuse more views than MAX_VIEWS."""
    if len(views) > MAX_VIEWS:
        expected, got = f"at most {MAX_VIEWS} views", str(len(views))
        raise InvalidCameras("cameras", expected=expected, got=got, hint=FEWER_VIEWS)


def require_name(name: str, argument: str, fault: type[InvalidInput]) -> str:
    """Return the name of a view, a photo or a phrase that UTF-8 and one line can hold.

    Names of files whose bytes are no UTF-8 come with halves of surrogate pairs in them. Others raise a ``fault``.
    """
    if UNSAYABLE.search(name):
        expected, hint = "one of printable characters in UTF-8", "rename the file"
        raise fault(argument, expected=expected, got=ascii(name)[:80], hint=hint)
    return name


def without_image_suffix(image: str) -> str:
    """Return the relative path of an image, composed, without its extension, if that is one of images."""
    path = PurePosixPath(composed(image).replace("\\", "/").removeprefix("./"))
    return str(path.with_suffix("")) if path.suffix.lower() in IMAGE_SUFFIXES else str(path)


def cameras_of_views(views: Collection[str], cameras: Collection[str]) -> dict[str, str]:
    """Return view -> camera, of the views that have one.

    Names pair as they are. Else one may have folders before it that the other leaves out, where no other view and no
    other camera ends like the shorter one: ``/photos/camA/000`` and ``camA/000``, ``camA/000`` and ``000``, but never
    ``train/000`` and ``test/000``.
    """
    by_camera_name = {composed(camera): camera for camera in cameras}
    by_view_name = {composed(view): view for view in views}
    ends = Counter(ending for name in by_view_name for ending in _endings(name))
    ending_in = Counter(ending for name in by_camera_name for ending in _endings(name))
    unique = {ending: name for name in by_camera_name for ending in _endings(name) if ending_in[ending] == 1}
    pairs = {}
    for name, view in by_view_name.items():
        shorter = (ending for ending in _endings(name) if ending == name or ending in by_camera_name)
        match = next((unique[ending] for ending in shorter if ending in unique and ends[ending] == 1), None)
        if name in by_camera_name:
            pairs[view] = by_camera_name[name]
        elif match is not None:
            pairs[view] = by_camera_name[match]
    return pairs


def require_pairs(views: Collection[str], cameras: Collection[str]) -> dict[str, str]:
    """Return `cameras_of_views` of the views of features, and refuse none."""
    pairs = cameras_of_views(views, cameras)
    if not pairs:
        unreadable = sum(REPLACED in camera for camera in cameras) > len(cameras) / 2
        raise InvalidFeatures(
            "features",
            expected="views named like the cameras",
            got=f"views {first_names(views)} and cameras {first_names(cameras)}, none in common",
            hint=NOT_UTF8 if unreadable else NAMED_AFTER,
        )
    return pairs


def first_names(names: Collection[str]) -> str:
    """Return the first three names, quoted, for an error."""
    return ", ".join(repr(name) for name in sorted(names)[:3])


def _endings(name: str) -> list[str]:
    """Return the name, the name without its first folder, without its first two, and so on, down to the last part."""
    parts = name.split("/")
    return ["/".join(parts[start:]) for start in range(len(parts))]
