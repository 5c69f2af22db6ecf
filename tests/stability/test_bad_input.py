"""Mistakes of users: one line on stderr, exit 2, nothing half-written, and stdout empty with --json."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from liftcore import cli
from liftcore.io.splats import write_splats
from liftcore.scene.cameras import Camera, Cameras
from liftcore.values.pack import write_pack
from tests.inria_file import write_inria_cameras
from tests.scenes import random_regions, random_splats

if TYPE_CHECKING:
    from pathlib import Path

LIFT = ["lift", "splats.ply", "cameras.json", "pack.safetensors", "-o", "lift.safetensors"]


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A good scene in the working directory."""
    write_splats(tmp_path / "splats.ply", random_splats(1, 20))
    pose = np.eye(4)
    pose[2, 3] = 4.0
    write_inria_cameras(
        Cameras((Camera.pinhole("v0", 16, 12, 16.0, 16.0, 8.0, 6.0, pose),)), tmp_path / "cameras.json"
    )
    write_pack(tmp_path / "pack.safetensors", {"v0": random_regions(1)}, {})
    save_file({"embeddings": torch.eye(2, 6)}, str(tmp_path / "table"), metadata={"words": '["cat", "dog"]'})
    monkeypatch.chdir(tmp_path)
    return tmp_path


def files(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.lstat().st_size for path in sorted(folder.rglob("*"))}


def assert_refused(capsys: pytest.CaptureFixture[str], folder: Path, arguments: list[str], words: str = "") -> None:
    for extra in ([], ["--json"]):
        before = files(folder)
        status = cli.main([*arguments, *extra])
        captured = capsys.readouterr()
        assert status == 2, captured.err
        # What is wrong with features may show when their view is read, after the plan was printed for people.
        assert not captured.out or (captured.out.startswith("plan: ") and not extra)
        assert captured.err.count("\n") == 1
        assert words in captured.err
        assert files(folder) == before


@pytest.mark.parametrize(
    ("place", "other"),
    [
        (place, other)
        for place in (1, 2, 3)
        for other in ("missing", "folder", "splats.ply", "table", "made.safetensors")
        if LIFT[place] != other
    ],
)
def test_a_wrong_kind_of_file_is_refused_wherever_it_stands(scene: Path, capsys, place: int, other: str) -> None:
    (scene / "folder").mkdir()
    assert cli.main([*LIFT[:5], "made.safetensors"]) == 0
    capsys.readouterr()
    arguments = [*LIFT]
    arguments[place] = other
    assert_refused(capsys, scene, arguments)


def test_settings_that_no_lift_has_are_refused(scene: Path, capsys) -> None:
    for settings in (
        ["--set", "gain=NaN"],
        ["--set", "levels=cubic"],
        ["--set", "power=" + "[" * 100_000],
        ["--threads", "0"],
    ):
        assert_refused(capsys, scene, [*LIFT, *settings])


def test_an_output_that_is_an_input_and_a_pack_given_twice_are_refused(scene: Path, capsys) -> None:
    for path in ("splats.ply", "cameras.json", "pack.safetensors", "./pack.safetensors"):
        assert_refused(capsys, scene, [*LIFT[:5], path], "another file than the inputs")
    assert_refused(capsys, scene, [*LIFT[:4], "pack.safetensors", *LIFT[4:]], "each view in one pack")


def test_an_output_below_a_file_is_refused_before_the_work(scene: Path, capsys) -> None:
    assert_refused(capsys, scene, [*LIFT[:5], "splats.ply/lift.safetensors"], "output")
    assert_refused(capsys, scene, [*LIFT[:5], "x" * 300], "output")


def test_an_output_in_a_locked_folder_is_refused_before_the_work(scene: Path) -> None:
    (scene / "locked").mkdir(mode=0o500)
    before = files(scene)
    # In a process of its own, where root gives up what lets it write everywhere: PR_CAPBSET_DROP, CAP_DAC_OVERRIDE.
    giving_up = "import ctypes, os, sys; os.geteuid() or ctypes.CDLL(None).prctl(24, 1, 0, 0, 0)"
    command = [sys.executable, "-c", f"{giving_up}; os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"]
    arguments = ["-m", "liftcore.cli", *LIFT[:5], "locked/lift.safetensors"]
    process = subprocess.run([*command, *arguments], cwd=scene, capture_output=True, text=True, check=False)
    assert (process.returncode, process.stdout) == (2, ""), process.stderr
    assert process.stderr.count("\n") == 1
    assert "can be written" in process.stderr
    assert files(scene) == before


def test_a_folder_of_the_output_that_is_missing_is_made(scene: Path, capsys) -> None:
    assert cli.main([*LIFT[:5], "new/folder/lift.safetensors", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["splats"] == 20
    assert captured.out.count("\n") == 1
    assert captured.err == ""
    output = scene / "new" / "folder" / "lift.safetensors"
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(output.stat().st_mode) == 0o666 & ~umask
    assert [path.name for path in output.parent.iterdir()] == [output.name]


def test_broken_questions_are_refused(scene: Path, capsys) -> None:
    assert cli.main(LIFT) == 0
    capsys.readouterr()
    ask = ["query", "lift.safetensors", "cat", "--table", "table"]
    assert_refused(capsys, scene, ["query", "pack.safetensors", *ask[2:]], "lift")
    assert_refused(capsys, scene, ["query", "nowhere", *ask[2:]])
    assert_refused(capsys, scene, ["query", "lift.safetensors", "horse", *ask[3:]])
    assert_refused(capsys, scene, [*ask[:4], "lift.safetensors"])
    assert_refused(capsys, scene, [*ask, "--view", "v9"], "v0")
    assert_refused(capsys, scene, [*ask, "--view", "v0", "--mask", "a.png", "--attention", "a.png"], "twice")
    assert_refused(capsys, scene, [*ask, "--scores", "table"], "another file")
    assert_refused(capsys, scene, [*ask, "--threshold", "maybe"])


def test_a_lift_answers_from_any_folder_until_its_splats_move(scene: Path, capsys, monkeypatch) -> None:
    assert cli.main(LIFT) == 0
    other_folder = scene / "elsewhere"
    other_folder.mkdir()
    monkeypatch.chdir(other_folder)
    ask = ["query", "../lift.safetensors", "cat", "--table", "../table", "--view", "v0", "--mask", "m.png", "--json"]
    capsys.readouterr()
    assert cli.main(ask) == 0
    assert json.loads(capsys.readouterr().out)["view"]["name"] == "v0"
    (scene / "splats.ply").rename(other_folder / "moved.bin")
    (other_folder / "m.png").unlink()
    assert_refused(capsys, scene, ask[:-1], "nothing there")


def test_a_lift_beside_its_cameras_does_not_change_them(scene: Path, capsys) -> None:
    arguments = ["lift", "splats.ply", ".", "pack.safetensors", "-o", "lift.safetensors"]
    assert cli.main(arguments) == 0
    assert cli.main(["query", "lift.safetensors", "cat", "--table", "table", "--view", "v0"]) == 0
    assert cli.main(arguments) == 0
    capsys.readouterr()
    assert_refused(capsys, scene, [*arguments[:5], "cameras.json"], "another file than the inputs")
