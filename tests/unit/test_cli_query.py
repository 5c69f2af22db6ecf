"""``splatlift query``: the place of its texts, the queries that it rejects, and the files that it writes."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.numpy import save_file

from liftcore import cli
from liftcore.errors import InvalidInput, InvalidLift
from liftcore.io.splats import read_splats
from liftcore.query.question import Query
from liftcore.query.result import load_lift
from liftcore.query.scene import Scene
from liftcore.text import BUILT_IN, open_encoder
from liftcore.values.lift_file import NODE_TENSORS, save_lift

from .command_line import assert_one_line, lift_arguments, run, write_toy_scene

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """The folder of the toy scene and its lift."""
    assert run(capsys, *lift_arguments(write_toy_scene(tmp_path)))[0] == 0
    return tmp_path


@pytest.mark.parametrize(
    "arguments",
    [
        ["L", "--table", "w", "a mug"],
        ["--table", "w", "L", "a mug"],
        ["--like", "e.npy", "L", "--view", "v", "a mug"],
        ["L", "--view", "v", "a mug", "--negative", "cat", "dog", "--table", "w", "--negative", "cow"],
        ["L", "--view", "v", "--", "a mug"],
    ],
)
def test_the_text_of_a_query_stands_before_between_or_after_options(arguments: list[str]) -> None:
    options = cli.build_parser().parse_args(["query", *arguments])
    assert (str(options.lift), options.text) == ("L", "a mug")
    assert options.negatives == (["cat", "dog", "cow"] if "--negative" in arguments else [])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["L", "red", "mug"], "arguments: mug; a text of several words is one, in quotes"),
        (["L", "--view", "v", "red", "mug"], "arguments: mug; a text of several words is one, in quotes"),
        (["L", "--vieuw", "v", "mug"], "arguments: --vieuw v"),
        (["L", "--negative", "cat", "mug"], "before --negative, got only --negative cat mug"),
        (["L", "cat", "--mask", "m.png"], "no --view"),
    ],
)
def test_what_a_query_has_no_place_for_is_reported(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = run(capsys, "query", *arguments)
    assert (status, out) == (2, "")
    assert message in err
    assert_one_line(err)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ("none", "text space is 'none': its"),
        ("", "text space is not recorded"),
        ("mine", "text space 'mine' is not the name"),
    ],
)
def test_words_to_a_lift_without_a_text_encoder_are_refused_with_its_text_space(
    space: str, message: str, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lift = load_lift(scene / "lift.safetensors")
    lift = replace(lift, metadata=lift.metadata.model_copy(update={"text_space": space}))
    save_lift(lift, scene / "other.safetensors")
    status, out, err = run(capsys, "query", scene / "other.safetensors", "mug")
    assert (status, out) == (2, "")
    assert message in err and "--like" in err
    assert_one_line(err)


def test_the_table_that_ships_answers_where_weights_of_its_space_cannot_be_had(
    scene: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(scene))
    lift = load_lift(scene / "lift.safetensors")
    metadata = lift.metadata.model_copy(update={"text_space": BUILT_IN["lvis"]})
    words = torch.from_numpy(open_encoder("lvis").encode(["mug", "cat"]))
    lift = replace(lift, features=words.half(), metadata=metadata)
    with pytest.raises(InvalidLift, match="node_features: expected node_features of 512 channels"):
        save_lift(lift, scene / "clip.safetensors")
    save_lift(replace(lift, **dict.fromkeys(NODE_TENSORS)), scene / "clip.safetensors")
    status, out, _ = run(capsys, "query", scene / "clip.safetensors", "cat", "--json")
    document, name = json.loads(out), open_encoder("lvis").name
    assert (status, document["encoder"], document["answer"]["statistics"]["max"]) == (
        0,
        name,
        pytest.approx(1.0, abs=1e-3),
    )
    assert "using the table lvis" in caplog.text
    # By all words that happen to be here: not asked.
    assert run(capsys, "segment", scene / "clip.safetensors")[0] == 2
    assert run(capsys, "query", scene / "clip.safetensors", "cat", "--encoder", BUILT_IN["lvis"])[0] == 2


def test_overlays_show_what_was_found_and_say_its_share(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = np.full((48, 96, 3), 100, np.uint8)  # thrice the camera's size
    Image.fromarray(photo).save(scene / "photo.png")
    shares, pictures = [], []
    for number, cut in enumerate((0.5, -1)):  # one of the two splats, and both
        options = ["--like", "splat:1", "--threshold", cut, "--view", "front.jpg", "--photo", scene / "photo.png"]
        out = scene / f"{number}.png"
        status, stdout, _ = run(capsys, "query", scene / "lift.safetensors", *options, "--overlay", out, "--json")
        assert status == 0
        view = json.loads(stdout)["view"]
        shares.append(view["mask_share"])
        with Image.open(out) as picture:
            pictures.append(np.asarray(picture).astype(int))
        assert view["name"] == "front"
    assert 0 < shares[0] < shares[1]
    for share, picture in zip(shares, pictures, strict=True):
        assert picture.shape[1] == 32 and picture.shape[0] > 16 and picture[16:].min() < 128  # a caption below
        image = picture[:16]
        tinted, dimmed = image[..., 0] > 100, image[..., 0] < 50
        assert np.mean(tinted) >= share and np.mean(dimmed) <= 1 - share  # the outline is beside the mask


def test_every_term_and_option_is_part_of_the_query(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    queries: list[Query] = []

    def ask(scene: object, query: Query, encoder: object) -> None:
        queries.append(query)
        raise KeyboardInterrupt  # what is found is another matter

    monkeypatch.setattr("liftcore.query.ask.ask", ask)
    question = ["query", scene / "lift.safetensors", "--like", "splat:1", "--unlike", "splat:0"]
    for options in (
        [],
        ["--threshold", "0.25", "--keep", "largest"],
        ["--instances", "3"],
    ):
        assert run(capsys, *question, *options)[0] == cli.INTERRUPTED
    choices = [(query.threshold, query.keep, query.instances) for query in queries]
    assert choices == [("auto", "all", None), (0.25, "largest", None), ("auto", "all", 3)]
    assert {tuple(map(str, query.terms)) for query in queries} == {("splat:1", "splat:0")}


def test_what_was_found_is_written_as_splats_and_over_no_input(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in scene.iterdir()}
    question = ["query", scene / "lift.safetensors", "--like", "splat:1"]
    for name in ("splats.ply", "cameras.json", "pack.safetensors", "lift.safetensors"):
        status, _, err = run(capsys, *question, "--object", scene / name)
        assert status == 2 and ("another file than the inputs" in err or "ending in" in err)
    empty = ["--unlike", "splat:1", "--threshold", "1", "--scores", scene / "s.npy", "--object", scene / "o.ply"]
    status, out, err = run(capsys, *question, *empty)
    assert (status, out) == (2, "")
    assert "nothing stands out" in err and "lower threshold" in err
    assert_one_line(err)
    assert {path: path.read_bytes() for path in scene.iterdir()} == before
    files = {kind: scene / f"{kind}.ply" for kind in ("object", "coloured")}
    options = [part for kind, path in files.items() for part in (f"--{kind}", path)]
    status, out, err = run(capsys, *question, "--json", *options)
    assert (status, err) == (0, "")
    assert json.loads(out)["files"] == {kind: str(path) for kind, path in files.items()}
    splats = read_splats(scene / "splats.ply")
    assert torch.equal(read_splats(files["object"]).means, splats.means[1:])
    assert torch.equal(read_splats(files["coloured"]).means, splats.means)


OPTIONS = [
    ("query", "--object", ".sog"),
    ("query", "--object", ".compressed.ply"),
    ("query", "--coloured", ".glb"),
    ("query", "--scores", ".csv"),
    ("query", "--mask", ".jpg"),
    ("query", "--attention", ".webp"),
    ("query", "--overlay", ".jpg"),
    ("segment", "--labels", ".tif"),
    ("segment", "--picture", ".jpg"),
    ("segment", "--coloured", ".splat"),
    ("segment", "--splat-labels", ".txt"),
    ("segment", "--labelled", ".spz"),
    ("objects", "--csv", ".xlsx"),
    ("render", "-o", ".jpg"),
]


@pytest.mark.parametrize(("command", "option", "suffix"), OPTIONS)
def test_a_suffix_that_is_not_written_is_refused_before_the_work(
    command: str, option: str, suffix: str, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = scene / f"mug{suffix}"
    options = ["--like", "splat:1"] if command == "query" else []
    view = [] if command == "objects" else ["--view", load_lift(scene / "lift.safetensors").metadata.views[0]]
    status, out, err = run(capsys, command, scene / "lift.safetensors", *options, *view, option, path)
    assert (status, out) == (2, "") and not path.exists() and suffix in err and "ending in ." in err
    if suffix == ".sog":
        assert f"splat-transform mug.ply mug{suffix}" in err
    assert_one_line(err)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["objects", "--vocabulary", "nowhere.txt", "--encoder", "lvis"], "--vocabulary: expected a file of words"),
        (["segment", "--words", "nowhere.txt"], "--words: expected a file of words"),
        (["export", "--words", "nowhere.txt", "-o", "x.ply"], "--words: expected a file of words"),
        (["export", "--prims", "-o", "x.glb"], "ends in .usdc or .usdz, got an output that ends in .glb"),
        (["objects", "--distance", *"0001002", "--metres-per-unit", "2"], "one of --distance and --metres-per-unit"),
    ],
)
def test_what_does_not_fit_is_said_in_the_words_of_the_options_and_before_an_encoder_opens(
    arguments: list[str], message: str, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command, *options = arguments
    status, _, err = run(capsys, command, scene / "lift.safetensors", *options)
    assert status == 2 and message in err
    assert_one_line(err)


def test_a_file_of_another_kind_is_never_replaced(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ("splats.ply", "cameras.json", "pack.safetensors")
    lift = ["lift", *(scene / name for name in names), "-o"]
    save_file({"embeddings": np.eye(2, 4, dtype="f4")}, scene / "words.safetensors", {"words": '["a", "b"]'})
    save_file({"weight": np.zeros(3, "f4")}, scene / "weights.safetensors")
    before = {path: path.read_bytes() for path in scene.iterdir()}
    for name, kind in (("words", "table"), ("weights", "a safetensors file")):
        status, _, err = run(capsys, *lift, scene / f"{name}.safetensors")
        assert status == 2 and kind in err
    assert run(capsys, *lift, scene / "lift.sog")[0] == 2
    question = ["query", scene / "lift.safetensors", "--like", "splat:1", "--object", scene / "mug.ply"]
    (scene / "mug.ply").write_bytes(b"\x89PNG\r\n\x1a\n0123")
    status, _, err = run(capsys, *question)
    assert status == 2 and "a picture" in err
    (scene / "mug.ply").unlink()
    assert {path: path.read_bytes() for path in scene.iterdir()} == before
    assert run(capsys, *question)[0] == 0 and run(capsys, *question)[0] == 0  # one of its own kind is
    assert run(capsys, *lift, scene / "lift.safetensors")[0] == 0


def test_rows_of_another_number_of_splats_are_refused_wherever_a_lift_is_asked(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lift = load_lift(scene / "lift.safetensors")
    rows = ("features", "total_weight", "view_consistency", "has_feature", "confidence", "cluster", "object", "node")
    cut = {name: getattr(lift, name)[:-1] for name in rows if getattr(lift, name) is not None}
    cropped = replace(lift, **cut)
    save_lift(cropped, scene / "cropped.safetensors")
    question = ["query", scene / "cropped.safetensors", "--like", "splat:0", "--threshold", "-1"]
    for options in (["--objects"], ["--top", "1"], ["--object", scene / "o.ply"], ["--coloured", scene / "c.ply"]):
        status, out, err = run(capsys, *question, *options)
        assert (status, out) == (2, "") and "row" in err and str(len(cropped.features)) in err
    with pytest.raises(InvalidInput, match="row"):
        Scene(cropped).axes  # noqa: B018
    with pytest.raises(InvalidInput, match="row"):
        Scene(cropped).splats  # noqa: B018
