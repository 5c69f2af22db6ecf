"""`splatlift pack`: folders of other programs become packs, with warnings about suspicious content."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from liftcore.values.pack import read_features
from liftcore.values.views import Regions

from .command_line import assert_one_line, run

if TYPE_CHECKING:
    from pathlib import Path


def save(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, values)


def test_maps_are_packed_under_their_cameras_names_in_either_layout(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps, pack = tmp_path / "maps", tmp_path / "p.safetensors"
    for name in ("a.jpg", "b.PNG", "frame.0001", "camA/000", "camB/000.jpg", ".trash/000"):
        save(maps / f"{name}.npy", np.full((3, 4, 5), 2.0, np.float16))
    np.savez(maps / "c.npz", np.full((3, 4, 5), 2.0, np.float16))
    status, out, _ = run(capsys, "pack", "npy", maps, "-o", pack, "--layout", "chw", "--encoder-name", "toy")
    assert status == 0 and "6 views, 3 channels" in out
    assert "a.jpg.npy is 'a'" in out and "warning: unnormalised vectors" in out
    arguments = ["pack", "npy", maps, "-o", pack, "--encoder-name", "toy"]
    document = json.loads(run(capsys, *arguments, "--json")[1])
    assert document["renamed"] == {"a.jpg.npy": "a", "b.PNG.npy": "b", "camB/000.jpg.npy": "camB/000"}
    assert document["warnings"][0].startswith("unnormalised vectors:")
    packs = read_features(pack)
    assert (packs.views, packs.channels) == (("a", "b", "c", "camA/000", "camB/000", "frame.0001"), 5)
    save(maps / "a.npy", np.ones((3, 4, 5), np.float16))
    for folder, message in ((maps, "a.jpg.npy and a.npy, both of the view 'a'"), (maps / "a.npy", "folder")):
        status, out, err = run(capsys, "pack", "npy", folder, "-o", pack)
        assert (status, out) == (2, "") and message in err
        assert_one_line(err)


def test_masks_and_their_vectors_are_packed_and_no_input_is_written_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, pack = tmp_path / "masks", tmp_path / "p.safetensors"
    for camera in ("camA", "camB"):
        save(folder / camera / "a.jpg.npy", np.eye(2, 5, dtype=np.float16))
        Image.fromarray(np.array([[255, 0], [1, 1]], np.uint8)).save(folder / camera / "a.PNG", format="PNG")
    arguments = ["pack", "masks", folder, "--unlabelled", 255, "--encoder-name", "clip", "--normalised"]
    status, out, err = run(capsys, *arguments, "-o", pack)
    assert (status, err) == (0, "")
    assert "2 views, 5 channels" in out and "1 levels of 2x2" in out and "camA/a.jpg.npy is 'camA/a'" in out
    assert "sub-folders: camA, camB" in out
    regions = read_features(pack)["camA/a"]
    assert isinstance(regions, Regions)
    assert regions.labels.tolist() == [[[-1, 0], [1, 1]]]
    document = json.loads(run(capsys, *arguments, "-o", pack, "--json")[1])
    assert (document["views"], document["folders"], document["normalised"]) == (2, ["camA", "camB"], True)
    assert (document["sizes"], document["warnings"]) == (["1 levels of 2x2"], [])
    for name in ("a.PNG", "a.jpg.npy"):
        before = (folder / "camA" / name).read_bytes()
        status, _, err = run(capsys, *arguments, "-o", folder / "camA" / name)
        assert status == 2 and "another file than the inputs" in err
        assert (folder / "camA" / name).read_bytes() == before


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


def test_a_pack_is_named_anew_and_else_kept_to_the_byte(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "maps").mkdir()
    np.save(tmp_path / "maps" / "a.npy", np.arange(60, dtype=np.float32).reshape(3, 4, 5))
    pack, retagged = tmp_path / "p.safetensors", tmp_path / "n.safetensors"
    assert run(capsys, "pack", "npy", tmp_path / "maps", "-o", pack, "--encoder-name", "toy")[0] == 0
    status, out, _ = run(capsys, "pack", "retag", pack, "-o", retagged, "--text-space", "words")
    assert status == 0 and "encoder toy, text space words" in out
    before, after = read_features(pack), read_features(retagged)
    assert (before.text_space, after.text_space, after.encoder) == ("", "words", "toy")
    assert (after["a"].codebook == before["a"].codebook).all()
    assert re.search("text space +not named", run(capsys, "inspect", pack)[1])
    for wrong in (["retag", pack], ["retag", tmp_path / "maps" / "a.npy", "--text-space", "x"]):
        status, out, err = run(capsys, "pack", *wrong, "-o", tmp_path / "w.safetensors")
        assert (status, out) == (2, "") and not (tmp_path / "w.safetensors").exists()
        assert_one_line(err)


def test_what_nobody_annotated_or_decided_is_reported_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = [{"id": k, "file_name": f"{k}.jpg", "width": 4, "height": 3} for k in range(3)]
    mug = {"image_id": 0, "category_id": 1, "segmentation": [[0, 0, 2, 0, 2, 3, 0, 3]]}
    content = {"images": images, "annotations": [mug], "categories": [{"id": 1, "name": "mug"}]}
    (tmp_path / "coco").mkdir()
    (tmp_path / "coco" / "instances.json").write_text(json.dumps(content), encoding="utf-8")
    pack = tmp_path / "p.safetensors"
    status, out, _ = run(capsys, "pack", "prompts", tmp_path / "coco", "-o", pack)
    assert status == 0 and "1 views" in out and "2 of 3 images of instances.json" in out and "camera" not in out
    status, out, _ = run(capsys, "pack", "prompts", tmp_path / "coco", "-o", pack, "--unannotated", "negative")
    assert status == 0 and "3 views" in out and "instances.json" not in out
    (tmp_path / "labels").mkdir()
    Image.fromarray(np.array([[0, 1], [1, 255]], np.uint8)).save(tmp_path / "labels" / "a.png")
    (tmp_path / "names.json").write_text('{"1": "mug"}', encoding="utf-8")
    arguments = ["pack", "prompts", tmp_path / "labels", "--names", tmp_path / "names.json", "-o", pack]
    status, out, err = run(capsys, *arguments)
    assert (status, out) == (2, "") and "--unlabelled 255" in err
    assert run(capsys, *arguments, "--unlabelled", 255)[0] == 0
    regions = read_features(pack)["a"]
    assert isinstance(regions, Regions)
    assert regions.labels.tolist() == [[[1, 0], [0, -1]]]  # the last row is of what is no mug


@pytest.mark.parametrize(("levels", "names"), [(4, ["default", "s", "m", "l"]), (1, [])])
def test_levels_of_langsplat_are_named_where_all_four_are_there(
    levels: int, names: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, pack = tmp_path / "features", tmp_path / "p.safetensors"
    save(folder / "a_s.npy", np.broadcast_to(np.arange(levels)[:, None, None], (levels, 2, 2)).astype(np.float32))
    save(folder / "a_f.npy", np.eye(levels, 5, dtype=np.float16))
    assert run(capsys, "pack", "langsplat", folder, "-o", pack)[0] == 0
    assert json.loads(run(capsys, "inspect", pack, "--json")[1])["level_names"] == names
