"""Jobs and lifts over HTTP: their documents, and keys, cancel, events and limits of jobs."""

from __future__ import annotations

import errno
import io
import json
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from fastapi.testclient import TestClient

from liftcore import WorldFrame, load_lift
from liftcore.errors import Unavailable
from liftcore.lifting.files import open_files
from liftcore.lifting.pipeline import plan as plan_of
from liftcore.runtime.device import choose_device
from liftcore.runtime.progress import Progress
from liftcore.values.settings import LiftSettings
from service import job_child as child
from service import supervisor as pace
from service.child import fault_of
from service.job_child import Reporter
from service.models import AssetKind
from service.store.jobs import LINE_CHARACTERS, LOG_LINES, EventKind, log_line, note
from service.store.owners import SERVICE
from service.store.store import Store
from service.tasks import plan_document
from tests.crash.conftest import asset_of, order
from tests.crash.server import standing_in
from tests.tiny_scene import TinyScene

from .conftest import SceneAssets
from .test_problems import assert_problem

Quick = Callable[..., AbstractContextManager[tuple[TestClient, dict[str, Any]]]]


@pytest.fixture
def quick(store: Store) -> Quick:
    """The application with stand-ins for lifts, and the body of an order that it takes."""
    return partial(standing_in, store)


def events(text: str) -> list[tuple[int, str, dict[str, Any]]]:
    """The events of a stream: id, name, data."""
    records = []
    for block in text.strip().split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.split("\n") if not line.startswith(":"))
        if fields:
            records.append((int(fields["id"]), fields["event"], json.loads(fields["data"])))
    return records


def test_job_keeps_its_states_the_last_of_its_log_and_its_latest_progress(store: Store) -> None:
    job, _ = store.jobs.submit(SERVICE, order(store))
    with store.database.write() as connection:
        for number in range(LOG_LINES + 5):
            note(connection, job, EventKind.LOG, log_line(f"{number:03} {'x' * LINE_CHARACTERS}"))
            note(connection, job, EventKind.PROGRESS, {"completed": number})
    events = store.jobs.events(SERVICE, job, 0)
    assert [event.data["state"] for event in events if event.kind is EventKind.STATE] == ["queued"]
    lines = [event.data["line"] for event in events if event.kind is EventKind.LOG]
    assert [int(line[:3]) for line in lines] == list(range(5, LOG_LINES + 5))
    assert {len(line) for line in lines} == {LINE_CHARACTERS}
    assert [event.data for event in events if event.kind is EventKind.PROGRESS] == [{"completed": LOG_LINES + 4}]
    numbers = [event.number for event in events]
    assert numbers == sorted(set(numbers)) and store.jobs.events(SERVICE, job, numbers[-2]) == events[-1:]


def test_what_a_stage_will_still_take_follows_from_its_own_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(pace, "time", SimpleNamespace(monotonic=lambda: now))
    stages = pace.StagePace()

    def seconds_left(stage: str, completed: int) -> float | None:
        return stages.progress({"stage": stage, "completed": completed, "total": 10, "unit": "views"})["eta_s"]

    assert seconds_left("walk", 4) is None  # what an earlier attempt has done says nothing of the pace
    now += 10
    assert seconds_left("walk", 4) is None
    assert seconds_left("walk", 6) == 20
    assert seconds_left("solve", 0) is None
    now += 3
    assert seconds_left("solve", 3) == 7
    assert seconds_left("solve", 10) == 0


def test_downloaded_lift_has_the_world_that_it_was_given_later(
    client: TestClient, lift: dict[str, Any], tmp_path: Path
) -> None:
    path, at = lift["links"]["features"], f"/lifts/{lift['id']}"
    before = client.get(path)
    client.patch(at, json={"world": {"up": [0, -1, 0], "metres_per_unit": 0.5}})
    try:
        after = client.get(path)
        tag, content = after.headers["etag"], after.content
        (tmp_path / "lift.safetensors").write_bytes(content)
        lift_with_world, bare = load_lift(tmp_path / "lift.safetensors"), tmp_path / "before.safetensors"
        bare.write_bytes(before.content)
        assert lift_with_world.metadata.world == WorldFrame(up=(0, -1, 0), metres_per_unit=0.5)
        assert lift_with_world.metadata == load_lift(bare).with_world(lift_with_world.metadata.world).metadata
        assert torch.equal(lift_with_world.features, load_lift(bare).features)
        assert int(after.headers["content-length"]) == len(content) and tag != before.headers["etag"]
        assert client.get(path, headers={"If-None-Match": tag}).status_code == 304
        header = 8 + int.from_bytes(content[:8], "little")
        for first, last in ((0, 7), (header - 3, header + 3), (header + 9, header + 20), (len(content) - 5, "")):
            part = client.get(path, headers={"Range": f"bytes={first}-{last}", "If-Range": tag})
            end = len(content) if last == "" else int(last) + 1
            assert (part.status_code, part.content) == (206, content[first:end])
            assert part.headers["content-range"] == f"bytes {first}-{end - 1}/{len(content)}"
        assert client.get(path, headers={"Range": f"bytes={len(content)}-"}).status_code == 416
    finally:
        client.patch(at, json={"world": None})
    (tmp_path / "lift.safetensors").write_bytes(client.get(path).content)
    assert load_lift(tmp_path / "lift.safetensors").metadata.world == WorldFrame()


# The process of a job: a device that is not there, a full disk, and no path of the server


def test_card_that_is_missing_refuses_the_order_in_the_words_of_a_lift(
    client: TestClient, scene_assets: SceneAssets
) -> None:
    jobs = len(client.get("/jobs").json()["jobs"])
    unknown = assert_problem(client.post("/lift", json=scene_assets.order(device="gpu")))
    assert unknown["type"] == "/problems/invalid-settings"
    try:
        choose_device("cuda")
    except Unavailable as lack:
        for _ in range(2):
            problem = assert_problem(client.post("/lift", json=scene_assets.order(device="cuda")))
            assert (problem["status"], problem["type"]) == (422, "/problems/unavailable")
            data = [problem[name] for name in ("argument", "expected", "got", "hint")]
            assert data == [lack.argument, lack.expected, lack.got, lack.hint]
    else:
        assert client.post("/lift/plan", json=scene_assets.order(device="cuda")).status_code == 200
    assert len(client.get("/jobs").json()["jobs"]) == jobs


LACK = Unavailable("device", expected="a card", got="none", hint="take device=cpu")
JOB_FOLDER = "/folder/of/a/job"


def fault_from(job: dict[str, Any]) -> dict[str, Any]:
    return child.run({"kind": "lift", "names": {}, "work": JOB_FOLDER} | job, Reporter(io.BytesIO()))["fault"]


def test_fault_of_a_job_names_what_is_missing_and_no_folder_of_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    error: Exception = LACK

    def lift(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
        raise error

    monkeypatch.setattr("service.tasks.lift_as_ordered", lift)
    assert fault_from({}) == fault_of(LACK)
    error = OSError(errno.ENOSPC, "No space left on device")
    assert fault_from({})["kind"] == "no-space" and "delete" in fault_from({})["hint"]
    error = Unavailable("features", expected=f"disk in {tempfile.gettempdir()}", got="none")
    assert fault_from({})["expected"] == "disk in the server's temporary folder"
    error = Unavailable("checkpoint", expected=f"room for blocks in {JOB_FOLDER}", got="none")
    assert fault_from({})["expected"] == "room for blocks in the job's folder"
    error.__cause__ = OSError(errno.ENOSPC, "No space left on device")
    assert fault_from({})["kind"] == "no-space"


def test_what_a_comparison_refuses_is_the_users_problem_and_names_no_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("liftcore.lifting.warm_up.warm_up_lift", lambda *lift: None)
    paths = {kind: str(tmp_path / kind) for kind in ("splats", "cameras", "features")}
    Path(paths["cameras"]).write_bytes(b"of no format")
    order = {
        "kind": "tradeoff", "kernel": "3dgs", "threads": 1, "settings": {}, "parameters": {"budget_s": 10},
        "splats": paths["splats"], "cameras": paths["cameras"], "features": [paths["features"]], "labels": {},
        "names": {path: f"{kind} sha256:x" for kind, path in paths.items()},
    }  # fmt: skip
    fault = fault_from(order)
    assert fault["kind"] == "invalid-cameras" and str(tmp_path) not in json.dumps(fault)
    assert "sha256:x" in fault["argument"]


def test_order_that_the_services_engine_cannot_lift_is_refused_with_what_to_set(store: Store) -> None:
    for settings, change in (
        ({"cg_steps": 2}, "cg_steps=0"),
        ({"aggregation": True, "aggregation_clusters": "hdbscan"}, "aggregation=false"),
    ):
        with standing_in(store, "answer", engine="local") as (client, body):
            reply = client.post("/lift", json=body | {"settings": settings})
            problem = assert_problem(reply)
            assert reply.status_code == 422 and change in problem["detail"]
    with standing_in(store, "answer", engine="local") as (client, body):
        assert client.post("/lift", json=body).status_code == 202  # the default
    with standing_in(store, "answer") as (client, body):
        assert client.post("/lift", json=body | {"settings": {"cg_steps": 2}}).status_code == 202


def test_order_over_grids_is_refused_what_only_masks_give(store: Store) -> None:
    asset_of(store, AssetKind.FEATURES, {"names": ["v"], "channels": 1, "region_maps": 0, "grids": 1})
    graph = {"aggregation": True, "aggregation_clusters": "graph"}
    for engine, settings in (
        ("local", {"aggregation": True}),  # by the default's clusters: of masks, else of features
        *((None, settings) for settings in ({"objects": True}, {"consensus": True}, graph)),
    ):
        with standing_in(store, "answer", engine=engine) as (client, body):
            reply = client.post("/lift", json=body | {"settings": settings})
            assert reply.status_code == 422 and "grids" in assert_problem(reply)["detail"]
            assert client.post("/lift/plan", json=body | {"settings": settings}).status_code == 422
    with standing_in(store, "answer") as (client, body):
        assert client.post("/lift", json=body | {"settings": {"aggregation": True}}).status_code == 202


def test_warnings_of_the_machine_reach_the_client_without_its_paths(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [tmp_path / name for name in ("splats.ply", "cameras.json", "features.safetensors")]
    for file, content in zip(files, (scene.splats, scene.cameras, scene.features), strict=True):
        file.write_bytes(content)
    monkeypatch.setattr("liftcore.lifting.planning.plan.MEMORY_LIMIT", 0)
    monkeypatch.setattr("liftcore.lifting.planning.plan.lack_of_disk", lambda size: "0.0 GiB of disk")
    settings = LiftSettings.of(device="cpu")
    plan = plan_of(*open_files(files[0], files[1], files[2:], settings), settings)
    assert tempfile.gettempdir() in plan.warnings[0]
    document = plan_document(plan, {tempfile.gettempdir(): "the server's temporary folder"})
    (warning,) = document["warnings"]
    assert "go to files in the server's temporary folder, and there is 0.0 GiB of disk" in warning
    assert document["weights_in_files_bytes"] > 0 and json.loads(json.dumps(document)) == document
