"""The guide's examples run, and show what the service really answers."""

from __future__ import annotations

import inspect
import io
import json
import shlex
import shutil
import sys
import zipfile
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

import liftcore as lc
from liftcore.cli import main
from liftcore.io.cameras import read_cameras
from tests.tiny_scene import (
    FOCAL,
    HEIGHT,
    SPLATS_A_CLUSTER,
    VIEWS,
    WIDTH,
    WORDS,
    cameras_document,
    codebook,
    colmap_zip,
    labels,
    make_scene,
    splat_rows,
)

from .readme import GUIDE, PYTHON, blocks, text
from .test_example_scripts import run


@pytest.fixture
def scene_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The tiny scene under the names that the guide uses, as the working directory."""
    scene = make_scene()
    for name, content in (
        ("scene.ply", scene.splats),
        ("cameras.json", scene.cameras),
        ("features.safetensors", scene.features),
        ("words.safetensors", scene.table),
    ):
        (tmp_path / name).write_bytes(content)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", ["README.md", PYTHON])
def test_python_example_of_files_finds_the_apple(page: str, scene_folder: Path) -> None:
    (example,) = (block for block in blocks(page, "python") if 'read_splats("scene.ply")' in block)
    names: dict[str, Any] = {}
    exec(compile(example, page, "exec"), names)
    result, means = lc.load_lift("scene.lift.safetensors"), names["splats"].means
    assert torch.equal(result.features, names["result"].features)
    selected = names["apple"].selected
    assert np.array_equal(selected, result.query(codebook()[WORDS.index("apple")]).selected)
    assert selected.any() and float(means[selected, 0].max()) < 0  # the apple is the cluster on the left
    assert names["apple"].box.high[0] < 0


def commands_between(page: str, begin: str, end: str, folder: Path) -> list[list[str]]:
    """The commands of a part of a page, for a folder with a COLMAP model and without features."""
    with zipfile.ZipFile(io.BytesIO(colmap_zip())) as archive:
        archive.extractall(folder)
    (folder / "features.safetensors").unlink()
    section = text(page).partition(begin)[2].partition(end)[0]
    lines = [line for line in section.splitlines() if line.startswith("splatlift ")]
    return [shlex.split(line)[1:] for line in lines]


def test_the_way_from_own_maps_to_a_mask_leads_there(scene_folder: Path) -> None:
    (scene_folder / "maps").mkdir()
    for view, clusters in labels().items():
        grid = codebook()[clusters[0]].transpose(2, 0, 1)  # [F, h, w], as PyTorch has it
        np.save(scene_folder / "maps" / f"{view}.png.npy", grid.astype(np.float16))
    commands = commands_between("README.md", "## From the command line", "## Over HTTP", scene_folder)
    assert [command[0] for command in commands] == ["inspect", "pack", "plan", "lift", "query"]
    assert [main(command) for command in commands] == [0] * len(commands)
    with Image.open(scene_folder / "apple.png") as mask:
        columns = np.asarray(mask).nonzero()[1]
    assert len(columns) > 0 and columns.max() < WIDTH // 2


def test_questions_of_the_guide_are_answered(scene_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = ["scene.ply", "cameras.json", "features.safetensors"]
    assert main(["lift", *files, "-o", "scene.lift.safetensors"]) == 0
    check = text(GUIDE).partition("## Check the inputs")[2].partition("\n## ")[0]
    assert main(shlex.split(f"check {' '.join(files)}")) == 0 and "splatlift check scene.ply sparse/0 photos" in check
    shutil.copy("features.safetensors", "kept")
    commands = commands_between(GUIDE, "## Queries", "### Text encoders", scene_folder)
    shutil.copy("kept", "features.safetensors")
    capsys.readouterr()
    assert [command[0] for command in commands] == ["query"] * 4 + ["segment"] * 2 + ["objects", "export", "objects"]
    assert [main(command) for command in commands] == [0] * len(commands)
    output = capsys.readouterr().out
    assert "3 of 3 words found" in output and "middle:6,12: apple " in output
    assert all((scene_folder / name).is_file() for name in ("like.png", "words.png", "seen.png", "scores.ply"))


# Scenes of nerfstudio and gsplat


SCALE = 0.2


def similarity() -> np.ndarray:
    """[4, 4], from the frame of the camera files to that of the splats."""
    transform = np.eye(4)
    transform[:3, :3] = SCALE * Rotation.from_euler("xyz", [10, 130, -40], degrees=True).as_matrix()
    transform[:3, 3] = (0.5, -2.0, 1.0)
    return transform


def commands() -> list[list[str]]:
    section = text(GUIDE).partition("## Scenes of nerfstudio and gsplat")[2].partition("\n## ")[0]
    lines = section.partition("```sh\n")[2].partition("```")[0].splitlines()
    return [shlex.split(line) for line in lines]


@pytest.fixture
def folder(scene_folder: Path) -> Path:
    """The tiny scene as nerfstudio would have trained it, and its run's file; the working directory."""
    back = np.linalg.inv(similarity())
    (scene_folder / "scene.ply").rename(scene_folder / "splat.ply")
    document = cameras_document()
    for frame in document["frames"]:
        pose = back @ np.array(frame["transform_matrix"])
        pose[:3, :3] *= SCALE  # of cameras only the places are scaled
        frame["transform_matrix"] = pose.tolist()
    (scene_folder / "data").mkdir()
    (scene_folder / "data" / "transforms.json").write_text(json.dumps({**document, "ply_file_path": "sparse_pc.ply"}))
    run = scene_folder / commands()[0][1]
    run.parent.mkdir(parents=True)
    output = similarity()[:3] / np.array([[SCALE]])
    run.write_text(json.dumps({"transform": output.tolist(), "scale": SCALE}))
    return scene_folder


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
    output = capsys.readouterr().out
    assert "dataparser_transforms.json" in output and "Put its run's" not in output
    question = ["query", "plants.lift.safetensors", "apple", "--table", "words.safetensors", "--view", "middle"]
    assert main([*question, "--mask", "apple.png"]) == 0
    with Image.open("apple.png") as mask:
        columns = np.asarray(mask).nonzero()[1]
    assert len(columns) > 0 and columns.max() < WIDTH // 2
    with zipfile.ZipFile(packed[4], "w") as archive:
        for name in packed[5:]:
            archive.write(name, Path(name).name)
    original, other = (read_cameras(Path(path)).values() for path in ("data", packed[4]))
    assert [view.viewmat.tolist() for view in original] == [view.viewmat.tolist() for view in other]


def test_transform_of_gsplat_is_written_and_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(io.BytesIO(colmap_zip())) as archive:
        archive.extractall(folder / "data/garden")
    before = read_cameras(folder / "data/garden")
    module = ModuleType("datasets.colmap")
    vars(module)["Parser"] = lambda path, factor, normalize: SimpleNamespace(transform=similarity())
    monkeypatch.setitem(sys.modules, "datasets", ModuleType("datasets"))
    monkeypatch.setitem(sys.modules, "datasets.colmap", module)
    run("gsplat_transform.py", "data/garden", "4")
    after = read_cameras(folder / "data/garden")
    for old, new in zip(before.values(), after.values(), strict=True):
        assert np.allclose(new.centre, (similarity() @ [*old.centre, 1])[:3])


def test_five_lines_lift_the_tensors_of_a_training_loop() -> None:
    """On parameters as gsplat trains them, with an encoder whose maps have gradients."""
    rows, K = torch.from_numpy(splat_rows()), torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    columns: dict[str, Any] = {
        "means": rows[:, :3],
        "quats": 3 * rows[:, 10:],
        "log_scales": rows[:, 7:10],
        "opacity_logits": rows[:, 6],
    }
    loop: dict[str, Any] = dict(torch.nn.ParameterDict(columns).items())
    poses = []
    for number, x in enumerate(VIEWS.values()):
        viewmat = torch.diag(torch.tensor([1.0, -1, -1, 1]))
        viewmat[0, 3] = -x
        poses.append((f"{number:04d}", viewmat, K))
    cameras = {name: lc.Camera(viewmat, K, WIDTH, HEIGHT) for name, viewmat, K in poses}
    photos = [(name, lc.render(lc.Splats(**columns), camera, rows[:, 3:6])) for name, camera in cameras.items()]
    torch.manual_seed(2)
    loop |= {"poses": poses, "photos": photos, "encode": torch.nn.Linear(3, 12), "width": WIDTH, "height": HEIGHT}
    (example,) = (block for block in blocks(PYTHON, "python") if "lc.Splats(" in block)
    five = example.splitlines()[2:]
    assert len(five) == 5
    exec("\n".join([example.splitlines()[0], *five[:4]]), loop)
    assert inspect.isgenerator(loop["views"])
    loop["text_vectors"] = loop["result"].features[:SPLATS_A_CLUSTER].float().mean(dim=0)
    exec(five[4], loop)
    pixels = np.nonzero(np.asarray(loop["mask"]))[1]
    assert len(pixels) > 10 and pixels.max() < WIDTH / 2  # the cluster on the left was asked for
    assert loop["means"].grad is None
