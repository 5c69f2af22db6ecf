"""`splatlift pack`: folders of other programs become packs, and what looks wrong in them is said."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from liftcore.features.pack import read_features
from liftcore.features.views import Regions

from .command_line import assert_one_line, run

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


def test_langsplat_folder_is_packed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "language_features"
    folder.mkdir()
    np.save(folder / "a_s.npy", np.zeros((4, 2, 2), np.float32))
    np.save(folder / "a_f.npy", np.ones((1, 5), np.float32))
    options = ["--encoder-name", "clip", "--text-space", "open_clip:ViT-B-16", "--normalised", "--json"]
    status, out, err = run(capsys, "pack", "langsplat", folder, "-o", tmp_path / "p.safetensors", *options)
    assert (status, err) == (0, "")
    document = json.loads(out)
    assert (document["views"], document["channels"], document["normalised"]) == (1, 5, True)
    assert document["text_space"] == "open_clip:ViT-B-16"
    (folder / "a_f.npy").unlink()
    status, out, err = run(capsys, "pack", "langsplat", folder, "-o", tmp_path / "q.safetensors")
    assert (status, out) == (2, "")
    assert_one_line(err)
    assert not (tmp_path / "q.safetensors").exists()


def test_arrays_are_packed_in_either_layout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "maps").mkdir()
    np.save(tmp_path / "maps" / "a.npy", np.ones((3, 4, 5), np.float16))
    for layout, channels in (("hwc", 5), ("chw", 3)):
        out = tmp_path / f"{layout}.safetensors"
        status, text, _ = run(capsys, "pack", "npy", tmp_path / "maps", "-o", out, "--layout", layout)
        assert status == 0
        assert f"1 views, {channels} channels" in text
        assert read_features(out).channels == channels


def test_maps_named_after_whole_images_are_packed_under_their_cameras_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "maps").mkdir()
    for name in ("a.jpg.npy", "b.PNG.npy", "frame.0001.npy"):
        np.save(tmp_path / "maps" / name, np.full((3, 4, 5), 2.0, np.float16))
    arguments = ["pack", "npy", tmp_path / "maps", "-o", tmp_path / "p.safetensors", "--encoder-name", "toy"]
    status, out, _ = run(capsys, *arguments)
    assert status == 0
    assert "a.jpg.npy is 'a'" in out
    assert "warning: unnormalised vectors" in out
    status, out, _ = run(capsys, *arguments, "--json")
    document = json.loads(out)
    assert document["renamed"] == {"a.jpg.npy": "a", "b.PNG.npy": "b"}
    assert [text.split(":")[0] for text in document["warnings"]] == ["unnormalised vectors"]
    assert read_features(tmp_path / "p.safetensors").views == ("a", "b", "frame.0001")


def test_maps_of_a_rig_keep_their_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("camA/000.npy", "camB/000.jpg.npy", ".trash/000.npy"):
        (tmp_path / "maps" / name).parent.mkdir(parents=True)
        np.save(tmp_path / "maps" / name, np.ones((3, 4, 5), np.float16))
    arguments = ["pack", "npy", tmp_path / "maps", "-o", tmp_path / "p.safetensors", "--json"]
    status, out, _ = run(capsys, *arguments)
    assert (status, json.loads(out)["renamed"]) == (0, {"camB/000.jpg.npy": "camB/000"})
    assert read_features(tmp_path / "p.safetensors").views == ("camA/000", "camB/000")
    arguments[4] = tmp_path / "maps" / "camA" / "000.npy"
    status, out, err = run(capsys, *arguments)
    assert (status, out) == (2, "")
    assert_one_line(err)


def test_masks_of_a_rig_keep_their_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in ("camA", "camB"):
        (tmp_path / "rig" / folder).mkdir(parents=True)
        np.save(tmp_path / "rig" / folder / "000_s.npy", np.zeros((1, 2, 2), np.int32))
        np.save(tmp_path / "rig" / folder / "000_f.npy", np.ones((1, 5), np.float32))
    status, _, _ = run(capsys, "pack", "langsplat", tmp_path / "rig", "-o", tmp_path / "p.safetensors")
    assert status == 0
    assert read_features(tmp_path / "p.safetensors").views == ("camA/000", "camB/000")


def test_two_maps_of_one_view_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "maps").mkdir()
    for name in ("a.npy", "a.jpg.npy"):
        np.save(tmp_path / "maps" / name, np.ones((3, 4, 5), np.float16))
    status, out, err = run(capsys, "pack", "npy", tmp_path / "maps", "-o", tmp_path / "p.safetensors")
    assert (status, out) == (2, "")
    assert_one_line(err)
    assert "a.jpg.npy and a.npy, both of the view 'a'" in err


def test_masks_and_their_vectors_are_packed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "masks"
    folder.mkdir()
    labels = np.array([[255, 0], [1, 1]], np.uint8)
    Image.fromarray(labels).save(folder / "a.png")
    np.save(folder / "a.jpg.npy", np.eye(2, 5, dtype=np.float16))
    pack = tmp_path / "p.safetensors"
    options = ["--encoder-name", "clip", "--text-space", "open_clip:ViT-B-16", "--normalised"]
    status, out, err = run(capsys, "pack", "masks", folder, "-o", pack, "--unlabelled", 255, *options)
    assert (status, err) == (0, "")
    assert "1 views, 5 channels" in out and "1 levels of 2x2" in out and "a.jpg.npy is 'a'" in out
    regions = read_features(pack)["a"]
    assert isinstance(regions, Regions)
    assert regions.labels.tolist() == [[[-1, 0], [1, 1]]]
    status, out, _ = run(capsys, "pack", "masks", folder, "-o", pack, "--unlabelled", 255, *options, "--json")
    document = json.loads(out)
    assert (document["views"], document["text_space"], document["normalised"]) == (1, "open_clip:ViT-B-16", True)
    assert (document["sizes"], document["warnings"]) == (["1 levels of 2x2"], [])


def test_masks_that_do_not_fit_write_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "a.npy", np.eye(2, 5, dtype=np.float16))
    (tmp_path / "a.json").write_text("[]", encoding="utf-8")
    for pack, message in ((tmp_path / "p.safetensors", "2 masks, one a vector"), (tmp_path / "a.json", "the inputs")):
        status, out, err = run(capsys, "pack", "masks", tmp_path, "-o", pack)
        assert (status, out) == (2, "")
        assert_one_line(err)
        assert message in err
    assert not (tmp_path / "p.safetensors").exists()
    for value in ("-1", "65536", "x", "1" * 5000):
        status, out, err = run(capsys, "pack", "masks", tmp_path, "-o", "p.safetensors", f"--unlabelled={value}")
        assert (status, out) == (2, "")
        assert "a whole number from 0 to 65535" in err


def test_sub_folders_are_told_and_no_input_is_written_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "masks"
    for camera in ("camA", "camB"):
        (folder / camera).mkdir(parents=True)
        np.save(folder / camera / "0.npy", np.ones((1, 3), np.float32))
        Image.fromarray(np.ones((2, 2), np.uint8)).save(folder / camera / "0.PNG", format="PNG")
    status, out, _ = run(capsys, "pack", "masks", folder, "-o", tmp_path / "p.safetensors")
    assert status == 0
    assert "of sub-folders, whose names are part of their views': camA, camB" in out
    for name in ("0.PNG", "0.npy"):
        before = (folder / "camA" / name).read_bytes()
        status, _, err = run(capsys, "pack", "masks", folder, "-o", folder / "camA" / name)
        assert status == 2 and "another file than the inputs" in err
        assert (folder / "camA" / name).read_bytes() == before


def test_a_pack_is_named_anew_and_else_kept_to_the_byte(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "maps").mkdir()
    np.save(tmp_path / "maps" / "a.npy", np.arange(60, dtype=np.float32).reshape(3, 4, 5))
    pack, named = tmp_path / "p.safetensors", tmp_path / "n.safetensors"
    assert run(capsys, "pack", "npy", tmp_path / "maps", "-o", pack, "--encoder-name", "toy")[0] == 0
    status, out, _ = run(capsys, "pack", "retag", pack, "-o", named, "--text-space", "minilm")
    assert status == 0 and "encoder toy, text space minilm" in out
    before, after = read_features(pack), read_features(named)
    assert (before.text_space, after.text_space, after.encoder) == ("", "minilm", "toy")
    assert (after["a"].codebook == before["a"].codebook).all()
    assert re.search("text space +not named", run(capsys, "inspect", pack)[1])
    for wrong in (["retag", pack], ["retag", tmp_path / "maps" / "a.npy", "--text-space", "x"]):
        status, out, err = run(capsys, "pack", *wrong, "-o", tmp_path / "w.safetensors")
        assert (status, out) == (2, "") and not (tmp_path / "w.safetensors").exists()
        assert_one_line(err)
