"""Commands that read and write files: the library reads back what they wrote, and a refusal leaves nothing behind."""

from __future__ import annotations

import json
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import liftcore as lc
import numpy as np
import pytest
import torch
from liftcore import cli, evaluate
from PIL import Image
from safetensors.numpy import load_file, save_file

from tests.promises.command_line import contents, error_line, run
from tests.promises.scenes import arrays_of, random_scene, random_splats, write_pack
from tests.promises.tiny_files import write_lift
from tests.server import until
from tests.tiny_scene import CHANNELS, VIEWS, masks

COMMANDS = (
    *("lift", "pack", "encode", "query", "segment", "objects", "evaluate", "check", "tradeoff", "inspect", "plan"),
    *("render", "export", "transfer", "serve", "view", "keys", "store", "demo"),
)
RUNS = {  # commands over the lifted tiny scene -> words, and the files that they write
    "lift": ("{s} {c} {f} -o {out}/x.safetensors --preset row-sum", "x.safetensors"),
    "plan": ("{s} {c} {f}", ""),
    "pack": ("npy {maps} -o {out}/p.safetensors --normalised", "p.safetensors"),
    "inspect": ("{lift}", ""),
    "check": ("{s} {c} {f}", ""),
    "query": ("{lift} book --table {w} --scores {out}/s.npy --coloured {out}/c.ply", "s.npy c.ply"),
    "segment": ("{lift} --table {w} --labels {out}/l.npy --labelled {out}/n.ply", "l.npy n.ply n.ply.json"),
    "objects": ("{lift} --table {w} --into {out}/each --csv {out}/t.csv", "each/object-0.ply t.csv"),
    "render": ("{lift} --view left -o {out}/r.png", "r.png"),
    "export": ("{lift} --table {w} -o {out}/e.ply", "e.ply e.ply.json"),
    "transfer": ("{lift} {s} -o {out}/t.safetensors", "t.safetensors"),
}
WRITERS = [name for name, (_, files) in RUNS.items() if files]
FILES = {
    "s": "s.ply",
    "c": "c.json",
    "f": "f.safetensors",
    "w": "words.safetensors",
    "lift": "scene.lift.safetensors",
    "photo": "photo.png",
}


def write_scene(folder: Path) -> Path:
    """Write the lifted tiny scene, maps of its views, and folders for outputs; return the folder."""
    write_lift(folder)
    Image.new("RGB", (8, 6)).save(folder / "photo.png")
    for name in ("maps", "out", "out/each"):
        (folder / name).mkdir()
    for number, view in enumerate(VIEWS):
        np.save(folder / f"maps/{view}.png.npy", np.eye(48, CHANNELS, number, np.float16).reshape(6, 8, CHANNELS))
    return folder


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path)


@pytest.fixture(scope="module")
def same_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same for tests that change nothing in it."""
    return write_scene(tmp_path_factory.mktemp("same"))


def words_of(name: str, scene: Path) -> list[str]:
    """Return the words of a command of RUNS."""
    paths = {key: str(scene / file) for key, file in {**FILES, "maps": "maps", "out": "out"}.items()}
    return [name, *(word.format(**paths) for word in RUNS[name][0].split())]


def sources(folder: Path) -> list[Path]:
    return [folder / FILES[key] for key in ("s", "c", "f")]


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond a size in bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str) -> None:
    reply = run(command, "--help")
    assert (reply.status, reply.err) == (0, "") and f"usage: splatlift {command}" in reply.out
    assert f"  {command} " in run("--help").out


@pytest.mark.parametrize("name", RUNS)
def test_json_is_one_document_and_words_are_lines(name: str, scene: Path) -> None:
    files = {f"out/{file}" for file in RUNS[name][1].split()}
    reply = run(*words_of(name, scene), "--json")
    assert reply.document and files <= contents(scene).keys()
    for file in files:
        (scene / file).unlink()
    in_words = run(*words_of(name, scene))
    assert in_words.status == 0 and files <= contents(scene).keys()
    assert "{" not in in_words.out and in_words.out.count("\n") >= 1


@pytest.mark.parametrize("name", WRITERS)
def test_no_output_replaces_an_input_or_another_kind(name: str, scene: Path) -> None:
    words = words_of(name, scene)
    inputs = [scene / "maps/left.png.npy"] if name == "pack" else sources(scene)
    for file in RUNS[name][1].split():
        output = scene / "out" / file
        for source in inputs if str(output) in words else []:
            before = contents(scene)
            assert str(source) in error_line(*(str(source) if word == str(output) else word for word in words))
            assert contents(scene) == before
        foreign = "s.ply" if output.suffix == ".png" else "photo.png"
        output.write_bytes((scene / foreign).read_bytes())
        before = contents(scene)
        assert f"{output}, which is " in error_line(*words) and contents(scene) == before
        output.unlink()
    assert run(*words).status == run(*words).status == 0  # one of its own kind is replaced


@pytest.mark.parametrize("name", WRITERS)
def test_full_disk_leaves_the_file_of_before_and_no_other(name: str, scene: Path) -> None:
    words = words_of(name, scene)
    assert run(*words).status == 0
    before = contents(scene)
    largest = max(len(before[f"out/{file}"]) for file in RUNS[name][1].split())
    with full_disk(min(largest // 2, 300)):
        reply = run(*words)
    assert reply.status in (1, 2) and reply.err.count("\n") == 1 and "Traceback" not in reply.err
    assert contents(scene) == before


@pytest.mark.slow
def test_stopped_lift_leaves_no_half_and_goes_on(tmp_path: Path) -> None:
    few = random_scene(7, views=8)
    result = lc.lift(*few.arguments(), preset="row-sum", progress=False)
    result.save_scene(tmp_path, few.splats, few.cameras)
    splats = random_splats(7, 30_000, flat=0.05)
    lc.write_splats(tmp_path / "splats.ply", replace(splats, log_scales=splats.log_scales - 3))
    write_pack(tmp_path / "f.safetensors", few.views)
    files = [tmp_path / name for name in ("splats.ply", "cameras.json", "f.safetensors")]
    lift, checkpoint = tmp_path / "out/x.safetensors", tmp_path / "kept"
    lift.parent.mkdir()
    settings = lc.LiftSettings.of(preset="row-sum", diagnostic_rays=0)
    options = ["--preset", "row-sum", "--set", "diagnostic_rays=0", "--checkpoint", checkpoint]
    words = ["lift", *files, "-o", lift, *options]
    command = [sys.executable, "-m", "liftcore.cli", *map(str, words)]
    for number, status in ((signal.SIGINT, cli.INTERRUPTED), (signal.SIGKILL, -signal.SIGKILL)):
        lift.unlink(missing_ok=True)  # of one that ended before its signal
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        until(lambda process=process: process.poll() is not None or any(checkpoint.glob("*")))
        process.send_signal(number)
        _, err = process.communicate()
        assert process.returncode in (status, 0) and "Traceback" not in err
        if process.returncode:  # it had not ended before
            assert not lift.exists() and (number == signal.SIGKILL or err == "splatlift: interrupted\n")
    assert run(*words).status == 0
    expected = lc.lift_files(files[0], files[1], files[2:], settings, progress=False).as_codes()
    assert arrays_of(lc.load_lift(lift)) == arrays_of(expected)
    assert [path.name for path in lift.parent.iterdir()] == [lift.name]


REFUSALS = {  # words -> what the line says
    "": "COMMAND",
    "dance": "invalid choice: 'dance'",
    "lift": "required: splats, cameras, features, -o/--output",
    "lift {s} {c} {f} -o {out}": "the folder",
    "lift {s} {c} {f} -o {out}/x.sog": "x.sog",
    "lift {s} {c} nope -o {out}/x.safetensors": "nope: expected a feature pack (.safetensors), got a file",
    "lift {s} {c} {f} -o {out}/x.safetensors --set power": "--set: expected key=value, got 'power'",
    "lift {s} {c} {f} -o {out}/x.safetensors --set strides=2": "an unknown setting; nearest: stride",
    "lift {s} {c} {f} -o {out}/x.safetensors --set stride=2 --set stride=3": "expected one value, got --set stride=2",
    "lift {s} {c} {f} -o {out}/x.safetensors --preset row-sum --set preset=argmax": "got --preset row-sum and --set",
    "lift {s} {c} {f} -o {out}/x.safetensors --threads 0": "a whole number of one or more, got '0'",
    "lift {s} {c} {f} -o {out}/x.safetensors --checkpoint {s}": "checkpoint: expected a folder that can be written",
    "lift {s} {c} {f} -o {out}/x.safetensors --up 0 0 0": "--up: expected",
    "plan {c} {s} {f}": "splats as SPLATS, got cameras; the order is SPLATS CAMERAS FEATURES",
    "plan {s} {c} {maps}": "splatlift pack masks",
    "pack npy {maps}/left.png.npy -o {out}/p.safetensors": "a folder",
    "pack masks {maps} -o {out}/p.safetensors --unlabelled 65536": "a whole number from 0 to 65535, got '65536'",
    "pack masks {maps} -o {out}/p.safetensors": "left",
    "pack retag {f} -o {out}/p.safetensors": "--text-space or --encoder-name: expected",
    "encode {photo} -o {out}/p.safetensors --encoder magic": "--encoder: expected one of maskclip",
    "encode {photo} -o {photo} --encoder timm:resnet18": "another file than the inputs",
    "tradeoff {s} {c} {f} -o {out}/t --budget none": "expected seconds, got 'none'",
    "tradeoff {s} {c} {f} -o {out}/t --labels nope --table {w} --classes apple book lamp": "nope",
    "render {lift} -o {out}/r.png": "a view to render, got no --view",
    "render {lift} --view nope -o {out}/r.png": "view: expected the name of a camera, got 'nope'; nearest: left",
    "export {lift} -o {out}/e.docx": "e.docx",
    "export {lift} --only -o {out}/e.ply": "--only: expected --text as well, got no --text; use --object ID",
}


@pytest.mark.parametrize("words", REFUSALS)
def test_wrong_words_are_one_line_with_the_remedy(words: str, same_scene: Path) -> None:
    paths = {key: str(same_scene / file) for key, file in {**FILES, "maps": "maps", "out": "out"}.items()}
    before = contents(same_scene)
    message = error_line(*(word.format(**paths) for word in words.split()), *(["--json"] if words else []))
    assert REFUSALS[words] in message and contents(same_scene) == before
    assert ("expected" in message and "got" in message) or "see 'splatlift" in message


def test_own_fault_is_one_line_and_exit_1(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(path: Path) -> dict[str, Any]:
        raise RuntimeError("two\nlines")

    monkeypatch.setattr("liftcore.evaluate.inspect_file", broken)
    reply = run("inspect", scene, "--json")
    assert (reply.status, reply.out) == (1, "")
    assert reply.err == "splatlift: internal error: RuntimeError: two lines (--debug shows the traceback)\n"
    with pytest.raises(RuntimeError):
        cli.main(["inspect", str(scene), "--debug"])


@pytest.mark.slow
def test_help_loads_nothing_heavy_and_closed_pipes_are_silent(scene: Path) -> None:
    heavy = "{'torch', 'numba', 'numpy', 'pydantic', 'tqdm'}"
    code = (
        f"import sys; from liftcore.cli import main; sys.exit(main(['--help']) or bool({heavy} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode == 0
    command = f"{sys.executable} -m liftcore.cli inspect {scene / 's.ply'} | true"
    assert subprocess.run(["bash", "-c", command], check=True, capture_output=True).stderr == b""


LIFTS = {
    "x.safetensors": ("--preset tikhonov --set dtype=float32", {"preset": "tikhonov", "dtype": "float32"}),
    "y.safetensors": ("--quality fast --set alpha_cap=0.5", {"quality": "fast", "alpha_cap": 0.5}),
    "z.safetensors": ("--engine local --threads 2 --set objects=false", {"objects": False}),
}


@pytest.mark.parametrize("file", LIFTS)
def test_lift_is_that_of_the_library(file: str, scene: Path) -> None:
    options, settings = LIFTS[file]
    views = {**lc.read_features(scene / "f.safetensors"), "lost": lc.read_features(scene / "f.safetensors")["left"]}
    write_pack(scene / "f.safetensors", views)
    document = run("lift", *sources(scene), "-o", scene / "out" / file, *options.split(), "--json").document
    result = lc.load_lift(document["out"])
    expected = lc.lift_files(
        scene / "s.ply", scene / "c.json", [scene / "f.safetensors"], lc.LiftSettings.of(**settings)
    )
    assert arrays_of(result) == arrays_of(expected) and result.settings == expected.settings
    assert (document["splats"], document["channels"], document["views"]) == (60, CHANNELS, 3)
    assert document["feature_share"] == 1 and document["settings"].items() >= settings.items()
    assert document["diagnostics"]["row_sum_mean"] == pytest.approx(result.diagnostics["row_sum_mean"])
    assert document["warnings"] == ["1 views have features but no camera and were skipped: lost"]


def test_plan_is_that_of_the_lift_and_said_once(scene: Path) -> None:
    write_pack(scene / "f.safetensors", {view: lc.FeatureGrid(np.ones((16, 16, 3), np.float32)) for view in VIEWS})
    document = run("plan", *sources(scene), "--set", "coverage=1", "--json").document
    plan = lc.plan_files(scene / "s.ply", scene / "c.json", [scene / "f.safetensors"], lc.LiftSettings.of(coverage=1))
    assert document["views"] == {"lifted": list(plan.views), "left_out": list(plan.left_out)}
    assert document["memory_bytes"] == plan.memory_bytes == sum(document["memory"].values())
    assert plan.views and len(plan.views) + len(plan.left_out) == 3 > len(plan.views)
    assert (document["splats"], document["channels"], document["dtype"]) == (60, 3, "float16")
    assert document["warnings"] == list(plan.warnings) != []
    lift = ["lift", *sources(scene), "-o", scene / "x.safetensors", "--verbose"]
    lines = run(*lift).out
    assert lines.startswith("plan: 60 splats") and "timings:\n" in lines and "row_sum_mean" in lines
    for text in (lines, json.dumps(run(*lift, "--json").document["warnings"])):
        assert text.count("maps of another aspect") == 1


def test_files_that_moved_are_given_by_options(scene: Path) -> None:
    """A lift knows its files by their paths; beside it they are found, elsewhere they are given."""
    folder = scene.with_name("moved")
    scene.rename(folder)
    lift, render = folder / FILES["lift"], ["--view", "left", "-o", folder / "r.png"]
    assert run("render", lift, *render).status == 0
    (folder / "s.ply").rename(folder / "out/t.ply")
    assert "--splats" in error_line("render", lift, *render)
    assert run("render", lift, "--splats", folder / "out/t.ply", *render).status == 0


def test_packed_maps_are_those_of_the_folder(scene: Path) -> None:
    maps = {view: np.load(scene / "maps" / f"{view}.png.npy") for view in VIEWS}
    words = ["pack", "npy", scene / "maps", "-o", scene / "p.safetensors", "--encoder-name", "toy"]
    document = run(*words, "--text-space", "tiny", "--json").document
    packs = lc.read_features(scene / "p.safetensors")
    assert (packs.encoder, packs.text_space, packs.views) == ("toy", "tiny", tuple(sorted(VIEWS)))
    for view, values in maps.items():
        grid = packs[view]
        assert isinstance(grid, lc.FeatureGrid) and np.array_equal(grid.grid.numpy(), values)
        np.save(scene / "maps" / f"{view}.png.npy", values.transpose(2, 0, 1))
    assert (document["views"], document["channels"]) == (3, CHANNELS)
    assert run(*words, "--layout", "chw").status == 0
    transposed_pack = lc.read_features(scene / "p.safetensors")
    assert all(torch.equal(transposed_pack[view].codebook, packs[view].codebook) for view in VIEWS)
    (scene / "maps" / "left.npy").write_bytes((scene / "maps" / "left.png.npy").read_bytes())
    assert "left.npy and left.png.npy, both of the view 'left'" in error_line(*words)


def test_retagged_pack_differs_in_its_names_alone(scene: Path) -> None:
    words = ["pack", "retag", scene / "f.safetensors", "-o", scene / "n.safetensors", "--text-space", "mine"]
    assert run(*words, "--json").document["text_space"] == "mine"
    before, after = (lc.read_features(scene / f"{name}.safetensors") for name in "fn")
    assert (after.text_space, after.encoder, before.text_space) == ("mine", before.encoder, "tiny")
    stored_before, stored_after = (load_file(scene / f"{name}.safetensors") for name in "fn")
    assert stored_before.keys() == stored_after.keys()
    assert all(np.array_equal(stored_before[name], stored_after[name]) for name in stored_before)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    for number, view in enumerate(VIEWS):
        Image.effect_noise((64, 48), 40 + 10 * number).convert("RGB").save(tmp_path / f"photos/{view}.png")
    return tmp_path / "photos"


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any, Path]:
    """A CLIP of random weights: the model, its preprocessing, and the file of its weights."""
    with pytest.raises(lc.SplatliftError):  # which imports torchvision, whatever build of it is there
        lc.open_encoder("open_clip:ViT-S-32-alt@nowhere.pt")
    import open_clip

    torch.manual_seed(5)
    path = tmp_path_factory.mktemp("weights") / "clip.pt"
    parts: Any = open_clip.create_model_and_transforms("ViT-S-32-alt")
    torch.save(parts[0].state_dict(), path)
    return parts[0].eval(), parts[2], path


@pytest.mark.slow
def test_encoded_photos_are_lifted_and_asked_in_words(scene: Path, photos: Path, clip: tuple[Any, Any, Path]) -> None:
    encoder, pack, lift = f"maskclip:ViT-S-32-alt@{clip[2]}", scene / "p.safetensors", scene / "x.safetensors"
    document = run("encode", photos, "-o", pack, "--encoder", encoder, "--size", 64, "--json").document
    packs = lc.read_features(pack)
    assert (document["views"], document["channels"], packs.views) == (3, 256, tuple(sorted(VIEWS)))
    grid = packs["left"]
    assert isinstance(grid, lc.FeatureGrid) and grid.grid.shape == (2, 3, 256)
    np.testing.assert_allclose(grid.grid.float().norm(dim=2), 1, atol=2e-3)
    assert packs.text_space == document["text_space"] == f"open_clip:ViT-S-32-alt@{clip[2]}"
    assert run("lift", *sources(scene)[:2], pack, "-o", lift, "--preset", "row-sum").status == 0
    assert run("query", lift, "an apple", "--json").document["encoder"] == "open_clip:ViT-S-32-alt"


@pytest.mark.slow
def test_masks_get_the_vectors_of_their_crops(scene: Path, photos: Path, clip: tuple[Any, Any, Path]) -> None:
    model, prepare, weights = clip
    masks, pack = scene / "masks", scene / "p.safetensors"
    masks.mkdir()
    inside = np.zeros((48, 64), bool)
    inside[10:30, 20:50] = True
    Image.fromarray(inside.astype(np.uint8)).save(masks / "left.png")
    words = ["pack", "masks", masks, "-o", pack, "--encoder", f"open_clip:ViT-S-32-alt@{weights}"]
    assert "--photos: expected" in error_line(*words)
    assert run(*words, "--photos", photos).status == 0
    with Image.open(photos / "left.png") as photo:
        crop = Image.fromarray(np.where(inside[..., None], np.asarray(photo), 0)[10:30, 20:50])
    square = Image.new("RGB", (30, 30))  # black around it
    square.paste(crop, (0, 5))
    with torch.no_grad():
        vector = torch.nn.functional.normalize(model.encode_image(prepare(square)[None])[0], dim=0)
    regions = lc.read_features(pack)["left"]
    assert isinstance(regions, lc.Regions) and float(regions.codebook[0].float() @ vector) > 0.99


def test_inspection_is_that_of_the_library(scene: Path) -> None:
    kinds = {"s": "splats", "c": "cameras", "f": "features", "w": "table", "lift": "lift"}
    for key, kind in kinds.items():
        document = run("inspect", scene / FILES[key], "--json").document
        assert document.pop("file") == str(scene / FILES[key]) and document["kind"] == kind
        assert document == json.loads(json.dumps(evaluate.inspect_file(scene / FILES[key])))
        assert f"kind {kind}" in " ".join(run("inspect", scene / FILES[key]).out.split())


def test_inspection_tells_faults_of_other_files(scene: Path) -> None:
    places = re.sub(r"-?0\.1\b", "0.0", (scene / "c.json").read_text())
    (scene / "c.json").write_text(places)
    cameras = run("inspect", scene / "c.json", "--json").document
    assert (cameras["views"], cameras["sizes"]) == (3, ["32x24"]) and cameras["warnings"] == [
        "3 views share 1 places"
    ]
    save_file({"embeddings": np.eye(2, dtype=np.float32)}, scene / "t.safetensors", {"words": '["cat"]'})
    assert run("inspect", scene / "t.safetensors", "--json").document["warnings"] == ["1 words for 2 rows"]
    tiny_masks = {"a": np.array([[-1, -1]]), "b": np.array([[0, 1]])}
    (scene / "m.safetensors").write_bytes(masks(tiny_masks))
    document = run("inspect", scene / "m.safetensors", "--json").document
    assert (document["names"], document["unlabelled"]) == (["a", "b"], 0.5)
    (scene / "s.ply").unlink()
    warnings = run("inspect", scene / FILES["lift"], "--json").document["warnings"]
    assert len(warnings) == 1 and "no longer at" in warnings[0]


def test_inspection_counts_faults_of_splats_and_features(scene: Path) -> None:
    path, splats = scene / "x.ply", random_splats(1, 200)
    splats = replace(splats, opacity_logits=splats.opacity_logits.clamp(-4, 4))

    def warnings_of(**arrays: torch.Tensor) -> str:
        lc.write_splats(path, replace(splats, **arrays))
        return " | ".join(run("inspect", path, "--json").document["warnings"])

    quats, scales, means = splats.quats.clone(), splats.log_scales.clone(), splats.means.clone()
    quats[1], scales[2], means[4] = 0, -40, 1e7
    for arrays, words in (
        ({}, ""),
        ({"quats": quats}, "1 of 200 splats have a zero quaternion"),
        ({"log_scales": scales}, "smaller than"),
        ({"means": means}, "lie further"),
        ({"opacity_logits": torch.full((200,), -1e4)}, "below 1/255"),
        ({"opacity_logits": torch.linspace(0.05, 1, 200)}, "as if they were no logits"),
        ({"log_scales": torch.full((200, 3), 0.01)}, "as if they were no logarithms"),
    ):
        message = warnings_of(**arrays)
        assert words in message and bool(words) == bool(message), message
    codebook = np.array([[3.0, 4], [0, 0], [1, 0]], np.float32)
    regions = lc.Regions(np.array([[[0, 1], [-1, -1]]], np.int32), codebook)
    write_pack(
        path, {"a": regions, "b": lc.FeatureGrid(np.ones((1, 2, 2), np.float32))}, normalised="true", encoder=""
    )
    document = run("inspect", path, "--json").document
    assert (document["views"], document["region_maps"], document["grids"], document["unlabelled"]) == (2, 1, 1, 0.5)
    assert document["warnings"] == [
        "the pack says normalised, but its vectors have norms from 1 to 5",
        "1 of 5 codebook rows are zero",
        "1 of 5 codebook rows are read by no label",
        "the pack does not name its encoder",
    ]


def test_transferred_rows_are_those_of_the_copies(scene: Path) -> None:
    """Splats that were deleted and put into another order keep their features."""
    splats, lift = lc.read_splats(scene / "s.ply"), lc.load_lift(scene / FILES["lift"])
    rows = torch.randperm(60, generator=torch.manual_seed(0))[:45]
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    lc.write_splats(scene / "edited.ply", replace(splats, **{name: getattr(splats, name)[rows] for name in names}))
    words = ["transfer", scene / FILES["lift"], scene / "edited.ply", "-o", scene / "new.safetensors"]
    document = run(*words, "--json").document
    result = lc.load_lift(scene / "new.safetensors")
    assert torch.equal(result.features, lift.features[rows])
    assert torch.equal(result.total_weight, lift.total_weight[rows])
    assert (document["splats"], document["without_partner"], document["warnings"]) == (45, 0, [])


@pytest.mark.slow
def test_tradeoff_compares_within_its_budget_and_saves(scene: Path) -> None:
    out = scene / "out/compared"
    words = ["tradeoff", *sources(scene), "--budget", "0.1", "--threads", 1, "-o", out]
    document = run(*words, "--json").document
    (exact,) = document["runs"]
    assert document["budget_s"] == 0.1
    assert (exact["name"], exact["views"]) == ("exact", 2) and exact["cosine"] == pytest.approx(1)
    assert not document["choice"]["recommended"] and "exact alone fitted" in document["choice"]["why"]
    assert document["over_budget"] and document["files"] == [
        str(out / f"tradeoff.{end}") for end in ("json", "png", "md")
    ]
    saved = json.loads((out / "tradeoff.json").read_text())
    assert saved["runs"][0]["cosine"] == exact["cosine"] and saved["choice"]["name"] == "exact"
    assert "Nothing can be recommended" in (out / "tradeoff.md").read_text()
    with Image.open(out / "tradeoff.png") as chart:
        assert min(chart.size) > 200
