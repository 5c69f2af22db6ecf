"""The guide's examples run, and show what the service really answers."""

from __future__ import annotations

import io
import json
import re
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
from fastapi.routing import APIRoute
from PIL import Image
from pydantic import BaseModel

import liftcore as lc
from liftcore.cli import main
from liftcore.features.encoders import Pixels
from liftcore.features.encoders.crops import CropEncoder
from liftcore.features.pack import read_features
from liftcore.io.splats import read_splats
from liftcore.query.text.table import TableEncoder
from service import models
from service.routes import assets, jobs, operations, queries, results, scene, words
from service.scopes import OPEN
from tests.api.tiny_scene import WIDTH, WORDS, codebook, colmap_zip, labels, make_scene
from tests.run_lengths import sam_records

from .readme import FOR_USERS, GUIDE, PYTHON, SERVICE, SETTINGS, blocks, text

ROUTES: tuple[ModuleType, ...] = (operations, assets, jobs, results, scene, queries, words)
SHAPES: dict[str, type[BaseModel]] = {  # a field that no other answer has -> the answer
    "counts": models.Asset,
    "attempt": models.Job,
    "statistics": models.QueryAnswer,
    "strays": models.ObjectsAnswer,
    "detail": models.Problem,
}


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
    names = run_example(page, 'read_splats("scene.ply")')
    result, means = lc.load_lift("scene.lift.safetensors"), names["splats"].means
    assert torch.equal(result.features, names["result"].features)
    found = result.query(codebook()[WORDS.index("apple")]).splats
    assert found.any() and float(means[found, 0].max()) < 0  # the apple is the cluster on the left


def test_sams_masks_make_a_lift_that_knows_the_words(scene_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (scene_folder / "photos").mkdir()
    for view, clusters in labels().items():
        Image.fromarray((80 * clusters[0] + 40).astype(np.uint8)).save(scene_folder / "photos" / f"{view}.jpg")
    for name, module in stand_ins().items():
        monkeypatch.setitem(sys.modules, name, module)
    run_example(GUIDE, "from segment_anything import")
    table = TableEncoder.open(scene_folder / "words.safetensors")
    (scene_folder / "words.safetensors").unlink()
    monkeypatch.setattr("liftcore.query.text.open_encoder", lambda spec: table)  # whose weights are not here
    run_example(GUIDE, "import open_encoder")
    monkeypatch.undo()
    monkeypatch.chdir(scene_folder)
    monkeypatch.setattr(CropEncoder, "open", GreyEncoder)  # nor are these
    commands = commands_between(GUIDE, "### From SAM's masks", "\n### ", scene_folder)
    assert [command[0] for command in commands] == ["pack", "lift"]
    question = ["query", "scene.lift.safetensors", "apple", "--table", "words.safetensors", "--view", "middle"]
    assert [main(command) for command in [*commands, [*question, "--mask", "apple.png"]]] == [0, 0, 0]
    with Image.open(scene_folder / "apple.png") as mask:
        columns = np.asarray(mask).nonzero()[1]
    assert len(columns) > 0 and columns.max() < WIDTH // 2


def test_langsplats_files_become_a_pack(scene_folder: Path) -> None:
    (scene_folder / "language_features").mkdir()
    for view, clusters in labels().items():
        np.save(scene_folder / "language_features" / f"{view}_s.npy", clusters)
        np.save(scene_folder / "language_features" / f"{view}_f.npy", codebook().astype(np.float16))
    (command,) = commands_between(GUIDE, "### From LangSplat's folders", "\n### ", scene_folder)
    assert main(command) == 0
    packs = read_features(scene_folder / "features.safetensors")
    assert packs.views == tuple(sorted(labels())) and packs.text_space == command[-1]


def test_pack_of_ones_own_program_makes_a_lift_that_python_reads(
    scene_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("labels", "vectors"):
        (scene_folder / name).mkdir()
    for view, clusters in labels().items():
        np.save(scene_folder / "labels" / f"{view}.npy", clusters[0])
        np.save(scene_folder / "vectors" / f"{view}.npy", codebook())
    (scene_folder / "features.safetensors").unlink()
    run_example(GUIDE, 'Path("labels")')
    sources = [str(scene_folder / name) for name in ("scene.ply", "cameras.json", "features.safetensors")]
    assert main(["lift", *sources, "-o", "scene.lift.safetensors"]) == 0
    capsys.readouterr()
    names = run_example(GUIDE, 'load_file("scene.lift.safetensors")')
    assert len(capsys.readouterr().out.splitlines()) >= 3
    places, features, sure = names["places"], names["lift"]["features"], names["sure"]
    assert np.array_equal(places, read_splats(scene_folder / "scene.ply").means.numpy())
    clusters = np.digitize(places[sure, 0], [-0.6, 0.6])  # 0 apple, 1 book, 2 lamp
    assert len(set(clusters)) == 3 and np.array_equal(features[sure].argmax(axis=1), clusters)


def commands_between(page: str, begin: str, end: str, folder: Path) -> list[list[str]]:
    """The commands of a part of a page, for a folder with a COLMAP model and without features."""
    with zipfile.ZipFile(io.BytesIO(colmap_zip())) as archive:
        archive.extractall(folder)
    (folder / "features.safetensors").unlink()
    section = text(page).partition(begin)[2].partition(end)[0]
    lines = [line for line in section.splitlines() if line.startswith("splatlift ")]
    return [shlex.split(line)[1:] for line in lines]


def run_example(page: str, start: str) -> dict[str, Any]:
    """The names that the one Python example of a page with such a line leaves behind."""
    (example,) = (block for block in blocks(page, "python") if start in block)
    names: dict[str, Any] = {}
    exec(compile(example, page, "exec"), names)
    return names


def stand_ins() -> dict[str, ModuleType]:
    """segment-anything by the names that are used of it: masks are run lengths of what is of one grey."""

    def generate(image: np.ndarray) -> list[dict[str, Any]]:
        clusters = np.rint((image[..., 0].astype(float) - 40) / 80)
        return sam_records(np.stack([clusters == k for k in range(3)]))

    module, generator = ModuleType("segment_anything"), SimpleNamespace(generate=generate)
    vars(module).update(
        SamAutomaticMaskGenerator=lambda sam, output_mode: generator,
        build_sam_vit_h=lambda checkpoint: SimpleNamespace(to=lambda device: None),
    )
    return {"segment_anything": module}


class GreyEncoder:
    """In place of an open_clip model: a crop's vector is the codebook's row of its brightest pixel's grey."""

    pixels = Pixels(patch=8, shorter=8, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0), interpolation="nearest")

    def __init__(self, spec: str, _: torch.device) -> None:
        self.name = self.text_space = spec

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        clusters = ((255 * images.flatten(1).amax(dim=1) - 40) / 80).round().long()
        return torch.from_numpy(codebook()).float()[clusters]


def test_command_line_example_writes_its_files(scene_folder: Path) -> None:
    main(["lift", "scene.ply", "cameras.json", "features.safetensors", "-o", "scene.lift.safetensors"])
    section = text(GUIDE).partition("## Asking")[2].partition("###")[0]
    commands = [line.split()[1:] for line in section.splitlines() if line.startswith("splatlift ")]
    assert [command[0] for command in commands] == ["query"] * 3
    assert [main(command) for command in commands] == [0] * len(commands)
    assert (scene_folder / "apple.png").is_file()
    apple, scores = (read_splats(scene_folder / name) for name in ("apple.ply", "scores.ply"))
    assert 0 < apple.count < scores.count == read_splats(scene_folder / "scene.ply").count
    assert float(apple.means[:, 0].max()) < 0  # the apple is the cluster on the left


def test_no_example_saves_an_error_as_what_was_asked_for() -> None:
    shell = [block for page in FOR_USERS for block in blocks(page, "sh")]
    saving = [line for block in shell for line in block.splitlines() if " -o " in line]
    curls = [line for line in saving if line.startswith("curl ")]
    assert curls and all(re.match(r"curl -[a-zA-Z]*f", line) for line in curls)


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
    check = text(GUIDE).partition("## Before the work")[2].partition("\n## ")[0]
    assert main(shlex.split(f"check {' '.join(files)}")) == 0 and "splatlift check scene.ply sparse/0 photos" in check
    shutil.copy("features.safetensors", "kept")
    commands = commands_between(GUIDE, "## Asking", "### Text encoders", scene_folder)
    shutil.copy("kept", "features.safetensors")
    capsys.readouterr()
    assert [command[0] for command in commands] == ["query"] * 3 + ["segment"] * 2 + ["objects"]
    assert [main(command) for command in commands] == [0] * len(commands)
    told = capsys.readouterr().out
    assert "3 of 3 words are there" in told and "middle:6,12: apple " in told
    assert all((scene_folder / name).is_file() for name in ("like.png", "words.png", "seen.png", "scores.ply"))


def test_another_encoders_vectors_take_the_same_weights(scene_folder: Path) -> None:
    for name in ("clip", "siglip"):
        shutil.copy(scene_folder / "features.safetensors", scene_folder / f"{name}.safetensors")
    commands = commands_between(SETTINGS, "## Another encoder", "\n## ", scene_folder)
    assert [main(command) for command in commands] == [0, 0]
    assert any((scene_folder / "weights").iterdir())


def test_json_examples_show_fields_that_the_service_sends() -> None:
    examples = [json.loads(block) for block in blocks(SERVICE, "json")]
    seen = set()
    for example in examples:
        model = next(model for field, model in SHAPES.items() if field in example)
        assert example.keys() <= model.model_fields.keys()
        seen.add(model)
    assert seen == set(SHAPES.values())


def test_every_route_is_told_and_no_other() -> None:
    rows = [line.split(" | ")[0] for line in text(SERVICE).splitlines() if line.startswith("| `")]
    named = {match for row in rows for match in re.findall(r"`([A-Z]+ /[^`]*)`", row)}
    real = set()
    for module in ROUTES:
        for route in module.router.routes:
            assert isinstance(route, APIRoute)
            real |= {f"{method} {route.path}" for method in route.methods or ()}
    in_a_sentence = {f"GET {path}" for path in OPEN if path.startswith(("/openapi", "/docs", "/web"))}
    assert named == real - in_a_sentence
