"""What a job's process is told and tells: a device that is not there, a full disk, and no path of the server."""

from __future__ import annotations

import errno
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from liftcore.device import choose_device
from liftcore.errors import Unavailable
from liftcore.io.scene_files import open_files
from liftcore.lifting import plan as plan_of
from liftcore.progress import Progress
from liftcore.settings import LiftSettings
from service.child import fault_of
from service.jobs import child, comparing, device
from service.jobs.child import Reporter
from service.jobs.device import Devices
from service.jobs.lifting import plan_document

from .conftest import Uploaded
from .test_problems import assert_problem
from .tiny_scene import TinyScene

LACK = Unavailable("device", expected="a card", got="none", hint="take device=cpu")


def test_card_that_is_missing_refuses_the_order_at_once(
    client: TestClient, uploaded: Uploaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "ask", lambda asked: {"event": "fault", "fault": fault_of(LACK)})
    jobs = len(client.get("/jobs").json()["jobs"])
    problem = assert_problem(client.post("/lift", json=uploaded.order(device="cuda")))
    assert (problem["status"], problem["type"]) == (422, "/problems/unavailable")
    assert (problem["argument"], problem["hint"]) == ("device", LACK.hint)
    unknown = assert_problem(client.post("/lift", json=uploaded.order(device="gpu")))
    assert unknown["type"] == "/problems/invalid-settings"
    assert len(client.get("/jobs").json()["jobs"]) == jobs


def test_device_is_looked_for_once_and_what_cannot_be_found_out_is_let_through(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks: list[str] = []
    found = Devices()
    for told, refused in ((None, False), ({"event": "fault", "fault": fault_of(LACK)}, True)):
        monkeypatch.setattr(device, "ask", lambda asked, told=told: looks.append(asked) or told)
        for _ in range(2):
            if refused:
                with pytest.raises(Unavailable):
                    found.require("cuda")
            else:
                found.require("cuda")
    found.require("auto")
    found.require("cpu")
    assert looks == ["cuda"] * 3  # a look without an answer is taken again


def test_process_that_looks_says_what_a_lift_would_say() -> None:
    try:
        choose_device("cuda")
    except Unavailable as error:
        with pytest.raises(Unavailable) as caught:
            Devices().require("cuda")
        assert str(caught.value) == str(error)
    else:
        Devices().require("cuda")


def test_look_that_fails_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    Devices().require("cuda")


def told(job: dict[str, Any]) -> dict[str, Any]:
    return child.run({"kind": "lift", "names": {}} | job, Reporter(io.BytesIO()))["fault"]


def test_fault_of_a_job_names_what_is_missing_and_no_folder_of_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    error: Exception = LACK

    def lift(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
        raise error

    monkeypatch.setattr("service.jobs.lifting.lift_as_ordered", lift)
    assert told({}) == fault_of(LACK)
    error = OSError(errno.ENOSPC, "No space left on device")
    assert told({})["kind"] == "no-space" and "delete" in told({})["hint"]
    error = Unavailable("features", expected=f"disk in {tempfile.gettempdir()}", got="none")
    assert told({})["expected"] == "disk in the server's temporary folder"


def test_what_a_comparison_refuses_is_the_users_problem_and_names_no_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparing, "warm_up_lift", lambda *lift: None)
    paths = {kind: str(tmp_path / kind) for kind in ("splats", "cameras", "features")}
    Path(paths["cameras"]).write_bytes(b"of no format")
    order = {
        "kind": "tradeoff", "kernel": "3dgs", "threads": 1, "settings": {}, "parameters": {"budget_s": 10},
        "splats": paths["splats"], "cameras": paths["cameras"], "features": [paths["features"]], "labels": {},
        "names": {path: f"{kind} sha256:x" for kind, path in paths.items()},
    }  # fmt: skip
    fault = told(order)
    assert fault["kind"] == "invalid-cameras" and str(tmp_path) not in json.dumps(fault)
    assert "sha256:x" in fault["argument"]


def test_warnings_of_the_machine_reach_the_client_without_its_paths(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [tmp_path / name for name in ("splats.ply", "cameras.json", "features.safetensors")]
    for file, content in zip(files, (scene.splats, scene.cameras, scene.features), strict=True):
        file.write_bytes(content)
    monkeypatch.setattr("liftcore.planning.plan.MEMORY_LIMIT", 0)
    monkeypatch.setattr("liftcore.planning.plan.lack_of_disk", lambda size: "0.0 GiB of disk")
    settings = LiftSettings.of(device="cpu")
    plan = plan_of(*open_files(files[0], files[1], files[2:], settings), settings)
    assert tempfile.gettempdir() in plan.warnings[0]
    document = plan_document(plan, {tempfile.gettempdir(): "the server's temporary folder"})
    (warning,) = document["warnings"]
    assert "go to files in the server's temporary folder, and there is 0.0 GiB of disk" in warning
    assert document["weights_in_files_bytes"] > 0 and json.loads(json.dumps(document)) == document
