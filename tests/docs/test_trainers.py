"""What the guide says of scenes of nerfstudio and gsplat, done as it says."""

from __future__ import annotations

import io
import json
import shlex
import shutil
import sys
import zipfile
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from liftcore.cli import main
from liftcore.io.cameras import read_cameras
from tests.api.tiny_scene import WIDTH, cameras_document, colmap_zip, make_scene

from .readme import GUIDE, blocks, text

SCALE = 0.2


def similarity() -> np.ndarray:
    """[4, 4], from the frame of the camera files to that of the splats."""
    moved = np.eye(4)
    moved[:3, :3] = SCALE * Rotation.from_euler("xyz", [10, 130, -40], degrees=True).as_matrix()
    moved[:3, 3] = (0.5, -2.0, 1.0)
    return moved


def commands() -> list[list[str]]:
    section = text(GUIDE).partition("## Scenes of nerfstudio and gsplat")[2].partition("\n## ")[0]
    lines = section.partition("```sh\n")[2].partition("```")[0].splitlines()
    return [shlex.split(line) for line in lines]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The tiny scene as nerfstudio would have trained it, and its run's file; the working directory."""
    scene, back = make_scene(), np.linalg.inv(similarity())
    (tmp_path / "splat.ply").write_bytes(scene.splats)
    (tmp_path / "features.safetensors").write_bytes(scene.features)
    (tmp_path / "words.safetensors").write_bytes(scene.table)
    document = cameras_document()
    for frame in document["frames"]:
        pose = back @ np.array(frame["transform_matrix"])
        pose[:3, :3] *= SCALE  # of cameras only the places are scaled
        frame["transform_matrix"] = pose.tolist()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "transforms.json").write_text(json.dumps({**document, "ply_file_path": "sparse_pc.ply"}))
    run = tmp_path / commands()[0][1]
    run.parent.mkdir(parents=True)
    told = similarity()[:3] / np.array([[SCALE]])
    run.write_text(json.dumps({"transform": told.tolist(), "scale": SCALE}))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_lift_of_nerfstudios_scene_finds_the_apple(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy, *splatlift, packed = commands()
    assert (copy[0], packed[1:4]) == ("cp", ["-m", "zipfile", "-c"])
    assert main(["inspect", "data"]) == 0
    assert "--orientation-method none" in capsys.readouterr().out
    unmoved = ["lift", "splat.ply", "data", "features.safetensors", "-o", "unmoved.lift.safetensors"]
    assert main(unmoved) == 0
    assert "Put its run's dataparser_transforms.json beside them" in capsys.readouterr().out
    shutil.copy(*copy[1:])
    assert [main(command[1:]) for command in splatlift] == [0, 0]
    said = capsys.readouterr().out
    assert "dataparser_transforms.json" in said and "Put its run's" not in said
    question = ["query", "plants.lift.safetensors", "apple", "--table", "words.safetensors", "--view", "middle"]
    assert main([*question, "--mask", "apple.png"]) == 0
    with Image.open("apple.png") as mask:
        columns = np.asarray(mask).nonzero()[1]
    assert len(columns) > 0 and columns.max() < WIDTH // 2
    with zipfile.ZipFile(packed[4], "w") as archive:
        for name in packed[5:]:
            archive.write(name, Path(name).name)
    one, other = (read_cameras(Path(path)).values() for path in ("data", packed[4]))
    assert [view.viewmat.tolist() for view in one] == [view.viewmat.tolist() for view in other]


def test_transform_of_gsplat_is_written_and_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(io.BytesIO(colmap_zip())) as archive:
        archive.extractall(folder / "data/garden")
    before = read_cameras(folder / "data/garden")
    module = ModuleType("datasets.colmap")
    vars(module)["Parser"] = lambda path, factor, normalize: SimpleNamespace(transform=similarity())
    monkeypatch.setitem(sys.modules, "datasets", ModuleType("datasets"))
    monkeypatch.setitem(sys.modules, "datasets.colmap", module)
    (example,) = (block for block in blocks(GUIDE, "python") if "datasets.colmap" in block)
    exec(compile(example, GUIDE, "exec"), {})
    after = read_cameras(folder / "data/garden")
    for old, new in zip(before.values(), after.values(), strict=True):
        assert np.allclose(new.centre, (similarity() @ [*old.centre, 1])[:3])
