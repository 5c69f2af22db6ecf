"""The command line: one JSON object or one line of error; the exit status is 2 for wrong input, 1 for our faults."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from liftcore import cli
from liftcore.cli import reply
from liftcore.cli.lift import pairs_of
from liftcore.errors import InvalidFeatures, InvalidSettings, SplatliftError, Unavailable
from liftcore.lifting.files import lift_files
from liftcore.query.question import METHODS
from liftcore.query.result import load_lift
from liftcore.runtime import plugins
from liftcore.runtime.progress import progress_bars
from liftcore.values.pack import write_pack
from liftcore.values.settings import LiftSettings, Preset
from liftcore.values.views import FeatureGrid

from .command_line import assert_one_line, lift_arguments, run, write_toy_scene

if TYPE_CHECKING:
    from pathlib import Path

COMMANDS = ["demo", "serve", "lift", "plan", "query", "pack", "encode", "inspect", "evaluate"]


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_toy_scene(tmp_path)


def test_scene_is_lifted_inspected_and_queried(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, *lift_arguments(scene, "--preset", "row-sum", "--json"))
    assert (status, err) == (0, "")
    document = json.loads(out)
    assert (document["splats"], document["channels"], document["views"]) == (2, 3, 1)
    assert document["settings"]["preset"] == "row-sum"
    assert document["feature_share"] == 1
    assert document["warnings"] == ["1 views have features but no camera and were skipped: lost"]
    assert {"diagnostics", "timings", "out"} <= set(document)
    features = load_lift(scene / "lift.safetensors").features
    assert features[0, 0] > 0.9
    assert features[1, 1] > 0.9

    words = '["left", "right"]'
    save_file({"embeddings": torch.eye(2, 3)}, str(scene / "table"), metadata={"words": words})
    files = {kind: scene / name for kind, name in (("mask", "m.png"), ("attention", "a.png"), ("scores", "s.npy"))}
    options = [part for kind, path in files.items() for part in (f"--{kind}", path)]
    question = ["query", scene / "lift.safetensors", "left", "--table", scene / "table", "--threshold", "0.5"]
    status, out, err = run(capsys, *question, "--view", "front", "--top", 1, "--json", *options)
    assert (status, err) == (0, "")
    document = json.loads(out)
    assert document["answer"]["count"] == 1
    assert document["answer"]["top"][0]["splat"] == 0
    assert document["files"] == {kind: str(path) for kind, path in files.items()}
    scores = np.load(files["scores"])
    assert scores.dtype == np.float32
    assert scores[0] > 0.9
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in (files["mask"], files["attention"]))

    status, out, err = run(capsys, *question)
    assert status == 0
    assert "'left': 1 of 2 splats" in out and "object" not in out
    status, out, err = run(capsys, *question, "--objects", "--top", 2)
    assert re.search(r"  splat 0: score \S+ at \(\S+, \S+, \S+\)\n  splat 1: ", out)
    assert "\n  object 1: 1 splats, 100.0% of the selection, score 0.9" in out and "in no object" not in out
    status, out, err = run(capsys, *question, "--objects", "--json")
    (obj,) = json.loads(out)["answer"]["objects"]
    assert obj["splats"] == 1 and [*obj["box"].values()] == [obj["centre"]] * 2
    assert json.loads(out)["answer"]["unassigned_splats"] == 0
    status, out, err = run(capsys, "inspect", scene / "lift.safetensors", "--json")
    assert json.loads(out)["kind"] == "lift"
    diagnostics, timings = run(capsys, *lift_arguments(scene, "--verbose"))[1].split("timings:\n")
    assert "row_sum_mean: " in diagnostics
    stages = [line for line in timings.splitlines() if not line.startswith("warning: ")]
    assert stages and all(re.fullmatch(r"  [a-z]+: \d+\.\d{3} s", line) for line in stages)
    status, out, err = run(capsys, *question[:3])
    assert status == 2
    assert "--table FILE or --encoder NAME" in err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--set", "power=3"], "power"),
        (["--set", "nonsense=1"], "--set: expected a setting of a lift, got the unknown 'nonsense'; nearest: "),
        (["--set", "robust-steps=1"], "nearest: robust_steps"),
        (["--preset", "row-sum", "--set", "preset=argmax"], "got --preset row-sum and --set preset=argmax"),
        (["--set", "stride=2", "--set", "stride=3"], "stride: expected one value, got --set stride=2 and --set st"),
        (["--set", "power"], "key=value"),
        (["-o", "."], "the folder"),
        (["--checkpoint", "{scene}/splats.ply"], "checkpoint: expected a folder that can be written"),
    ],
)
def test_wrong_settings_exit_2_with_one_line(
    options: list[str], message: str, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = run(capsys, *lift_arguments(scene, *(text.format(scene=scene) for text in options), "--json"))
    assert (status, out) == (2, "")
    assert message in err
    assert_one_line(err)
    assert not (scene / "lift.safetensors").exists()


def test_files_in_each_others_place_are_named_in_the_error(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    splats, cameras, pack, maps = (
        scene / name for name in ("splats.ply", "cameras.json", "pack.safetensors", "maps")
    )
    maps.mkdir()
    for arguments, message in (
        (["plan", cameras, splats, pack], "splats as SPLATS, got cameras; the order is SPLATS CAMERAS FEATURES"),
        (["plan", splats, pack, cameras], "pack.safetensors: expected cameras as CAMERAS, got features"),
        (["plan", splats, cameras, cameras], "cameras.json: expected features as FEATURES, got cameras"),
        (["plan", splats, cameras, maps], "got a folder; make packs with 'splatlift pack'"),
        (["query", pack, "word"], "pack.safetensors: expected lift as LIFT, got features"),
        (["query", scene / "none", "word", "--splats", pack], "expected splats as --splats, got features"),
    ):
        status, out, err = run(capsys, *arguments)
        assert (status, out) == (2, "") and message in err
        assert_one_line(err)


def test_a_lift_takes_its_files_as_texts_and_its_packs_as_a_list(scene: Path) -> None:
    files = [str(scene / name) for name in ("splats.ply", "cameras.json", "pack.safetensors")]
    lift = lift_files(files[0], files[1], files[2:], LiftSettings.of())
    assert lift.metadata.splats.path == str((scene / "splats.ply").resolve())
    for single in (files[2], scene / "pack.safetensors"):
        with pytest.raises(InvalidFeatures, match="a list of feature packs"):
            lift_files(files[0], files[1], single, LiftSettings.of())  # pyright: ignore[reportArgumentType]


def test_settings_are_json_or_words() -> None:
    pairs = pairs_of(["power=2", "lift_gain=0.8", "dtype=float32", "diagnostic_rays=0"])
    settings = LiftSettings.of(preset="row-sum", **pairs)
    assert pairs_of(["power=2", "power=2"]) == {"power": 2}
    assert (settings.power, settings.lift_gain, settings.dtype) == (2, 0.8, "float32")
    assert str(pairs_of(["damping=NaN"])["damping"]) == "nan"  # which is no contradiction to itself
    for wrong, message in ((["=1"], "key=value"), (["damping=1", "damping=2"], "damping: expected one value")):
        with pytest.raises(InvalidSettings, match=message):
            pairs_of(wrong)
    assert LiftSettings.model_validate({"diagnostic_rays": 5_000_000}).diagnostic_rays == 5_000_000  # older lifts'
    with pytest.raises(InvalidSettings, match="diagnostic_rays: expected at most 1000000 rays, got 5000000"):
        LiftSettings.of(diagnostic_rays=5_000_000)


def test_inspect_speaks_to_people_and_programs(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, _ = run(capsys, "inspect", scene / "splats.ply")
    assert status == 0 and "3dgs" in out
    out = run(capsys, "inspect", scene / "splats.ply", "--json")[1]
    assert json.loads(out)["splats"] == 2 and out.count("\n") == 1
    words = [f"word {row}" for row in range(50)]
    save_file({"embeddings": torch.eye(50)}, str(tmp_path / "t"), metadata={"words": json.dumps(words)})
    assert "word 5, ... (50)\n" in run(capsys, "inspect", tmp_path / "t")[1]
    assert json.loads(run(capsys, "inspect", tmp_path / "t", "--json")[1])["words"] == words


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_and_names_its_choices(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, command, "--help")
    text = " ".join(out.split())
    assert (status, err) == (0, "") and f"splatlift {command}" in text
    assert command not in ("query", "evaluate") or f"{', '.join(METHODS)} or a number" in text
    assert command not in ("lift", "plan") or all(preset in text for preset in Preset)


@pytest.mark.parametrize(
    "arguments",
    [[], ["dance"], ["lift"], ["lift", "a", "b", "c"], ["inspect", "a", "b"]],
)
def test_wrong_arguments_exit_2_with_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, *arguments)
    assert (status, out) == (2, "")
    assert_one_line(err)


def test_our_own_fault_exits_1_with_one_line(
    scene: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(path: Path) -> dict[str, Any]:
        raise RuntimeError("two\nlines")

    monkeypatch.setattr("liftcore.evaluate.inspect_file", broken)
    status, out, err = run(capsys, "inspect", scene, "--json")
    assert (status, out) == (1, "")
    assert_one_line(err)
    assert "RuntimeError: two lines" in err
    with pytest.raises(RuntimeError):
        cli.main(["inspect", str(scene), "--debug"])


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys; from liftcore.cli import main; status = main(['--help']); "
        "heavy = {'torch', 'numba', 'numpy', 'pydantic', 'tqdm'} & set(sys.modules); sys.exit(status or bool(heavy))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode == 0


def test_closed_pipe_is_no_complaint(scene: Path) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, "-m", "liftcore.cli", "inspect", str(scene / "splats.ply")]
    with os.fdopen(write_end, "wb") as closed:
        process = subprocess.run(command, check=False, stdout=closed, stderr=subprocess.PIPE)
    assert process.stderr == b""


def test_replies_are_strict_json_and_errors_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    reply.reply({"a": float("nan"), "b": [float("inf"), (1, 2)], "c": {"d": -float("inf")}}, as_json=True)
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [None, [1, 2]], "c": {"d": None}}
    error = SplatliftError("a\nb", expected="c\nd", got="e\tf", hint="g\n")
    assert str(error) == "a b: expected c d, got e f; g"


def test_progress_is_drawn_only_on_a_terminal(
    scene: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for is_terminal in (False, True):
        monkeypatch.setattr(sys.stderr, "isatty", lambda is_terminal=is_terminal: is_terminal)
        with progress_bars() as progress:
            progress("compile", 0, 1, "steps")
            assert ("compile:   0%" in capsys.readouterr().err) is is_terminal
            progress("compile", 1, 1, "steps")
            # An empty line, before other output.
            assert capsys.readouterr().err.endswith("\r") is is_terminal
            for count in range(4):
                progress("geometry", count, 3, "views")
        captured = capsys.readouterr()
        assert captured.out == ""
        assert ("geometry" in captured.err) is is_terminal
        assert captured.err.endswith("\n") is is_terminal
    assert "save:   0%" in run(capsys, *lift_arguments(scene, "--json"))[2]


@pytest.fixture
def little_memory(monkeypatch: pytest.MonkeyPatch) -> str:
    """The warning of a plan on a machine with too little memory."""
    warning = "the rest of the lift may take 9.0 GiB and 1.0 GiB are free"
    monkeypatch.setattr("liftcore.lifting.planning.plan.check_memory", lambda parts, free: [warning])
    return warning


def test_plan_is_printed_alone_and_before_a_lift_and_kept_with_it(
    scene: Path, little_memory: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = lift_arguments(scene)
    status, out, err = run(capsys, "plan", *arguments[1:4], "--json")
    assert (status, err) == (0, "")
    plan = json.loads(out)
    assert plan["views"] == {"lifted": ["front"], "left_out": []}
    assert (plan["splats"], plan["channels"], plan["dtype"]) == (2, 3, "float16")
    assert plan["memory_bytes"] == sum(plan["memory"].values())
    status, out, _ = run(capsys, *arguments, "--explain", "--quality", "draft", "--set", "stride=1")
    summary = "plan: 2 splats (3dgs), 100.0% in some view's field; 1 of 1 views"
    assert status == 0 and out.startswith(f"{summary}\n")
    metadata = load_lift(scene / "lift.safetensors").metadata
    assert (metadata.settings.quality, metadata.settings.stride, metadata.settings.view_cosine) == ("draft", 1, 0.98)
    assert metadata.diagnostics["plan"]["memory_bytes"] == plan["memory_bytes"]
    status, out, err = run(capsys, *arguments)
    plan_text, _, rest = out.partition(f"{scene / 'lift.safetensors'}: ")
    first, channels, memory, warning = plan_text.splitlines()
    assert (status, err, first, channels) == (0, "", summary, "  3 channels, stored as float16")
    assert memory.startswith("  about ") and " MiB at the peak, on " in memory
    assert warning == f"warning: {little_memory}" and little_memory not in rest
    status, out, err = run(capsys, *arguments, "--json", "--explain")
    assert (status, err, out.count("\n")) == (0, "", 1)
    document = json.loads(out)
    assert document["warnings"][0] == little_memory and document["diagnostics"]["plan"]["channels"] == 3
    assert little_memory not in document["diagnostics"]["warnings"]  # equal inputs give equal diagnostics


def test_what_the_plan_warned_of_is_said_once(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    square = FeatureGrid(torch.ones(16, 16, 3))
    write_pack(scene / "pack.safetensors", {"front": square}, {"encoder": "toy", "text_space": "none"})
    for options in (["--explain"], []):
        assert run(capsys, *lift_arguments(scene), *options)[1].count("maps of another aspect") == 1
    document = json.loads(run(capsys, *lift_arguments(scene), "--explain", "--json")[1])
    assert sum("maps of another aspect" in warning for warning in document["warnings"]) == 1


def test_commands_and_the_page_of_a_missing_service_say_what_to_install(
    monkeypatch: pytest.MonkeyPatch, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(capsys, *lift_arguments(scene))[0] == 0
    monkeypatch.setattr(plugins, "_entries", lambda group: ())
    for command in (["serve"], ["keys", "list"]):
        status, out, err = run(capsys, *command)
        assert (status, out) == (2, "") and "pip install 'splatlift[service]'" in err
        assert_one_line(err)
    with pytest.raises(Unavailable, match=r"pip install 'splatlift\[service\]'"):
        load_lift(scene / "lift.safetensors").show()
    assert "run the HTTP service" in run(capsys, "--help")[1]


def test_a_second_lift_of_a_checkpoint_gives_the_same_bits(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint, features = scene / "kept" / "here", []
    for _ in range(2):
        assert run(capsys, *lift_arguments(scene, "--checkpoint", checkpoint, "--device", "cpu"))[0] == 0
        features.append(load_lift(scene / "lift.safetensors").features.clone())
        assert list(checkpoint.glob("*.safetensors"))
    assert torch.equal(*features)
