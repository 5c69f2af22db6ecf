"""Photos become grids of whole patches; encoders give the values of their libraries, at the right cells."""

from __future__ import annotations

import socket
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps
from safetensors.torch import save_file
from torch import Tensor, nn

from liftcore.errors import InvalidFeatures, InvalidInput, Unavailable
from liftcore.features.encoders import Pixels, open_image_encoder
from liftcore.features.encoders.clip import ClipImageEncoder, resnet_values, vit_values
from liftcore.features.encoders.encode import MAX_CELLS, encode_images, find_images, grid_size, read_image
from liftcore.features.encoders.timm_backbone import TimmEncoder
from liftcore.io.photos import Reading, read_header
from liftcore.text import open_clip as weights
from liftcore.text.open_clip import OpenedModel, library
from liftcore.values.pack import read_features
from liftcore.values.views import FeatureGrid

pytestmark = pytest.mark.slow

ORIENTATION = 0x0112


class MeanColour:
    """Three channels: the mean colour of each patch."""

    name, text_space, channels = "mean colour", "none", 3
    pixels = Pixels(patch=4, shorter=8, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0), interpolation="bilinear")

    def __init__(self, scale: float = 1.0) -> None:
        self.scale = scale

    def encode(self, images: Tensor) -> Tensor:
        return self.scale * torch.nn.functional.avg_pool2d(images, 4).permute(0, 2, 3, 1)


Encode = Callable[..., tuple[list[str], dict[str, Tensor]]]


@pytest.fixture
def encode(tmp_path: Path) -> Encode:
    def run(folder: Path, encoder: MeanColour | None = None, **options: Any) -> tuple[list[str], dict[str, Tensor]]:
        out = tmp_path / "out" / "pack.safetensors"
        options = {"normalised": False, "progress": False, **options}
        report = encode_images(folder, out, encoder or MeanColour(), **options)
        assert [path.name for path in out.parent.iterdir()] == [out.name]
        packs = read_features(out)
        grids = {}
        for view in packs.views:
            observed = packs[view]
            assert isinstance(observed, FeatureGrid)
            grids[view] = observed.grid
        return report["warnings"], grids

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


def test_a_blob_lights_the_cell_that_it_lies_in_as_the_photo_is_stored(photos: Path, encode: Encode) -> None:
    upright = blob(60, 40, (50, 0, 60, 10))  # the right upper corner
    upright.save(photos / "a.png")
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    upright.save(photos / "tagged.png", exif=exif)
    warnings, grids = encode(photos)
    assert any("1 of 2 photos (tagged) were read as stored" in text for text in warnings)
    for grid in grids.values():
        assert grid.shape == (2, 3, 3) and grid.dtype == torch.float16
        assert int(grid.sum(dim=-1).argmax()) == 2 and grid[1].max() == 0


TURNS = {  # what a stored photo is, of the one that EXIF's orientation shows
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: image.swapaxes(0, 1),
    6: np.rot90,
    7: lambda image: image[::-1, ::-1].swapaxes(0, 1),
    8: lambda image: np.rot90(image, 3),
}


@pytest.mark.parametrize("suffix", [".jpg", ".webp", ".tif"])
@pytest.mark.parametrize("tag", TURNS)
def test_a_photo_is_read_in_the_orientation_of_its_camera(tag: int, suffix: str, tmp_path: Path) -> None:
    upright = np.zeros((48, 64, 3), np.uint8)
    upright[:16, :16], upright[:16, -16:] = (255, 0, 0), (0, 255, 0)  # two corners distinguish all eight orientations
    stored, path, exif = np.ascontiguousarray(TURNS[tag](upright)), tmp_path / f"a{suffix}", Image.Exif()
    exif[ORIENTATION] = tag
    options: dict[str, Any] = (
        {"quality": 95, "subsampling": 0} if suffix == ".jpg" else {"lossless": True} if suffix == ".webp" else {}
    )
    Image.fromarray(stored).save(path, exif=exif, **options)
    across = stored.shape[0] > stored.shape[1]
    for size, expected in (
        (None, stored),
        (stored.shape[1::-1], stored),
        ((640, 480), upright if across else stored),
    ):
        image, reading = read_image(path, size)
        assert np.abs(np.asarray(image).astype(int) - expected).max() < 20
        assert reading is (
            Reading.UPRIGHT if tag == 1 else Reading.ORIENTED if expected is upright and across else Reading.STORED
        )
    assert read_header(path).oriented == (64, 48)
    with Image.open(path) as image:
        assert np.abs(np.asarray(ImageOps.exif_transpose(image)).astype(int) - upright).max() < 20


def test_every_kind_of_picture_has_its_colours(photos: Path, encode: Encode) -> None:
    greys = {"L": 128, "LA": (128, 255), "RGBA": (128, 128, 128, 255), "CMYK": (127, 127, 127, 0)}
    for mode, value in greys.items():
        Image.new(mode, (8, 8), value).save(photos / f"{mode}.{'tif' if mode == 'CMYK' else 'png'}")
    Image.fromarray(np.full((8, 8), 32_896, np.uint16)).save(photos / "I16.png")
    red = Image.new("P", (8, 8), 1)
    red.putpalette([0, 0, 0, 255, 0, 0])
    red.save(photos / "red.png")
    Image.new("1", (8, 8), 1).save(photos / "white.png")
    Image.new("RGBA", (8, 8), (0, 0, 0, 0)).save(photos / "nothing.png")
    _, grids = encode(photos)
    for name in (*greys, "I16"):
        assert (grids[name].float() - 0.502).abs().max() < 0.01, name
    assert grids["red"][0, 0].tolist() == [1, 0, 0]
    assert grids["white"].min() == 1
    assert grids["nothing"].min() == 1  # transparent pixels show white


def test_images_of_any_size_become_whole_patches_of_the_shorter_side(photos: Path, encode: Encode) -> None:
    expected_shapes = {(1, 1): (2, 2), (3, 1): (2, 6), (7, 90): (26, 2), (9, 8): (2, 2)}
    for width, height in expected_shapes:
        Image.new("RGB", (width, height), (255, 0, 0)).save(photos / f"{width}x{height}.png")
    _, grids = encode(photos)
    for (width, height), shape in expected_shapes.items():
        grid = grids[f"{width}x{height}"]
        assert tuple(grid.shape[:2]) == shape
        assert grid[..., 0].min() == 1 and grid[..., 1:].max() == 0
    assert grid_size(990, 742, 224, 16) == (19, 14)
    assert grid_size(742, 990, 224, 16) == (14, 19)
    assert grid_size(990, 742, 742, 14) == (71, 53)
    with pytest.raises(InvalidInput, match=f"{MAX_CELLS} cells"):
        grid_size(1, 100_000, 224, 16)
    with pytest.raises(InvalidInput, match="at least a patch, 4 pixels"):
        encode(photos, size=3)


def test_what_float16_cannot_hold_is_float32_and_what_is_no_number_refused(
    photos: Path, encode: Encode, tmp_path: Path
) -> None:
    Image.new("RGB", (8, 8), (255, 255, 255)).save(photos / "bright.png")
    Image.new("RGB", (8, 8), (9, 9, 9)).save(photos / "dark.png")
    warnings, grids = encode(photos, MeanColour(scale=1e5))
    assert any(text.startswith("1 views have features beyond float16") for text in warnings)
    assert grids["bright"].dtype == torch.float32 and grids["bright"].max() == 1e5
    assert grids["dark"].dtype == torch.float16
    before = (tmp_path / "out" / "pack.safetensors").read_bytes()
    for scale in (float("nan"), 1e30):
        with pytest.raises(InvalidFeatures, match="image 'bright'"):
            encode(photos, MeanColour(scale))
    assert [path.read_bytes() for path in (tmp_path / "out").iterdir()] == [before]


def test_views_are_named_after_their_images_and_sub_folders(photos: Path) -> None:
    names = ("a.png", "b.0001.JPG", "camA/000.jpg", "camB/000.jpg", "camB/001.png")
    for name in (*names, "._a.png", "notes.txt", ".thumbnails/000.jpg", "notes/notes.txt"):
        (photos / name).parent.mkdir(exist_ok=True)
        (photos / name).write_bytes(b"")
    assert find_images([photos]) == {name.rpartition(".")[0]: photos / name for name in names}
    assert list(find_images([photos / "b.0001.JPG", photos / "a.png"])) == ["a", "b.0001"]
    assert list(find_images([photos / "camB"])) == ["000", "001"]
    (photos / "a.jpg").write_bytes(b"")
    for paths, message in (
        ([photos], "one image a view"),
        ([photos / "camA", photos / "camB"], "one image a view"),
        ([photos / "notes"], "1 other files"),
        ([photos / "none"], "nothing at"),
    ):
        with pytest.raises(InvalidInput, match=message):
            find_images(paths)


PATCH, SIDE, WIDTH, F = 8, 32, 24, 10


def small_vit(**options: Any) -> Any:
    library()
    from open_clip.transformer import VisionTransformer

    torch.manual_seed(3)
    return VisionTransformer(SIDE, PATCH, WIDTH, 3, 2, 2.0, output_dim=F, **options).eval()


def small_resnet() -> Any:
    library()
    from open_clip.modified_resnet import ModifiedResNet

    torch.manual_seed(4)
    tower = ModifiedResNet([1, 1, 1, 1], output_dim=F, heads=2, image_size=64, width=4).eval()
    for name, weight in tower.named_parameters():
        if name.endswith("bn3.weight"):  # zero at first, which would hide the blocks' own paths
            nn.init.ones_(weight)
    return tower


class Holder(nn.Module):
    """The part of a CLIP model that an image encoder uses."""

    def __init__(self, visual: Any) -> None:
        super().__init__()
        self.visual = visual


def small_encoder(tower: Any) -> ClipImageEncoder:
    model = OpenedModel("open_clip:small/tag", "", "small", Holder(tower))
    return ClipImageEncoder(model, torch.device("cpu"))


@cache
def backbone(name: str) -> TimmEncoder:
    torch.manual_seed(5)
    options = {"dynamic_img_size": True} if name == "test_vit" else {}
    weights.import_torchvision()
    timm = import_module("timm")
    return TimmEncoder(name, timm.create_model(name, num_classes=0, **options), torch.device("cpu"))


def test_maskclip_is_the_last_attention_when_each_token_sees_itself_alone() -> None:
    tower = small_vit()
    images = torch.randn(2, 3, SIDE, SIDE)
    with torch.no_grad():
        tokens = tower._embeds(images)
        *blocks, last = tower.transformer.resblocks
        for block in blocks:
            tokens = block(tokens)
        mask = ~torch.eye(tokens.shape[1], dtype=torch.bool)
        normed = last.ln_1(tokens)
        attention, _ = last.attn(normed, normed, normed, attn_mask=mask)
        expected = (tower.ln_post(attention) @ tower.proj)[:, 1:].reshape(2, 4, 4, F)
        torch.testing.assert_close(vit_values(tower, images), expected)


ENCODERS = {
    "maskclip ViT": lambda: small_encoder(small_vit()),
    "maskclip ResNet": lambda: small_encoder(small_resnet()),
    "timm ViT": lambda: backbone("test_vit"),
    "timm ResNet": lambda: backbone("resnet18"),
}


def test_resnet_values_are_what_the_pool_gives_for_equal_cells() -> None:
    tower = small_resnet()
    nn.init.zeros_(tower.attnpool.positional_embedding)
    images = torch.randn(1, 3, 64, 96)
    with torch.no_grad():
        grid = resnet_values(tower, images)
        cells = tower.layer4(tower.layer3(tower.layer2(tower.layer1(tower.stem(images)))))
        assert grid.shape == (1, 2, 3, F)
        for row, column in np.ndindex(2, 3):
            equal_cells = cells[:, :, row, column, None, None].expand(-1, -1, 2, 2)
            torch.testing.assert_close(grid[:, row, column], tower.attnpool(equal_cells))


@pytest.mark.parametrize("kind", ENCODERS)
def test_a_change_in_a_patch_moves_its_own_cell_most(kind: str) -> None:
    torch.manual_seed(0)
    encoder = ENCODERS[kind]()
    patch, (rows, columns) = encoder.pixels.patch, (4, 5)
    images = torch.randn(1, 3, rows * patch, columns * patch)
    before = encoder.encode(images)
    assert before.shape == (1, rows, columns, encoder.channels)
    assert before.dtype == torch.float32
    for row, column in ((1, 3), (2, 1)):
        spotted = images.clone()
        spotted[..., row * patch : (row + 1) * patch, column * patch : (column + 1) * patch] *= -1
        batch = encoder.encode(torch.cat([images, spotted]))
        torch.testing.assert_close(batch[:1], before, atol=1e-4, rtol=1e-4)  # independent of the rest of the batch
        change = (batch[1] - batch[0]).norm(dim=-1)
        assert divmod(int(change.argmax()), columns) == (row, column)


def test_cells_of_a_resnet_are_brought_back_to_their_patches() -> None:
    """Without this shift cells are 15.5 pixels off, and a patch also changes the cell below and right of it."""
    resnet, images = backbone("resnet18"), torch.randn(4, 3, 5 * 32, 5 * 32)
    spotted = images.clone()
    spotted[..., 64:96, 64:96] += torch.randn(4, 3, 32, 32)
    change = (resnet.encode(spotted) - resnet.encode(images)).square().sum(dim=(0, 3))
    for axis in (0, 1):
        middle = (change.sum(dim=1 - axis) * torch.arange(5.0)).sum() / change.sum()
        assert abs(float(middle) - 2) < 0.1


def test_weights_from_a_file_give_the_same_features(tmp_path: Path) -> None:
    vit = backbone("test_vit")
    state = {key: value.contiguous() for key, value in vit._model.state_dict().items()}
    head = {"head.weight": torch.zeros(1000, 64), "head.bias": torch.zeros(1000)}
    save_file(state | head, str(tmp_path / "vit.safetensors"))
    torch.save({"model": state}, tmp_path / "vit.pth")
    images = torch.randn(1, 3, 32, 48)
    for name in ("vit.safetensors", "vit.pth"):
        encoder = open_image_encoder(f"timm:test_vit@{tmp_path / name}")
        assert torch.equal(encoder.encode(images), vit.encode(images))
        assert (encoder.name, encoder.text_space) == ("timm:test_vit", "none")
    save_file({**state, "blocks.99.weight": torch.zeros(1)}, str(tmp_path / "more.safetensors"))
    del state["cls_token"]
    save_file(state, str(tmp_path / "less.safetensors"))
    for name, message in (("more", "an unexpected blocks.99"), ("less", "cls_token")):
        with pytest.raises(InvalidInput, match=message):
            open_image_encoder(f"timm:test_vit@{tmp_path / name}.safetensors")


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("sam:vit", "one of maskclip"),
        ("featup:dino", "pack npy"),
        ("maskclip:ViT-B-33/openai", "ViT-B-32"),
        ("maskclip:ViT-B-32/nothing", "one of the tags"),
        (f"timm:resnet18@{__file__}", "ending in"),
        ("maskclip:ViT-S-32-alt@{code}", "only tensors of"),
    ],
)
def test_what_is_no_encoder_is_refused_and_no_code_is_run(spec: str, message: str, tmp_path: Path) -> None:
    torch.save({"state_dict": Path("code")}, tmp_path / "code.pt")
    with pytest.raises(InvalidInput, match=message):
        open_image_encoder(spec.format(code=tmp_path / "code.pt"))


def test_missing_weights_and_devices_are_unavailable_and_never_random() -> None:
    for spec, message in (("maskclip:ViT-B-32", "tag or a file"), ("timm:resnet18@/no/such.pth", "nothing at")):
        with pytest.raises(Unavailable, match=message):
            open_image_encoder(spec)
    for device in ("cuda:99", "nonsense"):
        with pytest.raises(Unavailable, match=r"^device"):
            open_image_encoder("timm:resnet18", device)


@pytest.mark.parametrize("spec", ["maskclip:ViT-B-32/openai", "timm:resnet18.a1_in1k"])
def test_weights_are_asked_of_the_cache_and_once_of_the_network(
    spec: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with socket.create_server(("127.0.0.1", 0)) as silent:  # which takes connections and never answers
        silent.setblocking(False)
        monkeypatch.setattr(constants, "ENDPOINT", f"http://127.0.0.1:{silent.getsockname()[1]}")
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
        monkeypatch.setattr(weights, "SECONDS", 0.3)
        with pytest.raises(Unavailable, match=r"did not respond within 0\.3 s; .*use .*@FILE"):
            open_image_encoder(spec)
        silent.accept()[0].close()
        with pytest.raises(BlockingIOError):
            silent.accept()
    assert weights.fetch_weights("x", lambda: 7, "") == 7  # nothing is downloaded if it is cached


def small_trunk(name: str, pool: str, proj: Any) -> Any:
    library()
    from open_clip.timm_model import TimmModel

    torch.manual_seed(8)
    return TimmModel(name, F, image_size=64, pool=pool, proj=proj).eval()


def test_towers_without_dense_features_are_refused() -> None:
    for tower, message in (
        (small_vit(attentional_pool=True, attn_pooler_heads=2), "attention pooler"),
        (small_trunk("vit_tiny_patch16_224", "map", "none"), "TimmModel; encode crops of masks"),  # as SigLIP has it
    ):
        with pytest.raises(InvalidInput, match=message):
            small_encoder(tower)
    with pytest.raises(InvalidInput, match="any size"):
        backbone("mixer_s32_224")
