"""Zips of photos that are broken, or break later, are refused in one way, wherever they are broken."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from liftcore.errors import InvalidInput, InvalidPhotos, NotFound
from liftcore.io.photo_zip import describe_photos, photo_index
from liftcore.io.photos import PhotosBeside
from tests.promises.over_http import mutated

METHODS = {
    "stored": zipfile.ZIP_STORED, "deflate": zipfile.ZIP_DEFLATED, "bzip2": zipfile.ZIP_BZIP2,
    "lzma": zipfile.ZIP_LZMA,
}  # fmt: skip
NAMES = ("a.png", "b.png")


def photo() -> bytes:
    noise = np.random.default_rng(0).integers(0, 4, (9, 12, 3), np.uint8)
    Image.fromarray(noise).save(content := io.BytesIO(), "PNG", compress_level=0)
    return content.getvalue()


def photos_zip(method: str) -> bytes:
    with zipfile.ZipFile(content := io.BytesIO(), "w", METHODS[method]) as archive:
        for name in NAMES:
            archive.writestr(name, photo())
    return content.getvalue()


@pytest.mark.parametrize("method", METHODS)
def test_mutated_zip_is_read_or_refused_in_one_way(method: str, tmp_path: Path) -> None:
    """As an upload, as one that broke since it was uploaded, and as photos beside a file of cameras."""
    content, path, outcomes = photos_zip(method), tmp_path / "photos.zip", list[object]()
    for seed in range(150):
        path.write_bytes(mutated(content, seed))
        try:
            assert describe_photos(path)["photos"] > 0
        except InvalidPhotos as error:
            outcomes.append(type(error))
        try:
            photo_index(path).open("a")
        except NotFound as error:
            assert error.argument == "photos"
        try:
            with zipfile.ZipFile(path) as archive:
                sibling_photos = PhotosBeside(zipfile.Path(archive))
        except (zipfile.BadZipFile, NotImplementedError, ValueError):
            continue
        try:
            sibling_photos.header("a.png")
        except InvalidInput as error:
            outcomes.append(error.expected)
    assert outcomes.count(InvalidPhotos) > 50 and "an image" in outcomes


def test_photo_of_a_zip_that_was_cut_is_not_found(tmp_path: Path) -> None:
    path = tmp_path / "photos.zip"
    path.write_bytes(photos_zip("deflate"))
    file = photo_index(path).open("a")
    assert file is not None and b"".join(file[2]) == photo()
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(NotFound, match="photos"):
        photo_index(path).open("a")
