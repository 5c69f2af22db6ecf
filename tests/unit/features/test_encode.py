"""Photos of every kind become grids of whole patches, in the right places, or one clear error."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from liftcore.errors import InvalidFeatures, InvalidInput
from liftcore.features.encoders import Pixels
from liftcore.features.encoders.encode import (
    MAX_CELLS,
    Encoded,
    EncodeSettings,
    encode_images,
    find_images,
    grid_size,
    read_image,
)
from liftcore.features.pack import read_features
from liftcore.features.views import FeatureGrid

ORIENTATION = 0x0112


class MeanColour:
    """Three channels: the mean colour of each patch."""

    name, text_space, channels = "mean colour", "none", 3
    pixels = Pixels(patch=4, shorter=8, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0), interpolation="bilinear")

    def __init__(self, scale: float = 1.0) -> None:
        self.scale = scale
        self.batches: list[int] = []

    def encode(self, images: Tensor) -> Tensor:
        self.batches.append(len(images))
        return self.scale * torch.nn.functional.avg_pool2d(images, 4).permute(0, 2, 3, 1)


Encode = Callable[..., tuple[Encoded, dict[str, Tensor]]]


@pytest.fixture
def encode(tmp_path: Path) -> Encode:
    def run(folder: Path, encoder: MeanColour | None = None, **settings: Any) -> tuple[Encoded, dict[str, Tensor]]:
        out = tmp_path / "out" / "pack.safetensors"
        chosen = EncodeSettings(**{"normalised": False, **settings})
        done = encode_images(find_images([folder]), encoder or MeanColour(), out, chosen)
        assert [path.name for path in out.parent.iterdir()] == [out.name]
        packs = read_features(out)
        grids = {}
        for view in packs.views:
            observed = packs[view]
            assert isinstance(observed, FeatureGrid)
            grids[view] = observed.grid
        return done, grids

    return run


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    return folder


def blob(width: int, height: int, box: tuple[int, int, int, int]) -> Image.Image:
    image = Image.new("RGB", (width, height))
    image.paste((255, 255, 255), box)
    return image


def test_a_blob_lights_the_cell_that_it_lies_in(photos: Path, encode: Encode) -> None:
    blob(60, 40, (50, 0, 60, 10)).save(photos / "a.png")  # the right upper corner
    _, grids = encode(photos)
    grid = grids["a"]
    assert grid.shape == (2, 3, 3) and grid.dtype == torch.float16
    assert int(grid.sum(dim=-1).argmax()) == 2
    assert grid[1].max() == 0


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turned_photos_are_read_upright(orientation: int, photos: Path, encode: Encode) -> None:
    upright = blob(60, 40, (45, 0, 60, 10))
    back = {
        2: [Image.Transpose.FLIP_LEFT_RIGHT],
        3: [Image.Transpose.ROTATE_180],
        4: [Image.Transpose.FLIP_TOP_BOTTOM],
        5: [Image.Transpose.TRANSPOSE],
        6: [Image.Transpose.ROTATE_90],
        7: [Image.Transpose.TRANSVERSE],
        8: [Image.Transpose.ROTATE_270],
    }
    stored = upright
    for move in back.get(orientation, []):
        stored = stored.transpose(move)
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    stored.save(photos / "a.png", exif=exif)
    done, grids = encode(photos)
    assert grids["a"].shape == (2, 3, 3)
    assert int(grids["a"].sum(dim=-1).argmax()) == 2
    assert done.turned == (() if orientation == 1 else ("a",))


def grey(mode: str) -> Image.Image:
    if mode == "I;16":
        return Image.fromarray(np.full((8, 8), 32_896, np.uint16))
    value = {"L": 128, "LA": (128, 255), "P": 128, "RGBA": (128, 128, 128, 255), "CMYK": (127, 127, 127, 0)}
    return Image.new(mode, (8, 8), value[mode])


@pytest.mark.parametrize("mode", ["L", "LA", "I;16", "RGBA", "CMYK"])
def test_every_kind_of_grey_is_the_same_grey(mode: str, photos: Path, encode: Encode) -> None:
    grey(mode).save(photos / ("a.tif" if mode == "CMYK" else "a.png"))
    _, grids = encode(photos)
    assert (grids["a"].float() - 0.502).abs().max() < 0.01


def test_palettes_and_bits_have_their_colours(photos: Path, encode: Encode) -> None:
    red = Image.new("P", (8, 8), 1)
    red.putpalette([0, 0, 0, 255, 0, 0])
    red.save(photos / "red.png")
    Image.new("1", (8, 8), 1).save(photos / "white.png")
    Image.new("RGBA", (8, 8), (0, 0, 0, 0)).save(photos / "nothing.png")
    _, grids = encode(photos)
    assert grids["red"][0, 0].tolist() == [1, 0, 0]
    assert grids["white"].min() == 1
    assert grids["nothing"].min() == 1  # transparent pixels show white


@pytest.mark.parametrize(("size", "grid"), [((1, 1), (2, 2)), ((3, 1), (2, 6)), ((7, 90), (26, 2)), ((9, 8), (2, 2))])
def test_tiny_and_odd_images_become_whole_patches(
    size: tuple[int, int], grid: tuple[int, int], photos: Path, encode: Encode
) -> None:
    Image.new("RGB", size, (255, 0, 0)).save(photos / "a.png")
    _, grids = encode(photos)
    assert tuple(grids["a"].shape[:2]) == grid
    assert grids["a"][..., 0].min() == 1 and grids["a"][..., 1:].max() == 0


def test_size_is_the_shorter_side_in_pixels() -> None:
    assert grid_size(990, 742, 224, 16) == (19, 14)
    assert grid_size(742, 990, 224, 16) == (14, 19)
    assert grid_size(990, 742, 742, 14) == (71, 53)
    with pytest.raises(InvalidInput, match=f"{MAX_CELLS} cells"):
        grid_size(1, 100_000, 224, 16)


def test_batches_hold_one_size_and_change_nothing(photos: Path, encode: Encode) -> None:
    for k in range(5):
        width = 16 if k < 3 else 24
        blob(width, 16, (2 * k, 0, 2 * k + 4, 5)).save(photos / f"{k}.png")
    one, three = MeanColour(), MeanColour()
    _, apart = encode(photos, one)
    _, together = encode(photos, three, batch=2)
    assert (one.batches, three.batches) == ([1] * 5, [2, 1, 2])
    assert apart.keys() == together.keys() == set("01234")
    assert all(torch.equal(apart[view], together[view]) for view in apart)


def test_cells_are_unit_vectors_unless_asked_otherwise(photos: Path, encode: Encode) -> None:
    image = blob(16, 8, (8, 0, 16, 8))
    image.save(photos / "a.png")
    _, grids = encode(photos, normalised=True)
    lengths = grids["a"].float().norm(dim=-1)
    assert lengths[:, 0].max() == 0  # black has no direction
    torch.testing.assert_close(lengths[:, -1], torch.ones(2), atol=1e-3, rtol=0)


def test_what_float16_cannot_hold_is_float32(photos: Path, encode: Encode, tmp_path: Path) -> None:
    Image.new("RGB", (8, 8), (255, 255, 255)).save(photos / "bright.png")
    Image.new("RGB", (8, 8), (9, 9, 9)).save(photos / "dark.png")
    done, grids = encode(photos, MeanColour(scale=1e5))
    assert done.wide == ("bright",)
    assert grids["bright"].dtype == torch.float32 and grids["bright"].max() == 1e5
    assert grids["dark"].dtype == torch.float16


@pytest.mark.parametrize("scale", [float("nan"), float("inf"), 1e30])
def test_features_that_are_no_numbers_are_refused(scale: float, photos: Path, encode: Encode, tmp_path: Path) -> None:
    Image.new("RGB", (8, 8), (255, 255, 255)).save(photos / "a.png")
    with pytest.raises(InvalidFeatures, match="image 'a'"):
        encode(photos, MeanColour(scale))
    assert list((tmp_path / "out").iterdir()) == []


def test_sizes_below_a_patch_are_refused(photos: Path, encode: Encode) -> None:
    Image.new("RGB", (8, 8)).save(photos / "a.png")
    with pytest.raises(InvalidInput, match="at least a patch, 4 pixels"):
        encode(photos, size=3)


def test_views_are_named_after_their_images(photos: Path) -> None:
    for name in ("b.0001.JPG", "a.png", "._a.png", "notes.txt"):
        (photos / name).write_bytes(b"")
    assert find_images([photos]) == {"a": photos / "a.png", "b.0001": photos / "b.0001.JPG"}
    assert list(find_images([photos / "b.0001.JPG", photos / "a.png"])) == ["a", "b.0001"]
    (photos / "a.jpg").write_bytes(b"")
    with pytest.raises(InvalidInput, match="one image a view"):
        find_images([photos])


def test_images_of_sub_folders_keep_these_in_their_names(photos: Path) -> None:
    for name in ("camA/000.jpg", "camB/000.jpg", "camB/001.png", ".thumbnails/000.jpg"):
        (photos / name).parent.mkdir(exist_ok=True)
        (photos / name).write_bytes(b"")
    assert find_images([photos]) == {
        "camA/000": photos / "camA/000.jpg",
        "camB/000": photos / "camB/000.jpg",
        "camB/001": photos / "camB/001.png",
    }
    assert list(find_images([photos / "camB"])) == ["000", "001"]
    with pytest.raises(InvalidInput, match="one image a view"):
        find_images([photos / "camA", photos / "camB"])


def test_folders_without_images_and_nothing_at_all_are_refused(photos: Path) -> None:
    (photos / "notes.txt").write_bytes(b"")
    with pytest.raises(InvalidInput, match="1 other files"):
        find_images([photos])
    with pytest.raises(InvalidInput, match="nothing at"):
        find_images([photos / "none"])


def test_what_is_no_image_is_refused_by_name(photos: Path) -> None:
    whole = photos / "whole.png"
    blob(64, 64, (3, 3, 40, 50)).save(whole)
    bad = {"text.png": b"hello", "empty.png": b"", "cut.png": whole.read_bytes()[:-40]}
    for name, content in bad.items():
        (photos / name).write_bytes(content)
        with pytest.raises(InvalidInput, match=name):
            read_image(photos / name)
    Image.fromarray(np.ones((4, 4), np.float32)).save(photos / "float.tif")
    with pytest.raises(InvalidInput, match=r"float\.tif"):
        read_image(photos / "float.tif")


def test_decompression_bombs_are_refused(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.new("RGB", (64, 64)).save(photos / "a.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 3_000)
    assert read_image(photos / "a.png")[0].size == (64, 64)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1_000)
    with pytest.raises(InvalidInput, match="at most 2000 pixels"):
        read_image(photos / "a.png")
