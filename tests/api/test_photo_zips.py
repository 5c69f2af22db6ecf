"""Zips of photos that are broken, or break later, are refused in one way, wherever they are broken."""

from __future__ import annotations

import io
import random
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from liftcore.errors import InvalidInput, InvalidPhotos, NotFound
from liftcore.io.photo_zip import describe_photos, photo_index
from liftcore.io.photos import PhotosBeside

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


def mutated(content: bytes, seed: int) -> bytes:
    generator, mutant = random.Random(seed), bytearray(content)
    for _ in range(generator.choice((1, 1, 3))):
        place = generator.randrange(len(mutant))
        if generator.random() < 0.8:
            mutant[place] = generator.randrange(256)
        else:
            del mutant[place : place + generator.randrange(1, 9)]
    return bytes(mutant)


@pytest.mark.parametrize("method", METHODS)
def test_mutated_zip_is_read_or_refused_as_photos(method: str, tmp_path: Path) -> None:
    content, path, refusals = photos_zip(method), tmp_path / "photos.zip", 0
    for seed in range(150):
        path.write_bytes(mutated(content, seed))
        try:
            assert describe_photos(path)["photos"] > 0
        except InvalidPhotos:
            refusals += 1
    assert refusals > 50


@pytest.mark.parametrize("method", METHODS)
def test_photo_of_a_zip_that_broke_since_its_upload_is_not_found(method: str, tmp_path: Path) -> None:
    path = tmp_path / "photos.zip"
    path.write_bytes(photos_zip(method))
    file = photo_index(path).open("a")
    assert file is not None and b"".join(file[2]) == photo()
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(NotFound, match="photos"):
        photo_index(path).open("a")
    for seed in range(60):
        path.write_bytes(mutated(photos_zip(method), seed))
        try:
            photo_index(path).open("a")
        except NotFound as error:
            assert error.argument == "photos"


@pytest.mark.parametrize("method", METHODS)
def test_size_of_a_photo_in_a_broken_zip_is_refused_as_an_image(method: str, tmp_path: Path) -> None:
    path, outcomes = tmp_path / "photos.zip", set()
    for seed in range(60):
        path.write_bytes(mutated(photos_zip(method), seed))
        try:
            with zipfile.ZipFile(path) as archive:
                sibling_photos = PhotosBeside(zipfile.Path(archive))
        except (zipfile.BadZipFile, NotImplementedError, ValueError):
            continue
        try:
            header = sibling_photos.header("a.png")
            outcomes.add(header and header.stored)
        except InvalidInput as error:
            outcomes.add(error.expected)
    assert "an image" in outcomes
