"""The guide's examples run, and show what the service really answers."""

from __future__ import annotations

import inspect
import io
import json
import runpy
import shlex
import shutil
import sys
import zipfile
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
import torch
from matplotlib import pyplot
from PIL import Image
from plyfile import PlyData
from pydantic import BaseModel
from safetensors.numpy import load_file
from scipy.spatial.transform import Rotation

import liftcore as lc
from liftcore.cli import main
from liftcore.features.encoders import Pixels
from liftcore.features.encoders.crops import CropEncoder
from liftcore.io.cameras import read_cameras
from liftcore.io.splats import read_splats, write_splats
from liftcore.text.table import TableEncoder
from liftcore.values.pack import read_features, write_pack
from service import models
from service.commands.demo import find_scene
from service.errors import Problem
from tests.inria_file import write_inria_cameras
from tests.run_lengths import sam_records
from tests.tiny_scene import HEIGHT, WIDTH, WORDS, cameras_document, codebook, colmap_zip, labels, make_scene

from .readme import GUIDE, PYTHON, ROOT, SERVICE, SETTINGS, blocks, text

SHAPES: dict[str, type[BaseModel]] = {  # a field that no other answer has -> the answer
    "counts": models.Asset,
    "attempt": models.Job,
    "statistics": models.QueryAnswer,
    "unassigned_splats": models.ObjectsAnswer,
    "detail": Problem,
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
    selected = names["apple"].selected
    assert np.array_equal(selected, result.query(codebook()[WORDS.index("apple")]).selected)
    assert selected.any() and float(means[selected, 0].max()) < 0  # the apple is the cluster on the left
    assert names["apple"].box.high[0] < 0


def test_sams_masks_make_a_lift_that_knows_the_words(scene_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (scene_folder / "photos").mkdir()
    for view, clusters in labels().items():
        Image.fromarray((80 * clusters[0] + 40).astype(np.uint8)).save(scene_folder / "photos" / f"{view}.jpg")
    for name, module in stand_ins().items():
        monkeypatch.setitem(sys.modules, name, module)
    run_script("segment_photos.py", "photos", "masks")
    table = TableEncoder.open(scene_folder / "words.safetensors")
    (scene_folder / "words.safetensors").unlink()
    monkeypatch.setattr("liftcore.open_encoder", lambda spec: table)  # whose weights are not here
    run_example(GUIDE, "lc.open_encoder")
    monkeypatch.undo()
    monkeypatch.chdir(scene_folder)
    monkeypatch.setattr(CropEncoder, "open", GreyEncoder)  # nor are these
    commands = commands_between(GUIDE, "### From SAM's masks", "\n### ", scene_folder)
    assert [command[0] for command in commands] == ["pack", "lift"]
    assert "python examples/segment_photos.py photos masks" in text(GUIDE)
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
    scene_folder: Path,
) -> None:
    for name in ("labels", "vectors"):
        (scene_folder / name).mkdir()
    for view, clusters in labels().items():
        np.save(scene_folder / "labels" / f"{view}.npy", clusters[0])
        np.save(scene_folder / "vectors" / f"{view}.npy", codebook())
    (scene_folder / "features.safetensors").unlink()
    run_script("write_pack.py", "labels", "vectors", "features.safetensors")
    sources = [str(scene_folder / name) for name in ("scene.ply", "cameras.json", "features.safetensors")]
    assert main(["lift", *sources, "-o", "scene.lift.safetensors"]) == 0
    lift = load_file("scene.lift.safetensors")  # row j is row j of the PLY
    vertices = PlyData.read("scene.ply")["vertex"]
    positions = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    assert np.array_equal(positions, read_splats(scene_folder / "scene.ply").means.numpy())
    mask = lift["has_feature"] & (lift["total_weight"] > 0.5)
    clusters = np.digitize(positions[mask, 0], [-0.6, 0.6])  # 0 apple, 1 book, 2 lamp
    assert len(set(clusters)) == 3 and np.array_equal(lift["features"][mask].argmax(axis=1), clusters)


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


def run_script(name: str, *arguments: str) -> None:
    """Call the main function of an example in this process, where modules may be replaced."""
    runpy.run_path(str(ROOT / "examples" / name))["main"](*arguments)


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


def test_another_encoders_vectors_take_the_same_weights(scene_folder: Path) -> None:
    for name in ("clip", "siglip"):
        shutil.copy(scene_folder / "features.safetensors", scene_folder / f"{name}.safetensors")
    commands = commands_between(SETTINGS, "## Another encoder", "\n## ", scene_folder)
    assert [main(command) for command in commands] == [0, 0]
    assert any((scene_folder / "weights").iterdir())


def test_json_examples_show_fields_that_the_service_sends() -> None:
    examples = [json.loads(block) for block in blocks(SERVICE, "json")]
    documented_fields = set()
    for example in examples:
        model = next(model for field, model in SHAPES.items() if field in example)
        assert example.keys() <= model.model_fields.keys() | model.model_computed_fields.keys()
        documented_fields.add(model)
    assert documented_fields == set(SHAPES.values())


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
    output = similarity()[:3] / np.array([[SCALE]])
    run.write_text(json.dumps({"transform": output.tolist(), "scale": SCALE}))
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
    run_script("gsplat_transform.py", "data/garden", "4")
    after = read_cameras(folder / "data/garden")
    for old, new in zip(before.values(), after.values(), strict=True):
        assert np.allclose(new.centre, (similarity() @ [*old.centre, 1])[:3])


# The notebook: what is saved in it is what its cells say


NOTEBOOK = ROOT / "docs" / "quickstart.ipynb"
CELLS = [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]


def test_cells_run_in_order_and_print_what_is_saved(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    matplotlib.use("Agg")
    monkeypatch.setattr(pyplot, "show", lambda: None)
    names: dict[str, Any] = {}
    for cell in CELLS:
        exec(compile("".join(cell["source"]), str(NOTEBOOK), "exec"), names)
        saved = "".join("".join(output.get("text", [])) for output in cell["outputs"])
        assert capsys.readouterr().out.splitlines()[:1] == saved.splitlines()[:1]
        pictures = [output for output in cell["outputs"] if "image/png" in output.get("data", {})]
        assert len(pictures) == len(pyplot.get_fignums())
        pyplot.close("all")
    scene = find_scene(names["folder"], (), names["folder"])
    assert scene.truth is not None
    overlap = scene.truth.mean_iou(names["phrase"], {"view_030": names["mask"]})
    assert overlap is not None and overlap > 0.8


# The five lines for a training loop, on tensors as gsplat trains them


@pytest.fixture
def loop() -> dict[str, Any]:
    """Return the state of a training loop: parameters, poses and photos of two clouds of splats, an image encoder."""
    random = torch.Generator().manual_seed(5)
    means = 0.25 * torch.randn(400, 3, generator=random)
    means[:200, 0] -= 0.8
    means[200:, 0] += 0.8
    params: dict[str, Any] = {
        "means": means,
        "quats": 3 * torch.randn(400, 4, generator=random),  # unnormalised, as they are trained
        "log_scales": torch.full((400, 3), -2.6) + 0.2 * torch.randn(400, 3, generator=random),
        "opacity_logits": torch.full((400,), 1.5),
    }
    names = dict(torch.nn.ParameterDict(params).items())
    viewmats, Ks = torch.eye(4).repeat(5, 1, 1), torch.eye(3).repeat(5, 1, 1)
    viewmats[:, 0, 3], viewmats[:, 2, 3] = torch.linspace(-0.5, 0.5, 5), 4.0
    Ks[:, 0, 0] = Ks[:, 1, 1] = 30.0
    Ks[:, 0, 2], Ks[:, 1, 2] = WIDTH / 2, HEIGHT / 2
    splats = lc.Splats(**params)
    colours = torch.where(means[:, :1] < 0, torch.tensor([1.0, 0.2, 0.1]), torch.tensor([0.1, 0.3, 1.0]))
    views = [f"{view:04d}" for view in range(5)]
    poses: Any = list(zip(views, viewmats, Ks, strict=True))
    torch.manual_seed(2)
    net = torch.nn.Sequential(
        torch.nn.Conv2d(3, 16, 3, stride=2, padding=1), torch.nn.Tanh(), torch.nn.Conv2d(16, 12, 1)
    )

    def encode(photo: torch.Tensor) -> torch.Tensor:
        """[h, w, F] of a photo [H, W, 3], with gradients as a network gives them."""
        return net(photo.permute(2, 0, 1)[None])[0].permute(1, 2, 0)

    photos = [(name, lc.render(splats, lc.Camera(viewmat, K, WIDTH, HEIGHT), colours)) for name, viewmat, K in poses]
    return names | {"poses": poses, "photos": photos, "encode": encode, "width": WIDTH, "height": HEIGHT}


def test_tensors_of_a_training_loop_lift_as_their_files_do(loop: dict[str, Any], tmp_path: Path) -> None:
    assert all(loop[name].requires_grad for name in ("means", "quats", "log_scales", "opacity_logits"))
    (example,) = (block for block in blocks(PYTHON, "python") if "lc.Splats(" in block)
    five = example.splitlines()[2:]
    assert len(five) == 5
    exec("\n".join([example.splitlines()[0], *five[:4]]), loop)
    assert inspect.isgenerator(loop["views"])
    features = loop["result"].features.float()
    loop["text_vectors"] = features[loop["means"][:, 0].detach() < 0].mean(dim=0)
    exec(five[4], loop)

    write_splats(tmp_path / "scene.ply", loop["splats"])
    documented = [lc.Camera(viewmat, K, WIDTH, HEIGHT, name=name) for name, viewmat, K in loop["poses"]]
    write_inria_cameras(lc.Cameras(tuple(documented)), tmp_path / "cameras.json")
    grids = {name: lc.FeatureGrid(loop["encode"](photo)) for name, photo in loop["photos"]}
    write_pack(tmp_path / "features.safetensors", grids, {})
    filed = lc.lift(
        lc.read_splats(tmp_path / "scene.ply"), lc.read_cameras(tmp_path / "cameras.json"),
        lc.read_features(tmp_path / "features.safetensors"),
    )  # fmt: skip
    assert torch.allclose(filed.features.float(), features, atol=2e-3)  # packs and poses are rounded, values are not
    assert torch.equal(filed.has_feature, loop["result"].has_feature)

    columns = np.nonzero(np.asarray(loop["mask"]))[1]
    assert len(columns) > 10 and columns.max() < WIDTH / 2  # the cloud on the left was asked for
    assert loop["means"].grad is None


def test_tensors_of_gsplat_and_nerfstudio_are_taken_under_their_names(loop: dict[str, Any]) -> None:
    (example,) = (block for block in blocks(PYTHON, "python") if "from_gsplat(" in block)
    raw = {"means": loop["means"], "quats": loop["quats"]}
    raw |= {"scales": loop["log_scales"], "opacities": loop["opacity_logits"]}
    names = {"lc": lc, "colors": torch.rand(400, 3), "c2w": torch.eye(4), "K": loop["poses"][0][2]}
    names |= {"trainer": SimpleNamespace(splats=raw), "model": SimpleNamespace(gauss_params=raw)}
    names |= raw | {"scales": raw["scales"].exp(), "opacities": raw["opacities"].sigmoid()}
    names |= {"width": WIDTH, "height": HEIGHT}
    trained = lc.Splats(**{name: loop[name] for name in ("means", "quats", "log_scales", "opacity_logits")})
    for line in example.splitlines():
        exec(line, names)
        splats: lc.Splats = names["splats"]
        assert torch.allclose(splats.log_scales, trained.log_scales, atol=1e-5)
        assert torch.allclose(splats.opacity_logits, trained.opacity_logits, atol=1e-4)
    assert names["camera"].viewmat.diagonal().tolist() == [1, -1, -1, 1]
