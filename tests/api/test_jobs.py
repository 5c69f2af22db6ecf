"""Jobs and lifts over HTTP: their documents, and keys, cancel, events and limits of jobs."""

from __future__ import annotations

import errno
import io
import json
import shutil
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from fastapi.testclient import TestClient

from liftcore import WorldFrame, load_lift
from liftcore.errors import Unavailable
from liftcore.lifting.files import open_files
from liftcore.lifting.pipeline import plan as plan_of
from liftcore.query.scene import Scene
from liftcore.runtime.device import choose_device
from liftcore.runtime.progress import Progress
from liftcore.values.settings import LiftSettings
from service import job_child as child
from service import supervisor as pace
from service.child import fault_of
from service.job_child import Reporter
from service.models import AssetKind
from service.routes.jobs import shape
from service.store.jobs import LINE_CHARACTERS, LOG_LINES, EventKind, log_line, note
from service.store.owners import SERVICE
from service.store.store import Store
from service.tasks import plan_document
from tests.crash.conftest import asset_of, order, until
from tests.crash.server import standing_in
from tests.server import wait_for_end
from tests.tiny_scene import CHANNELS, SPLATS_A_CLUSTER, VIEWS, TinyScene, cameras_document

from .conftest import LIFT_REQUEST, SceneAssets, parts_of, put
from .guarded import finish
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


def test_same_key_is_the_same_job_or_refused_with_another_order(quick: Quick) -> None:
    with quick("answer") as (client, body):
        first = client.post("/lift", json=body, headers={"Idempotency-Key": "one"})
        second = client.post("/lift", json=body, headers={"Idempotency-Key": "one"})
        assert (first.status_code, second.status_code) == (202, 200)
        assert first.json()["id"] == second.json()["id"] and first.headers["location"] == second.headers["location"]
        wait_for_end(client, first.headers["location"])
        late = client.post("/lift", json=body, headers={"Idempotency-Key": "one"})
        assert late.status_code == 200 and late.json()["state"] == "succeeded"
        assert len(client.get("/jobs").json()["jobs"]) == 1
        other = client.post("/lift", json=body, headers={"Idempotency-Key": "two"})
        assert other.status_code == 202 and other.json()["id"] != first.json()["id"]
        other_body = body | {"settings": {"preset": "row-sum"}}
        reply = client.post("/lift", json=other_body, headers={"Idempotency-Key": "one"})
        assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/key-reused", 422)
        for key in ("", "x" * 256):
            reply = client.post("/lift", json=body, headers={"Idempotency-Key": key})
            assert assert_problem(reply)["status"] == 422


def test_lifts_are_ordered_by_json_and_times_are_in_seconds_and_iso(quick: Quick) -> None:
    with quick("answer") as (client, body):
        first = client.post("/lift", json=body, headers={"Idempotency-Key": "one"})
        second = client.post("/lifts", json=body, headers={"Idempotency-Key": "one"})
        other = client.post("/lifts", content=json.dumps(body), headers={"Content-Type": "Application/json"})
        assert [reply.status_code for reply in (first, second, other)] == [202, 200, 202]
        assert first.json()["id"] == second.json()["id"] != other.json()["id"]
        assert other.headers["location"] == f"/jobs/{other.json()['id']}"
        assert client.post("/lifts?sha256=" + "0" * 64, json=body).status_code == 422  # of files
        job = wait_for_end(client, other.headers["location"])
        for name in ("created", "started", "ended"):
            assert datetime.fromisoformat(job[f"{name}_at"]).timestamp() == pytest.approx(job[name], abs=1e-5)
        queued = client.post("/lift", json=body).json()
        assert queued["ended"] is None and queued["ended_at"] is None


def test_full_line_is_503_with_retry_after_and_a_known_key_still_finds_its_job(quick: Quick) -> None:
    with quick("hang", max_queued=1) as (client, body):
        location = client.post("/lift", json=body).headers["location"]
        until(lambda: client.get(location).json()["state"] != "queued")
        assert client.post("/lift", json=body, headers={"Idempotency-Key": "k"}).status_code == 202
        counts = client.get("/metrics").text
        for line in ("queue_length 1.0", "running_lifts 1.0", 'jobs{state="queued"} 1.0'):
            assert f"splatlift_{line}" in counts
        reply = client.post("/lift", json=body)
        assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/busy", 503)
        assert int(reply.headers["retry-after"]) > 0
        assert client.post("/lift", json=body, headers={"Idempotency-Key": "k"}).status_code == 200


def test_canceled_job_keeps_its_plan(quick: Quick) -> None:
    with quick("hang") as (client, body):
        running = client.post("/lift", json=body).headers["location"]
        until(lambda: client.get(running).json()["plan"])
        record = client.get(running).json()
        assert record["state"] == "running" and record["plan"]["summary"] == ["a long time"]
        waiting = client.post("/lift", json=body).headers["location"]
        assert client.get(waiting).json()["links"]["cancel"] == f"{waiting}/cancel"
        reply = client.post(f"{waiting}/cancel")
        assert (reply.status_code, reply.json()["state"]) == (200, "canceled")
        reply = client.post(f"{running}/cancel")
        assert (reply.status_code, reply.json()["state"]) == (202, "canceling")
        assert wait_for_end(client, running)["state"] == "canceled"
        for job in (running, waiting):
            reply = client.post(f"{job}/cancel")
            assert (reply.status_code, reply.json()["state"]) == (200, "canceled")
        problem_fields = [data for _, name, data in events(client.get(f"{running}/events").text) if name == "plan"]
        assert problem_fields == [record["plan"]] == [client.get(running).json()["plan"]]


def test_ended_job_cannot_be_canceled_and_only_an_ended_one_can_be_deleted(quick: Quick, store: Store) -> None:
    with quick("slowly") as (client, body):
        job = client.post("/lift", json=body).headers["location"]
        reply = client.delete(job)
        assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/conflict", 409)
        assert wait_for_end(client, job)["state"] == "succeeded"
        assert assert_problem(client.post(f"{job}/cancel"))["status"] == 409
        reply = client.delete(job)  # a retried DELETE must not cost a lift that nobody gave up
        assert reply.status_code == 409 and "with_lift" in reply.json()["hint"]
        lift = store.files.lift(job.rpartition("/")[2])
        assert lift.exists() and client.get(job.replace("jobs", "lifts")).status_code == 200
        assert client.delete(job, params={"with_lift": True}).status_code == 204
        assert not lift.exists() and client.get(job.replace("jobs", "lifts")).status_code == 404
        for reply in (client.get(job), client.delete(job), client.get(f"{job}/events"), client.post(f"{job}/cancel")):
            assert assert_problem(reply)["status"] == 404
        assert client.delete(f"/assets/{body['splats']}").status_code == 204  # nothing needs it any more


def test_events_tell_the_whole_story_and_go_on_after_the_last_one_seen(quick: Quick) -> None:
    with quick("slowly") as (client, body):
        job = client.post("/lift", json=body).headers["location"]
        reply = client.get(f"{job}/events")  # returns when the stream ends
        assert reply.headers["content-type"].startswith("text/event-stream")
        story = events(reply.text)
        assert [data["state"] for _, name, data in story if name == "state"] == ["queued", "running", "succeeded"]
        assert {name for _, name, _ in story} == {"state", "plan", "progress", "log"}
        numbers = [number for number, _, _ in story]
        assert numbers == sorted(set(numbers))
        third = {"Last-Event-ID": str(numbers[2])}
        recent = [
            event for event in events(client.get(f"{job}/events", headers=third).text) if event[1] != "progress"
        ]
        assert recent == [event for event in story[3:] if event[1] != "progress"]
        assert client.get(f"{job}/events", headers={"Last-Event-ID": str(numbers[-1])}).status_code == 204
        for nonsense in ("x", "-1", "9" * 30):
            reply = client.get(f"{job}/events", headers={"Last-Event-ID": nonsense})
            assert assert_problem(reply)["status"] == 422


def test_failed_job_tells_its_problem_in_its_events(quick: Quick) -> None:
    with quick("die") as (client, body):
        job = client.post("/lift", json=body).headers["location"]
        *_, (_, name, last) = events(client.get(f"{job}/events").text)
        assert (name, last["state"], last["attempt"]) == ("state", "failed", 3)
        assert last["problem"] == client.get(job).json()["problem"]
        assert last["problem"]["type"] == "/problems/crashed"


def test_no_work_is_taken_below_the_disk_floor_and_the_service_lives(
    quick: Quick, scene: TinyScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage("/")
    with quick("answer", disk_floor_bytes=1000) as (client, body):
        parts_of(client).store.files._floor = 1000
        monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=999))
        for reply in (
            client.put("/assets/splats", content=scene.splats),
            client.post("/lift", json=body),
        ):
            assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/no-space", 507)
        assert client.get("/jobs").json()["jobs"] == [] and len(client.get("/assets").json()["assets"]) == 3
        monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
        assert wait_for_end(client, client.post("/lift", json=body).headers["location"])["state"] == "succeeded"


def test_job_and_lift_keep_what_the_plan_warned_of(client: TestClient, scene_assets: SceneAssets) -> None:
    away = cameras_document()
    for frame in away["frames"]:  # they look the other way
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1.0, 1, -1, 1])).tolist()
    cameras = put(client, AssetKind.CAMERAS, json.dumps(away).encode())
    order = replace(scene_assets, cameras=cameras).order(preset="row-sum")
    job = wait_for_end(client, client.post("/lift", json=order).headers["location"])
    assert job["state"] == "succeeded", job
    data = [line for line in job["plan"]["warnings"] if "no camera can see" in line]
    assert data and set(data) <= set(client.get(job["links"]["lift"]).json()["diagnostics"]["warnings"])
    assert client.delete(f"{job['links']['self']}?with_lift=true").status_code == 204


def test_job_tells_of_every_stage_and_its_plan_comes_with_the_first_views(
    client: TestClient, lift: dict[str, Any]
) -> None:
    story = events(client.get(f"{lift['links']['job']}/events").text)
    lines = [(number, data["line"]) for number, name, data in story if name == "log"]
    _, *stages = (line for _, line in lines)
    assert stages == ["read", "digest", "compile", "plan", "geometry: 3 views", "solve", "certify", "save"]
    (planned_at,) = (number for number, name, _ in story if name == "plan")
    at = {line: number for number, line in lines}
    assert at["plan"] < at["geometry: 3 views"] < planned_at < at["solve"]
    job = client.get(lift["links"]["job"]).json()
    assert job in client.get("/jobs").json()["jobs"]
    first, *_ = job["plan"].pop("summary")
    assert first.startswith(f"{3 * SPLATS_A_CLUSTER} splats (3dgs), ") and first.endswith("3 of 3 views")
    assert isinstance(job["plan"].pop("warnings"), list)  # what there is to say is of the machine
    assert job["plan"] == lift["diagnostics"]["plan"]
    assert (job["state"], job["attempt"], job["problem"]) == ("succeeded", 1, None)
    assert job["settings"]["preset"] == "row-sum" and job["settings"]["power"] == 1
    assert job["created"] <= job["started"] <= job["ended"]
    assert job["request_id"] == LIFT_REQUEST
    assert LIFT_REQUEST in client.get(job["links"]["events"]).text
    assert job["progress"] == {
        "stage": "save", "completed": 1, "done": 1, "total": 1, "unit": "steps", "eta_s": 0.0,
    }  # fmt: skip


def test_progress_stored_by_its_old_name_is_answered_by_both(store: Store) -> None:
    job, _ = store.jobs.submit(SERVICE, order(store))
    progress = {"stage": "solve", "done": 2, "total": 3, "unit": "slices", "eta_s": None}
    with store.database.write() as connection:
        connection.execute("UPDATE jobs SET progress = ? WHERE id = ?", (json.dumps(progress), job))
    shaped = shape(store.jobs.get(SERVICE, job)).model_dump(mode="json")
    assert shaped["progress"] == progress | {"completed": 2}


def test_lists_begin_with_the_newest(store: Store) -> None:
    jobs = [store.jobs.submit(SERVICE, order(store))[0] for _ in range(3)]
    for job in jobs:
        finish(store, job.encode())
    assets = [asset.id for asset in store.assets.all(SERVICE)]
    with store.database.write() as connection:
        for created, job, asset in zip((20.0, 10.0, 30.0), jobs, assets, strict=True):
            connection.execute("UPDATE jobs SET created = ? WHERE id = ?", (created, job))
            connection.execute("UPDATE lifts SET created = ? WHERE id = ?", (created, job))
            connection.execute("UPDATE asset_owners SET created = ? WHERE asset = ?", (created, asset))
    for table, ids in ((store.jobs, jobs), (store.lifts, jobs), (store.assets, assets)):
        assert [record.id for record in table.all(SERVICE)] == [ids[2], ids[0], ids[1]]


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


COUNT = 3 * SPLATS_A_CLUSTER


def test_assets_say_what_is_in_them_and_their_names_alone(client: TestClient, scene_assets: SceneAssets) -> None:
    table = {asset["id"]: asset["counts"] for asset in client.get("/assets").json()["assets"]}
    splats, cameras, features = (
        client.get(f"/assets/{asset}").json()["counts"]
        for asset in (scene_assets.splats, scene_assets.cameras, scene_assets.features)
    )
    assert (splats["splats"], splats["kernel"]) == (COUNT, "3dgs")
    assert (cameras["views"], features["channels"], features["text_space"]) == (len(VIEWS), CHANNELS, "tiny")
    for asset, counts in ((scene_assets.cameras, cameras), (scene_assets.features, features)):
        assert "middle" in counts.pop("names") and table[asset] == counts  # lists leave out the names


def test_lift_tells_how_far_to_trust_it(client: TestClient, lift: dict[str, Any], scene_assets: SceneAssets) -> None:
    assert (lift["count"], lift["channels"], lift["text_space"]) == (COUNT, CHANNELS, "tiny")
    assert sorted(lift["views"]) == sorted(VIEWS) and lift["diagnostics"] and lift["timings"]
    assert lift["certificate"] == lift["diagnostics"]  # by its old name, until version 1 ends
    assert lift["settings"]["certificate_rays"] == lift["settings"]["diagnostic_rays"]
    assert (lift["splats"], lift["cameras"], lift["features"]) == (
        scene_assets.splats, scene_assets.cameras, [scene_assets.features]
    )  # fmt: skip
    now = client.get(f"/lifts/{lift['id']}").json()
    assert now in client.get("/lifts").json()["lifts"]
    assert now == lift | {"photos": now["photos"]}  # another test may have given it photos


def test_lift_and_its_files_are_found_where_they_were_downloaded(
    client: TestClient, data: Path, lift: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = client.get(lift["links"]["features"])
    assert len(full.content) == lift["bytes"] and full.headers["etag"] == f'"{lift["sha256"]}"'
    files = [f"/assets/{asset}/content" for asset in (lift["splats"], lift["cameras"], *lift["features"])]
    for reply in (full, *map(client.get, files)):
        name = reply.headers["content-disposition"].partition('filename="')[2].rstrip('"')
        (tmp_path / name).write_bytes(reply.content)
    [file] = tmp_path.glob("lift-*.safetensors")
    assert str(data).encode() not in file.read_bytes()  # paths of the server are nobody's business
    monkeypatch.chdir(tmp_path)
    scene = Scene(file)
    assert scene.splats.count == COUNT and {camera.name for camera in scene.cameras.values()} == set(VIEWS)
    assert set(scene.packs.views) == set(VIEWS)


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
