"""``splatlift encode`` from photos to a lift that can be queried by words, with random weights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image, ImageOps

from liftcore.values.pack import read_features
from liftcore.values.views import FeatureGrid
from tests.tiny_scene import make_scene

from .command_line import assert_one_line, run

pytestmark = pytest.mark.slow


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for k, name in enumerate(["left.png", "middle.jpg", "right.png"]):
        Image.effect_noise((64, 48), 40 + 10 * k).convert("RGB").save(folder / name)
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from liftcore.text.open_clip import create_model

    torch.manual_seed(5)
    path = tmp_path_factory.mktemp("weights") / "clip.pt"
    torch.save(create_model("ViT-S-32-alt", None).state_dict(), path)
    return path


def test_encoded_photos_are_lifted_and_asked_in_the_text_space_of_their_pack(
    photos: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    (photos / "camA").mkdir()  # one of other photos, which no camera is of
    Image.new("RGB", (64, 48)).save(photos / "camA" / "turned.jpg", exif=exif)
    pack, lifted = tmp_path / "pack.safetensors", tmp_path / "lift.safetensors"
    options = ["--encoder", f"maskclip:ViT-S-32-alt@{weights}", "--size", 64, "--batch", 2, "--json"]
    status, out, err = run(capsys, "encode", photos, "-o", pack, *options)
    assert (status, err) == (0, "")
    document = json.loads(out)
    assert (document["views"], document["channels"], document["patch"], document["size"]) == (4, 256, 32, 64)
    assert document["text_space"] == f"open_clip:ViT-S-32-alt@{weights}" and document["folders"] == ["camA"]
    (warning,) = document["warnings"]
    assert warning.startswith("1 of 4 photos (camA/turned) were read as stored")
    packs = read_features(pack)
    assert (packs.views, packs.normalised) == (("camA/turned", "left", "middle", "right"), True)
    assert packs.encoder == "maskclip:ViT-S-32-alt"
    observed = packs["left"]
    assert isinstance(observed, FeatureGrid)
    assert observed.grid.shape == (2, 3, 256)
    scene = make_scene()
    (tmp_path / "scene.ply").write_bytes(scene.splats)
    (tmp_path / "cameras.json").write_bytes(scene.cameras)
    files = [tmp_path / "scene.ply", tmp_path / "cameras.json", pack]
    assert run(capsys, "lift", *files, "-o", lifted, "--preset", "row-sum")[0] == 0
    status, out, err = run(capsys, "query", lifted, "an apple", "--json")
    assert (status, err) == (0, "")
    assert json.loads(out)["encoder"] == "open_clip:ViT-S-32-alt"


def test_masks_get_vectors_of_their_crops(
    photos: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    masks, pack = tmp_path / "masks", tmp_path / "pack.safetensors"
    masks.mkdir()
    planes = np.zeros((3, 24, 32), bool)  # half of the photos' size; two overlap
    planes[0, 2:20, 3:9], planes[1, 5:12, 4:30], planes[2, 20:, 20:] = True, True, True
    ids = np.full((48, 64), 255, np.uint8)
    ids[10:30, 20:50] = 0
    np.save(masks / "left_masks.npy", planes)
    Image.fromarray(ids).save(masks / "middle.png")
    np.save(masks / "right_masks.npy", np.pad(np.full((4, 4), 1, np.uint8), 10))  # ids: 0 around, and 1
    command = ["pack", "masks", masks, "-o", pack, "--unlabelled", 255]
    command += ["--encoder", f"open_clip:ViT-S-32-alt@{weights}"]
    status, out, err = run(capsys, *command, "--photos", photos, "--json")
    assert (status, err) == (0, "")
    document = json.loads(out)
    assert (document["views"], document["channels"], document["normalised"]) == (3, 256, True)
    assert document["text_space"] == f"open_clip:ViT-S-32-alt@{weights}" and "crops of masks" in document["encoder"]
    import open_clip

    model_and_transforms: Any = open_clip.create_model_and_transforms("ViT-S-32-alt", pretrained=str(weights))
    model, _, prepare = model_and_transforms
    model.eval()
    packs = read_features(pack)
    for view, suffix, number, inside in [
        *(("left", "png", k, plane.repeat(2, 0).repeat(2, 1)) for k, plane in enumerate(planes)),
        ("middle", "jpg", 0, ids == 0),
    ]:
        with Image.open(photos / f"{view}.{suffix}") as photo:
            masked_photo = np.where(inside[..., None], np.asarray(photo.convert("RGB")), 0)
        rows, columns = np.flatnonzero(inside.any(1)), np.flatnonzero(inside.any(0))
        crop = Image.fromarray(masked_photo[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])
        with torch.no_grad():
            vector = model.encode_image(prepare(ImageOps.pad(crop, (224, 224)))[None])[0]
        actual = packs[view].codebook[number].float()
        assert torch.allclose(actual, torch.nn.functional.normalize(vector, dim=0), atol=2e-3)
    tagged, exif = tmp_path / "tagged", Image.Exif()
    tagged.mkdir()
    exif[ExifTags.Base.Orientation] = 6  # of photos whose masks and cameras are of stored pixels
    for path in photos.iterdir():
        with Image.open(path) as photo:
            photo.save(tagged / f"{path.stem}.png", exif=exif)
    status, out, _ = run(
        capsys, *command[:4], tmp_path / "again.safetensors", *command[5:], "--photos", tagged, "--json"
    )
    assert status == 0 and "3 of 3 photos (" in json.loads(out)["warnings"][0]
    tagged_pack = read_features(tmp_path / "again.safetensors")
    assert all(torch.equal(tagged_pack[view].codebook, packs[view].codebook) for view in ("left", "right"))
    for arguments, message in (
        (command, "--photos"),
        ([*command, "--photos", photos / "right.png"], "a photo with the name of each view"),
        ([*command[:-2], "--photos", photos], "--encoder"),
        ([*command, "--photos", photos, "--no-normalised"], "--no-normalised"),
        ([*command[:-1], "timm:resnet18", "--photos", photos], "open_clip:MODEL/TAG"),
    ):
        status, _, err = run(capsys, *arguments)
        assert status == 2 and message in err
    np.save(masks / "left.npy", np.ones((3, 4), np.float32))
    assert "without vectors" in run(capsys, *command, "--photos", photos)[2]


def test_backbones_without_words_say_so(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from liftcore.features.encoders.timm_backbone import TimmEncoder

    torch.manual_seed(6)
    weights, pack = tmp_path / "resnet.pt", tmp_path / "pack.safetensors"
    torch.save(TimmEncoder._with_random_weights("test_resnet")._model.state_dict(), weights)
    options = ["--encoder", f"timm:test_resnet@{weights}", "--no-normalised"]
    status, out, err = run(capsys, "encode", photos / "left.png", "-o", pack, *options)
    assert (status, err) == (0, "")
    assert "1 views, 96 channels" in out and "no text space" in out
    packs = read_features(pack)
    assert (packs.text_space, packs.normalised, packs.encoder) == ("none", False, "timm:test_resnet")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--encoder", "maskclip:ViT-B-32"], "tag or a file"),
        (["--encoder", "magic"], "one of maskclip"),
        (["--encoder", "timm:resnet18", "--size", "0"], "--size"),
        (["--encoder", "timm:resnet18", "--device", "abacus"], "--device"),
        (["--encoder", "maskclip:ViT-B-32@a.pt", "--weights", "b.pt"], "without weights in its name"),
        (["--encoder", "timm:resnet18", "-o", "{photos}/left.png"], "another file than the inputs"),
        ([], "--encoder"),
    ],
)
def test_what_cannot_be_encoded_exits_2_with_one_line(
    options: list[str], message: str, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [text.format(photos=photos) for text in options]
    status, out, err = run(capsys, "encode", photos, "-o", tmp_path / "pack.safetensors", *arguments)
    assert (status, out) == (2, "")
    assert message in err
    assert_one_line(err)
    assert not (tmp_path / "pack.safetensors").exists()
