"""Search of a scene folder for its files, and errors that name the missing ones."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file as save_arrays
from safetensors.torch import save_file

from liftcore.errors import InvalidInput
from liftcore.io.transforms import FRAME_FILE
from service.commands.demo import find_scene

INRIA_CAMERA = {
    "id": 0, "img_name": "v", "width": 4, "height": 3, "fx": 4.0, "fy": 4.0,
    "position": [0.0, 0.0, 0.0], "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    scene = tmp_path / "scene"
    (scene / "sparse" / "0").mkdir(parents=True)
    (scene / "point_cloud.ply").write_bytes(b"ply\n")
    for name in ("cameras.bin", "images.bin"):
        (scene / "sparse" / "0" / name).write_bytes(b"model")
    save_file({"words": torch.ones(1)}, str(scene / "a.safetensors"))
    save_file({"v/grid": torch.ones(1, 1, 2)}, str(scene / "grids.safetensors"), metadata={"text_space": "other"})
    objects = [{"class": name} for name in ("cat", "boat", "cow", "fish")]
    (scene / "truth.json").write_text(json.dumps({"objects": objects}))
    save_arrays({"v/mask": np.array([[0, -1, 3]], np.int16)}, str(scene / "truth.safetensors"))
    return scene


def test_a_scene_is_found_by_what_its_files_are(folder: Path, tmp_path: Path) -> None:
    scene = find_scene(folder, (), tmp_path / "scratch")
    assert scene.splats.name == "point_cloud.ply"
    assert scene.features.name == "grids.safetensors"
    assert scene.encoder == "lvis"
    assert zipfile.ZipFile(scene.cameras).namelist() == ["cameras.bin", "images.bin"]
    assert scene.phrases == ("the cat",)  # the first of its objects
    assert scene.views == ("v",)
    assert scene.truth is not None
    masks = {"v": np.array([[True, False, True]])}
    assert scene.truth.mean_iou("A Fish", masks) == scene.truth.mean_iou("the fish", masks) == 0.5
    assert scene.truth.mean_iou("the unknown", masks) is None
    assert scene.truth.name_of(masks) == "cat"


def test_cameras_go_up_with_the_frame_of_their_splats(folder: Path, tmp_path: Path) -> None:
    (folder / "transforms.json").touch()
    assert find_scene(folder, (), tmp_path / "scratch").cameras == folder / "transforms.json"
    (folder / FRAME_FILE).touch()
    packed = find_scene(folder, (), tmp_path / "scratch").cameras
    assert zipfile.ZipFile(packed).namelist() == ["transforms.json", FRAME_FILE]
    (folder / "transforms.json").unlink()
    packed = find_scene(folder, (), tmp_path / "scratch").cameras
    assert zipfile.ZipFile(packed).namelist() == ["cameras.bin", "images.bin", FRAME_FILE]


def test_phrases_of_the_user_come_first_and_a_table_is_the_encoder(folder: Path, tmp_path: Path) -> None:
    (folder / "text_table.safetensors").touch()
    (folder / "cameras.json").touch()
    (folder / "features.safetensors").write_bytes((folder / "grids.safetensors").read_bytes())
    scene = find_scene(folder, ["a whale"], tmp_path)
    assert scene.phrases == ("a whale",)
    assert scene.encoder == f"table:{folder / 'text_table.safetensors'}"
    assert (scene.cameras.name, scene.features.name) == ("cameras.json", "features.safetensors")


def test_what_is_missing_is_named(folder: Path, tmp_path: Path) -> None:
    for missing, message in (("point_cloud.ply", "splats"), ("grids.safetensors", "features")):
        (folder / missing).unlink()
        with pytest.raises(InvalidInput, match=message):
            find_scene(folder, (), tmp_path)
    with pytest.raises(InvalidInput, match="folder"):
        find_scene(tmp_path / "none", (), tmp_path)


def test_a_scene_without_its_truth_has_no_phrases(folder: Path, tmp_path: Path) -> None:
    (folder / "truth.json").unlink()
    (folder / "cameras.json").write_text(json.dumps([INRIA_CAMERA]))
    scene = find_scene(folder, (), tmp_path)
    assert (scene.phrases, scene.text_space, scene.views) == ((), "other", ("v",))


@pytest.mark.parametrize("space", ["none", "animals"])
def test_phrases_without_an_encoder_for_them_are_refused(folder: Path, tmp_path: Path, space: str) -> None:
    save_file({"v/grid": torch.ones(1, 1, 2)}, str(folder / "grids.safetensors"), metadata={"text_space": space})
    with pytest.raises(
        InvalidInput, match=rf"--ask: expected words .* as text_table.safetensors in .*space is {space}"
    ):
        find_scene(folder, ["a whale"], tmp_path)


def test_a_pack_that_names_no_text_space_has_the_words_of_the_table_beside_it(folder: Path, tmp_path: Path) -> None:
    save_file({"v/grid": torch.ones(1, 1, 2)}, str(folder / "grids.safetensors"))
    bare = find_scene(folder, (), tmp_path / "bare")
    assert (bare.phrases, bare.text_space) == ((), "")  # without a text space the demo queries nothing
    (folder / "text_table.safetensors").touch()
    assert find_scene(folder, (), tmp_path / "worded").phrases == ("the cat",)
