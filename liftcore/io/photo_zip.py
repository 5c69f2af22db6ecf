"""Photos of a scene: a zip of JPEG and PNG files that are named like its views."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any

from liftcore.errors import InvalidCameras, InvalidPhotos, NotFound
from liftcore.io.files import BROKEN_ZIP, files_in_zip, open_zip
from liftcore.io.photos import UPRIGHT, open_image, read_header
from liftcore.scene.views import cameras_of_views, view_names

MAX_PHOTOS = 10_000  # photos
DIRECTORY_BYTES = 8 << 20  # of the list of what is in a zip: of 20,000 files with long names
KEPT_ZIPS = 4  # whose directories stay in memory
LOCAL_HEADER = struct.Struct("<26x2H")  # before a member: the lengths of its name and its extra field
LARGEST_BYTES = 64 << 20  # of a photo: 100 million pixels as a good JPEG
SIDE = 20_000  # pixels: what browsers decode ends there
SPARE_BYTES = 1 << 20  # beside twice the archive: photos hardly shrink in a zip, bombs grow a thousandfold out of it
BLOCK_BYTES = 256 << 10
MEDIA_TYPES = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png"}
FORMATS = {"image/jpeg": "JPEG", "image/png": "PNG"}
ENCRYPTED = 0x1  # of a member's flags
EXPECTED = "a zip of JPEG or PNG photos, named like the views"


def describe_photos(path: Path) -> dict[str, Any]:
    """Check a zip of photos: return the number of ``photos``, their ``names`` as of views, and ``warnings``."""
    try:
        with open_zip(path) as archive:
            if (size := path.stat().st_size - archive.start_dir) > DIRECTORY_BYTES:
                expected = f"a zip with a directory of at most {DIRECTORY_BYTES} bytes"
                raise InvalidPhotos("photos", expected=expected, got=f"{size}", hint="shorter names, and no comments")
            members, count = _members(archive), len(archive.infolist())
            _require_bounds(count, members, path.stat().st_size)
            for member in members.values():
                _require_photo(archive, member)
    except InvalidCameras as error:  # of names, which are those of views
        raise InvalidPhotos("image name", expected=error.expected, got=error.got) from None
    except BROKEN_ZIP as error:
        raise InvalidPhotos("photos", expected=EXPECTED, got=f"{error}"[:200] or "a damaged one") from None
    other_count = count - len(members)
    warnings = [f"{other_count} entries are no .jpg, .jpeg or .png and are left alone"] if other_count else []
    return {"photos": len(members), "names": list(members), "warnings": warnings}


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return view -> photo, by suffix."""
    photos = {name: file for name, file in files_in_zip(archive).items() if _media_type(name)}
    return dict(zip(view_names([*photos]), photos.values(), strict=True))


def _media_type(name: str) -> str:
    return MEDIA_TYPES.get(PurePosixPath(name).suffix.lower(), "")


def _require_bounds(count: int, members: Mapping[str, zipfile.ZipInfo], size: int) -> None:
    unpacked = sum(member.file_size for member in members.values())
    largest = max((member.file_size for member in members.values()), default=0)
    if not 0 < len(members) <= MAX_PHOTOS or count > 2 * MAX_PHOTOS:
        raise InvalidPhotos("photos", expected=f"1 to {MAX_PHOTOS} photos", got=f"{len(members)} among {count} files")
    if largest > LARGEST_BYTES or unpacked > 2 * size + SPARE_BYTES:
        expected = f"photos of at most {LARGEST_BYTES} bytes, and together at most twice the zip"
        raise InvalidPhotos("photos", expected=expected, got=f"{largest} bytes in one, {unpacked} in a zip of {size}")


def _require_photo(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    kind, label = FORMATS[_media_type(member.filename)], member.filename[:80]
    if member.flag_bits & ENCRYPTED:
        raise InvalidPhotos(label, expected="a photo that is not encrypted", got="one that is")
    content = archive.read(member)  # all of it, so that its checksum is looked at
    try:
        with open_image(io.BytesIO(content), kind) as photo:
            width, height = photo.size
    except (OSError, SyntaxError, ValueError):
        raise InvalidPhotos(
            label, expected=f"a {kind} file, as its name says", got="another, or a damaged one"
        ) from None
    if max(width, height) > SIDE:
        raise InvalidPhotos(label, expected=f"sides of at most {SIDE} pixels", got=f"{width}x{height}")


@dataclass(frozen=True)
class PhotoIndex:
    """Positions of the photos in a checked zip, which does not stay open: if it is deleted, its room is free."""

    path: Path
    members: Mapping[str, zipfile.ZipInfo]  # by their views

    def names(self, views: Collection[str]) -> set[str]:
        """Return those of the views that have a photo."""
        return set(cameras_of_views(self.members, views).values())

    def open(self, view: str) -> tuple[str, int, Iterator[bytes]] | None:
        """Return the media type, the size and the blocks of a view's photo; None when there is none."""
        name = view if view in self.members else next(iter(cameras_of_views(self.members, [view])), None)
        if name is None:
            return None
        member, blocks = self.members[name], self._blocks(self.members[name])
        try:
            first = next(blocks, b"")
        except (*BROKEN_ZIP, struct.error) as error:
            raise _damaged(error) from None
        return _media_type(member.filename), member.file_size, chain([first], blocks)

    def _blocks(self, member: zipfile.ZipInfo) -> Iterator[bytes]:
        # To open the zip would read its whole directory again.
        with self.path.open("rb") as file:
            file.seek(member.header_offset)
            name, extra = LOCAL_HEADER.unpack(file.read(LOCAL_HEADER.size))
            file.seek(name + extra, io.SEEK_CUR)
            with zipfile.ZipExtFile(file, "r", member) as photo:
                while block := photo.read(BLOCK_BYTES):
                    yield block


def photo_index(path: Path) -> PhotoIndex:
    """Return the index of a zip; those of the last few stay in memory."""
    try:
        return _index(path, path.stat().st_mtime_ns)  # an upload replaces a damaged one in place
    except BROKEN_ZIP as error:
        raise _damaged(error) from None


def _damaged(error: Exception) -> NotFound:
    got = getattr(error, "strerror", None) or str(error)[:80] or "a damaged one"
    hint = "something else wrote there: upload them again"
    return NotFound("photos", expected="their zip in the data directory", got=got, hint=hint)


@lru_cache(KEPT_ZIPS)
def _index(path: Path, modified_ns: int) -> PhotoIndex:
    with open_zip(path) as archive:
        return PhotoIndex(path, _members(archive))


def in_camera_orientation(
    photo: Iterator[bytes], camera_size: Callable[[], tuple[int, int] | None]
) -> tuple[Iterator[bytes], bool]:
    """Make a browser show a JPEG or PNG as its camera sees it: return its blocks, and True if some are left out.

    A browser applies the EXIF orientation. If the camera is of the stored pixels (`liftcore.io.photos`), the blocks
    come without EXIF.

    Args:
        photo: the blocks of the file.
        camera_size: returns width and height of the photo's camera; called only if the photo has an orientation.
    """
    first = next(photo, b"")
    is_png = first.startswith(b"\x89PNG")
    begin = first.find(b"eXIf" if is_png else b"Exif\0\0") - 4  # of its chunk or segment
    if begin < 0:
        return chain([first], photo), False
    content = first + b"".join(photo)
    header = read_header(io.BytesIO(content), "photo")
    if header.orientation == UPRIGHT or header.turns_for(camera_size()):
        return iter([content]), False
    size = 12 + int.from_bytes(content[begin : begin + 4], "big")
    if not is_png:
        size = 2 + int.from_bytes(content[begin + 2 : begin + 4], "big")
    return iter([content[:begin] + content[begin + size :]]), True
