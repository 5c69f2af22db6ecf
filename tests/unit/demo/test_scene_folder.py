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
from liftcore.text import BUILT_IN
from service.commands.demo import find_scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    scene = tmp_path / "scene"
    (scene / "sparse" / "0").mkdir(parents=True)
    (scene / "point_cloud.ply").write_bytes(b"ply\n")
    for name in ("cameras.bin", "images.bin"):
        (scene / "sparse" / "0" / name).write_bytes(b"model")
    save_file({"words": torch.ones(1)}, str(scene / "a.safetensors"))
    save_file(
        {"v/grid": torch.ones(1, 1, 2)},
        str(scene / "grids.safetensors"),
        metadata={"text_space": next(iter(BUILT_IN.values()))},
    )
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


def test_what_is_missing_is_named(folder: Path, tmp_path: Path) -> None:
    for missing, message in (("point_cloud.ply", "splats"), ("grids.safetensors", "features")):
        (folder / missing).unlink()
        with pytest.raises(InvalidInput, match=message):
            find_scene(folder, (), tmp_path)
    with pytest.raises(InvalidInput, match="folder"):
        find_scene(tmp_path / "none", (), tmp_path)
