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
from service.commands.demo import find_files, read_truth


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    scene = tmp_path / "scene"
    (scene / "sparse" / "0").mkdir(parents=True)
    (scene / "point_cloud.ply").write_bytes(b"ply\n")
    for name in ("cameras.bin", "images.bin"):
        (scene / "sparse" / "0" / name).write_bytes(b"model")
    save_file({"words": torch.ones(1)}, str(scene / "a.safetensors"))
    save_file({"v/grid": torch.ones(1, 1, 2)}, str(scene / "grids.safetensors"))
    objects = [{"class": name} for name in ("cat", "boat", "cow", "fish")]
    (scene / "truth.json").write_text(json.dumps({"objects": objects}))
    save_arrays({"v/mask": np.array([[0, -1, 3]], np.int16)}, str(scene / "truth.safetensors"))
    return scene


def test_a_scene_is_found_by_what_its_files_are(folder: Path, tmp_path: Path) -> None:
    files, truth = find_files(folder, tmp_path / "scratch"), read_truth(folder)
    assert {kind: path.name for kind, path in files.items()} == {
        "splats": "point_cloud.ply", "cameras": "cameras.zip", "features": "grids.safetensors"
    }  # fmt: skip
    assert zipfile.ZipFile(files["cameras"]).namelist() == ["cameras.bin", "images.bin"]
    assert truth is not None
    assert truth.questions == ("the cat",)  # the first of its objects
    masks = {"v": np.array([[True, False, True]])}
    assert truth.mean_iou("A Fish", masks) == truth.mean_iou("the fish", masks) == 0.5
    assert truth.mean_iou("the unknown", masks) is None
    assert truth.name_of(masks) == "cat"


def test_what_is_missing_is_named(folder: Path, tmp_path: Path) -> None:
    for missing, message in (("grids.safetensors", "features"), ("point_cloud.ply", "splats")):
        (folder / missing).unlink()
        with pytest.raises(InvalidInput, match=message):
            find_files(folder, tmp_path)
    with pytest.raises(InvalidInput, match="folder"):
        find_files(tmp_path / "none", tmp_path)
