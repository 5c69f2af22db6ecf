"""What a lift tells while it works: its plan before the first view, and every stage that takes time."""

from __future__ import annotations

import json
import logging
import sys
from typing import TYPE_CHECKING

import pytest

from liftcore import lifting as pipeline
from liftcore.cli import reply
from liftcore.io.scene_files import lift_files
from liftcore.settings import LiftSettings

from .command_line import lift_arguments, run, write_toy_scene
from .solve.test_lift_equals_dense import write_scene

if TYPE_CHECKING:
    from pathlib import Path

    from liftcore.planning.plan import Plan

ONE_STEP = ("read", "digest", "compile", "plan", "certify")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_toy_scene(tmp_path)


@pytest.fixture
def little_memory(monkeypatch: pytest.MonkeyPatch) -> str:
    """What a machine has to say whose memory is short."""
    told = "the rest of the lift may take 9.0 GiB and 1.0 GiB are free"
    monkeypatch.setattr("liftcore.planning.plan.check_memory", lambda parts, free: [told])
    return told


def test_plan_is_told_once_and_before_the_first_view(tmp_path: Path) -> None:
    splats, cameras, pack = write_scene(tmp_path, 3)
    stages: list[str] = []
    plans: list[tuple[Plan, set[str]]] = []

    def hear(stage: str, done: int, total: int, unit: str) -> None:
        stages.append(stage)

    made = lift_files(
        splats,
        cameras,
        [pack],
        LiftSettings.of(),
        progress=hear,
        on_plan=lambda plan: plans.append((plan, set(stages))),
    )
    [(plan, before)] = plans
    assert before == {"read", "digest", "compile", "plan"}
    assert plan.facts() == made.metadata.certificate["plan"]


def test_plan_that_its_hearer_refuses_stops_the_lift(scene: Path) -> None:
    def refuse(plan: Plan) -> None:
        raise InterruptedError(plan.kernel)

    files = [scene / name for name in ("splats.ply", "cameras.json", "pack.safetensors")]
    with pytest.raises(InterruptedError, match="3dgs"):
        lift_files(files[0], files[1], files[2:], LiftSettings.of(), on_plan=refuse)


def test_every_stage_is_told_from_its_beginning_and_none_goes_back(tmp_path: Path) -> None:
    splats, cameras, pack = write_scene(tmp_path, 3)
    said: list[tuple[str, int, int, str]] = []

    def hear(stage: str, done: int, total: int, unit: str) -> None:
        said.append((stage, done, total, unit))

    made = lift_files(splats, cameras, [pack], LiftSettings.of(), progress=hear)
    for stage in ONE_STEP:
        assert [word for word in said if word[0] == stage] == [(stage, 0, 1, "steps"), (stage, 1, 1, "steps")]
    order = list(dict.fromkeys(stage for stage, *_ in said))
    assert order == ["read", "digest", "compile", "plan", "geometry", "robust", "solve", "certify"]
    assert set(order) <= made.metadata.timings.keys()
    for stage in order:
        done = [word[1] for word in said if word[0] == stage]
        assert done == sorted(done)


def test_what_a_machine_lacks_goes_to_whoever_listens_else_to_the_log(
    scene: Path, little_memory: str, caplog: pytest.LogCaptureFixture
) -> None:
    files = [scene / name for name in ("splats.ply", "cameras.json", "pack.safetensors")]
    heard: list[Plan] = []
    with caplog.at_level(logging.WARNING):
        lift_files(files[0], files[1], files[2:], LiftSettings.of(), on_plan=heard.append)
        assert heard[0].warnings == (little_memory,) and little_memory not in caplog.text
        lift_files(files[0], files[1], files[2:], LiftSettings.of())
        assert caplog.text.count(little_memory) == 1


def test_command_shows_the_plan_before_the_work_in_a_few_lines(
    scene: Path, little_memory: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = run(capsys, *lift_arguments(scene))
    assert (status, err) == (0, "")
    plan, _, rest = out.partition(f"{scene / 'lift.safetensors'}: ")
    first, channels, memory, warning = plan.splitlines()
    assert first == "plan: 2 splats (3dgs), 100.0% in some view's field; 1 of 1 views"
    assert channels == "  3 channels, stored as float16"
    assert memory.startswith("  about ") and " MiB at the peak, on " in memory
    assert warning == f"warning: {little_memory}" and little_memory not in rest


def test_command_with_json_says_one_object_and_nothing_beside(
    scene: Path, little_memory: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = run(capsys, *lift_arguments(scene, "--json", "--explain"))
    assert (status, err, out.count("\n")) == (0, "", 1)
    document = json.loads(out)
    assert document["warnings"][0] == little_memory and document["certificate"]["plan"]["channels"] == 3
    assert little_memory not in document["certificate"]["warnings"]  # equal inputs give equal certificates


@pytest.mark.parametrize("flags", [[], ["--explain"], ["--json"]])
def test_command_plans_once(
    flags: list[str], scene: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plans = []
    plan_lift = pipeline.plan_lift

    def counted(*given: object) -> Plan:
        plans.append(plan_lift(*given))  # pyright: ignore[reportArgumentType]
        return plans[-1]

    monkeypatch.setattr(pipeline, "plan_lift", counted)
    status, out, _ = run(capsys, *lift_arguments(scene, *flags))
    assert status == 0 and len(plans) == 1
    assert ("\n".join(plans[0].lines()) in out) is ("--explain" in flags)


def test_short_plan_counts_the_views_that_a_stride_leaves_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = write_scene(tmp_path, 4)
    command = ["lift", *files, "-o", tmp_path / "lift.safetensors", "--set", "view_stride=2"]
    assert "; 2 of 3 views" in run(capsys, *command)[1]


def test_bar_of_one_step_leaves_no_line_to_print_over(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with reply.progress_bars() as progress:
        progress("compile", 0, 1, "steps")
        assert "compile:   0%" in capsys.readouterr().err
        progress("compile", 1, 1, "steps")
        assert capsys.readouterr().err.endswith("\r")  # an empty line, before anything else is said
        progress("geometry", 0, 2, "views")
        progress("geometry", 2, 2, "views")
    assert capsys.readouterr().err.endswith("\n")


def test_command_shows_that_it_saves(
    scene: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert "save:   0%" in run(capsys, *lift_arguments(scene, "--json"))[2]
