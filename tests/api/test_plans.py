"""What a job says before and while it works: its plan, and every stage that takes time."""

from __future__ import annotations

import io
import json
import tempfile
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from liftcore.errors import Unavailable
from liftcore.io.scene_files import open_files
from liftcore.lifting import plan as plan_of
from liftcore.planning.plan import Plan
from liftcore.settings import LiftSettings
from service.jobs import child
from service.jobs.child import Reporter
from service.jobs.lifting import plan_document
from tests.crash.conftest import until

from .test_jobs import Quick, events, quick
from .tiny_scene import SPLATS_A_CLUSTER, TinyScene

__all__ = ["quick"]  # a fixture


@pytest.fixture
def plan(scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Plan:
    """Of the tiny scene, on a machine whose disk is too small for its region weights."""
    files = [tmp_path / name for name in ("splats.ply", "cameras.json", "features.safetensors")]
    for file, content in zip(files, (scene.splats, scene.cameras, scene.features), strict=True):
        file.write_bytes(content)
    monkeypatch.setattr("liftcore.planning.plan.MEMORY_LIMIT", 0)
    monkeypatch.setattr("liftcore.planning.plan.lack_of_disk", lambda size: "0.0 GiB of disk")
    return plan_of(*open_files(files[0], files[1], files[2:], LiftSettings.of()), LiftSettings.of(device="cpu"))


def test_plan_is_there_while_the_job_runs_and_after_it_has_ended(quick: Quick) -> None:
    with quick("hang") as (client, body):
        job = client.post("/lift", json=body).headers["location"]
        until(lambda: client.get(job).json()["plan"])
        found = client.get(job).json()
        assert found["state"] == "running" and found["plan"]["summary"] == ["a long time"]
        client.post(f"{job}/cancel")
        story = events(client.get(f"{job}/events").text)
        assert [data for _, name, data in story if name == "plan"] == [found["plan"]]
        assert client.get(job).json()["state"] == "canceled" and client.get(job).json()["plan"] == found["plan"]


def test_plan_of_a_job_is_that_of_its_lifts_certificate(client: TestClient, lift: dict[str, Any]) -> None:
    plan = client.get(lift["links"]["job"]).json()["plan"]
    first, *_ = plan.pop("summary")
    assert first.startswith(f"{3 * SPLATS_A_CLUSTER} splats (3dgs), ") and first.endswith("3 of 3 views")
    assert isinstance(plan.pop("warnings"), list)  # what there is to say is of the machine
    assert plan == lift["certificate"]["plan"]


def test_job_tells_of_every_stage_and_its_plan_comes_before_the_walk(
    client: TestClient, lift: dict[str, Any]
) -> None:
    story = events(client.get(f"{lift['links']['job']}/events").text)
    lines = [(number, data["line"]) for number, name, data in story if name == "log"]
    _, *stages = (line for _, line in lines)
    assert stages == ["read", "digest", "compile", "plan", "geometry: 3 views", "solve", "certify", "save"]
    (planned_at,) = (number for number, name, _ in story if name == "plan")
    at = {line: number for number, line in lines}
    assert at["plan"] < planned_at < at["geometry: 3 views"]
    progress = client.get(lift["links"]["job"]).json()["progress"]
    assert progress == {"stage": "save", "done": 1, "total": 1, "unit": "steps", "eta_s": 0.0}


def test_trade_off_has_no_plan_of_its_own(quick: Quick) -> None:
    with quick("hang") as (client, body):
        reply = client.post("/tradeoff", json=body | {"budget_s": 10})
        assert reply.json()["plan"] is None


def test_warnings_of_the_machine_reach_the_client_without_its_paths(plan: Plan) -> None:
    (told,) = plan.warnings
    assert tempfile.gettempdir() in told
    document = plan_document(plan, {tempfile.gettempdir(): "the server's temporary folder"})
    (warning,) = document["warnings"]
    assert "go to files in the server's temporary folder, and there is 0.0 GiB of disk" in warning
    assert document["weights_in_files_bytes"] > 0 and json.loads(json.dumps(document)) == document


def test_child_names_no_folder_of_the_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(order: dict[str, Any], report: Reporter) -> dict[str, Any]:
        raise Unavailable("features", expected=f"disk in {tempfile.gettempdir()}", got="none")

    monkeypatch.setattr("service.jobs.lifting.lift_as_ordered", full)
    fault = child.run({"kind": "lift", "names": {}}, Reporter(io.BytesIO()))["fault"]
    assert fault["expected"] == "disk in the server's temporary folder"
