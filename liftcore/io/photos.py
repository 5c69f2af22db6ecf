"""Photos as files: size and orientation from their headers, and the photo of a camera in a folder.

**Orientation.** EXIF may have viewers rotate a photo. COLMAP, nerfstudio and Inria's code calibrate and train on
the pixels as they are stored, so a photo is read as stored, unless the size of its camera or of its masks fits the
rotated photo alone (`PhotoHeader.turns_for`).
"""

from __future__ import annotations

import posixpath
import warnings
import zipfile
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import Enum
from pathlib import Path, PurePosixPath
from typing import IO, TYPE_CHECKING, NamedTuple

from liftcore.errors import InvalidInput, reading
from liftcore.io.files import BROKEN_ZIP
from liftcore.runtime.one_line import join_names
from liftcore.scene.views import IMAGE_SUFFIXES, without_image_suffix

if TYPE_CHECKING:
    from PIL import Image

ORIENTATION = 0x0112  # EXIF's tag
MAX_LISTED = 3  # photos in a warning
UPRIGHT, LARGEST_TAG, LEAST_SIDEWAYS = 1, 8, 5  # its values; from 5 on, rotation swaps width and height
UNREAD = {  # hints for images that Pillow does not open
    **dict.fromkeys((".heic", ".heif"), "convert HEIC to JPEG, without a turn of its own: heif-convert IN OUT.jpg"),
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw"), "develop raw photos to JPEG or PNG"),
    ".exr": "convert it to 8 bits, with the colours that the splats were trained on",
}
FIRST_SUFFIXES = (".png", ".jpg", ".jpeg")  # of photos of one name, as Blender's scripts and trainers look for them


class Reading(Enum):
    """Orientation in which a photo was read."""

    UPRIGHT = "without a turn to make"
    STORED = "as stored"
    ORIENTED = "turned as EXIF asks"


class PhotoHeader(NamedTuple):
    """Size and EXIF orientation of a photo."""

    width: int  # stored pixels
    height: int  # stored pixels
    orientation: int  # EXIF's, 1 to 8; 1: stored upright

    @property
    def stored(self) -> tuple[int, int]:
        """Width and height as they lie in the file."""
        return self.width, self.height

    @property
    def oriented(self) -> tuple[int, int]:
        """Width and height after rotation by the EXIF orientation."""
        return (self.height, self.width) if self.orientation >= LEAST_SIDEWAYS else self.stored

    def turns_for(self, size: tuple[int, int] | None) -> bool:
        """Return True if a map of this size (width, height), of any resolution, fits only the rotated photo.

        Where both fit, as for square photos and rotations by 180 degrees, it is of stored pixels.
        """
        (width, height), (across, down) = self.stored, size or self.stored
        return self.orientation >= LEAST_SIDEWAYS and (width - height) * (across - down) < 0

    def reading(self, size: tuple[int, int] | None) -> Reading:
        """Return the orientation in which a photo with a camera or masks of this size is read."""
        if self.orientation == UPRIGHT:
            return Reading.UPRIGHT
        return Reading.ORIENTED if self.turns_for(size) else Reading.STORED


def orientation_warnings(readings: Mapping[str, Reading], counterparts: str) -> list[str]:
    """Return warnings of how photos with an EXIF orientation were read."""
    advice = {
        Reading.STORED: "were read as stored, without the turn that their EXIF asks for: "
        f"{counterparts} must be of the stored pixels too, as those of COLMAP are",
        Reading.ORIENTED: f"were turned as their EXIF asks, as the sizes of {counterparts} tell",
    }
    lines = []
    for orientation, text in advice.items():
        if views := [view for view, value in readings.items() if value is orientation]:
            view_names = join_names(views, MAX_LISTED)
            lines.append(f"{len(views)} of {len(readings)} photos ({view_names}) {text}")
    return lines


@contextmanager
def open_photo(photo: Path | IO[bytes], name: str = "") -> Iterator[Image.Image]:
    """Open a photo with Pillow, which decodes no pixel yet; errors name the file."""
    source = name or str(photo)
    hint = UNREAD.get(PurePosixPath(source).suffix.lower(), "")
    with reading(source, InvalidInput, "a complete image", hint), open_image(photo) as image:
        yield image


@contextmanager
def open_image(picture: Path | IO[bytes], kind: str = "") -> Iterator[Image.Image]:
    """Open a picture of Pillow's format ``kind`` or any, without its pixels; a ValueError says that it is none."""
    from PIL import Image, UnidentifiedImageError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about large images, and odd EXIF
        try:
            with Image.open(picture, formats=[kind] if kind else None) as image:
                yield image
        except UnidentifiedImageError:
            raise ValueError(f"a file that Pillow cannot identify{kind and f' as {kind}'}") from None
        except Image.DecompressionBombError:
            limit = 2 * (Image.MAX_IMAGE_PIXELS or 0)
            raise ValueError(f"an image of at most {limit} pixels, got a larger one") from None


def read_header(photo: Path | IO[bytes], name: str = "") -> PhotoHeader:
    """Read the size and the orientation of a photo; no pixel is decoded."""
    with open_photo(photo, name) as image:
        return header_of(image)


def header_of(image: Image.Image) -> PhotoHeader:
    """Return the header of an image that Pillow has opened and not loaded."""
    tag = image.getexif().get(ORIENTATION, UPRIGHT)
    orientation = tag if isinstance(tag, int) and UPRIGHT <= tag <= LARGEST_TAG else UPRIGHT
    header = PhotoHeader(*image.size, orientation)
    if image.format == "TIFF":  # whose size Pillow gives after rotation
        header = PhotoHeader(*header.oriented, orientation)
    return header


class PhotosBeside:
    """Photos in the folder of a camera file, or in its parent, by the paths that the file has.

    Nothing outside these two folders, on the disk or in a zip, is read: of a path that leads elsewhere, such as to
    another machine's disk, the last parts are searched in them.
    """

    def __init__(self, folder: Path | zipfile.Path) -> None:
        self._folder = folder
        self._names: dict[str, dict[str, list[str]]] = {}

    def header(self, file_path: str) -> PhotoHeader | None:
        """Read the header of the photo at a path, with or without a suffix; None if it does not exist."""
        for folder, place in self._places(file_path):
            if (photo := self._photo(folder, place)) is not None:
                if isinstance(photo, Path):
                    return read_header(photo)
                try:
                    with photo.open("rb") as packed:
                        return read_header(packed, str(photo))
                except BROKEN_ZIP as error:
                    got = f"one that does not unzip ({str(error)[:120]})"
                    raise InvalidInput(str(photo), expected="an image", got=got) from None
        return None

    def missing(self, file_path: str) -> str:
        """Return the first place that was searched for a photo, for an error."""
        folder, place = self._places(file_path)[0]
        without = "" if PurePosixPath(place).suffix.lower() in IMAGE_SUFFIXES else " (.png, .jpg, ...)"
        return f"{folder / place}{without}"

    def _places(self, file_path: str) -> list[tuple[Path | zipfile.Path, str]]:
        """Return folders and paths below them, the most likely first."""
        folder, above = self._folder, self._folder.parent
        path = posixpath.normpath(file_path.replace("\\", "/"))
        parts = [part for part in path.split("/") if part not in ("", "..") and not part.endswith(":")] or [path]
        ups = path.split("/").count("..")
        if not ups and not path.startswith("/") and ":" not in path.split("/")[0]:
            return [(folder, path)]
        ends = ["/".join(parts[first:]) for first in range(len(parts))]
        nearer = [above, folder] if ups == 1 else [folder, above]
        return [(below, end) for end in ends for below in nearer]

    def _photo(self, folder: Path | zipfile.Path, place: str) -> Path | zipfile.Path | None:
        """Return the file of that path, or one of its name with the suffix of another image."""
        inner, _, name = place.rpartition("/")
        within = folder / inner if inner else folder
        key = str(within)
        if key not in self._names:
            self._names[key] = _images_in(within)
        names = self._names[key].get(without_image_suffix(name), [])
        best = name if name in names else next(iter(names), None)
        photo = None if best is None else within / best
        return photo if photo is not None and photo.is_file() else None


def _images_in(folder: Path | zipfile.Path) -> dict[str, list[str]]:
    """Return image files of a folder by their names without suffixes, the likeliest first; none without a folder."""
    images: dict[str, list[str]] = defaultdict(list)
    if folder.is_dir():
        names = [entry.name for entry in folder.iterdir()]
        for name in sorted(names, key=_likely):
            if PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES:
                images[without_image_suffix(name)].append(name)
    return dict(images)


def _likely(name: str) -> tuple[int, str]:
    suffix = PurePosixPath(name).suffix.lower()
    return (FIRST_SUFFIXES.index(suffix) if suffix in FIRST_SUFFIXES else len(FIRST_SUFFIXES)), name
