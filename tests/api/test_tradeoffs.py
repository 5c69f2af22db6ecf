"""Trade-offs over HTTP: ordered as jobs, looked at, deleted; and one that is real."""

from __future__ import annotations

import io
import json
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.jobs import child, comparing
from service.models import JobKind, JobState
from service.store.jobs import fingerprint
from service.store.owners import SERVICE, stored_bytes
from service.store.schema import MIGRATIONS
from service.store.store import Store
from tests.crash.conftest import until
from tests.crash.service_process import processes_of

from .conftest import Uploaded, parts_of
from .following import ended
from .test_jobs import Quick, quick
from .test_problems import assert_problem

__all__ = ["quick"]  # a fixture

BEFORE_KINDS = 4  # the schema of the release before there were kinds of jobs


def compare(client: TestClient, body: dict[str, Any], **more: Any) -> Any:
    return client.post("/tradeoff", json=body | more, headers={"Idempotency-Key": "one"})


def test_tradeoff_is_a_job_as_a_lift_is(quick: Quick) -> None:
    with quick("answer") as (client, body):
        first, again = (compare(client, body, budget_s=60) for _ in range(2))
        assert (first.status_code, again.status_code) == (202, 200)
        assert first.json()["id"] == again.json()["id"]
        assert (first.json()["kind"], first.json()["parameters"]) == ("tradeoff", {"budget_s": 60})
        assert assert_problem(compare(client, body, budget_s=61))["type"] == "/problems/key-reused"
        lift = client.post("/lift", json=body, headers={"Idempotency-Key": "one"})
        assert assert_problem(lift)["type"] == "/problems/key-reused"
        job = ended(client, first.headers["location"])
        assert (job["state"], job["problem"]) == ("succeeded", None)
        assert set(job["links"]) == {"self", "events", "tradeoff", "chart"}
        lifted = client.post("/lift", json=body).json()
        assert lifted["kind"] == "lift" and lifted["parameters"] == {}
        assert {found["kind"] for found in client.get("/jobs").json()["jobs"]} == {"lift", "tradeoff"}


def test_what_was_found_is_looked_at_in_three_ways_and_is_no_lift(quick: Quick, store: Store) -> None:
    with quick("answer") as (client, body):
        links = ended(client, compare(client, body, budget_s=60).headers["location"])["links"]
        found = client.get(links["tradeoff"])
        assert found.status_code == 200 and found.json()["budget_s"] == 60
        assert [found.json()[name] for name in ("splats", "cameras", "features")] == [*body.values()]
        assert found.json()["labels"] is None
        for link in found.json()["links"].values():
            assert client.get(link).status_code == 200, link
        chart = client.get(links["chart"])
        assert (chart.content, chart.headers["content-type"]) == (b"a chart", "image/png")
        tag = {"If-None-Match": chart.headers["etag"]}
        assert client.get(links["chart"], headers=tag).status_code == 304
        assert client.get(found.json()["links"]["table"]).text == "a table"
        job = found.json()["id"]
        assert client.get("/lifts").json() == {"lifts": []}
        lift = ended(client, client.post("/lift", json=body).headers["location"])["id"]
        for path in (f"/lifts/{job}", f"/lifts/{job}/features", f"/tradeoffs/{lift}", f"/tradeoffs/{lift}/chart"):
            assert assert_problem(client.get(path))["type"] == "/problems/not-found"
        with store.database.read() as connection:
            stored = stored_bytes(connection, SERVICE)
        assert client.delete(f"/jobs/{job}", params={"with_tradeoff": True}).status_code == 204
        with store.database.read() as connection:
            assert 0 < stored - stored_bytes(connection, SERVICE) < 1000


def test_tradeoff_goes_with_its_job_when_that_is_said(quick: Quick) -> None:
    with quick("answer") as (client, body):
        links = ended(client, compare(client, body, budget_s=60).headers["location"])["links"]
        for params in ({}, {"with_lift": True}):
            reply = client.delete(links["self"], params=params)
            assert assert_problem(reply)["status"] == 409 and "with_tradeoff=true" in reply.json()["hint"]
        assert client.get(links["chart"]).status_code == 200
        assert client.delete(links["self"], params={"with_tradeoff": True}).status_code == 204
        for link in links.values():
            assert assert_problem(client.get(link))["status"] == 404
        assert client.delete(f"/assets/{body['splats']}").status_code == 204


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"budget_s": 9}, "budget_s"),
        ({"budget_s": 86_401}, "budget_s"),
        ({"budget_s": 3601}, "at most 3600 s"),
        ({"budget_s": "long"}, "budget_s"),
        ({"settings": {"speed": "fast"}}, "the same in all runs"),
        ({"settings": {"stride": 0}}, "stride"),
        ({"settings": {"colour": 1}}, "colour"),
        ({"features": []}, "features"),
        ({"labels": "x"}, "labels"),
    ],
)
def test_bad_order_is_a_problem_that_names_what_is_wrong(quick: Quick, wrong: dict[str, Any], told: str) -> None:
    with quick("answer") as (client, body):
        problem = assert_problem(client.post("/tradeoff", json=body | wrong))
        assert problem["status"] == 422 and told in problem["detail"]
        assert client.get("/jobs").json() == {"jobs": []}


def test_numbers_that_json_does_not_have_are_refused(quick: Quick) -> None:
    with quick("answer") as (client, body):
        for budget in ("NaN", "Infinity", "1e999"):
            content = json.dumps(body | {"budget_s": 0}).replace('"budget_s": 0', f'"budget_s": {budget}')
            headers = {"Content-Type": "application/json"}
            assert assert_problem(client.post("/tradeoff", content=content, headers=headers))["status"] == 422


def test_asset_of_another_kind_is_not_found(quick: Quick) -> None:
    with quick("answer") as (client, body):
        for wrong in ({"splats": body["cameras"]}, {"cameras": body["splats"]}, {"features": [body["splats"]]}):
            assert assert_problem(compare(client, body | wrong))["status"] == 404


def test_room_for_the_exact_features_is_asked_for_beforehand(
    client: TestClient, uploaded: Uploaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage, floor = shutil.disk_usage("/"), parts_of(client).store.files.floor_bytes
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=floor + 60 * 9 * 2 - 1))
    reply = client.post("/tradeoff", json=uploaded.order() | {"budget_s": 10})
    assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/no-space", 507)


def test_real_tradeoff_of_a_tiny_scene(client: TestClient, uploaded: Uploaded) -> None:
    body = uploaded.order(certificate_rays=0, preset="tikhonov") | {"budget_s": 10}
    job = ended(client, client.post("/tradeoff", json=body).headers["location"])
    assert job["state"] == "succeeded", job
    assert job["progress"]["stage"] == "tradeoff" and job["progress"]["done"] == job["progress"]["total"]
    found = client.get(job["links"]["tradeoff"]).json()
    assert found["runs"][0]["name"] == "exact" and found["runs"][0]["cosine"] == pytest.approx(1.0)
    assert found["choice"]["name"] in {run["name"] for run in found["runs"]}
    assert found["views"]["held_out"] == 1 and found["views"]["lifted"] in (1, 2)
    assert all(run["settings"]["certificate_rays"] == 0 for run in found["runs"])
    assert found["runs"][0]["settings"]["preset"] == "tikhonov"  # where the dial starts
    data = str(parts_of(client).store.files.root)
    assert data not in json.dumps(found)  # no path of this machine
    assert client.get(job["links"]["chart"]).content.startswith(b"\x89PNG")
    assert not found["choice"]["recommended"]  # by the one view that is held out
    assert "Nothing can be recommended" in client.get(found["links"]["table"]).text
    assert client.delete(job["links"]["self"], params={"with_tradeoff": True}).status_code == 204


def test_canceled_tradeoff_leaves_no_process_of_its_runs(client: TestClient, uploaded: Uploaded) -> None:
    body = uploaded.order(certificate_rays=0) | {"budget_s": 600}
    job = client.post("/tradeoff", json=body).json()["id"]
    until(lambda: len(processes_of(job)) == 2)  # the job's process, and a run's
    client.post(f"/jobs/{job}/cancel")
    assert ended(client, f"/jobs/{job}")["state"] == "canceled"
    assert processes_of(job) == []
    assert client.delete(f"/jobs/{job}").status_code == 204


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
    fault = child.run(order, child.Reporter(io.BytesIO()))["fault"]
    assert fault["kind"] == "invalid-cameras" and str(tmp_path) not in json.dumps(fault)
    assert "sha256:x" in fault["argument"]


def test_directory_of_the_release_before_keeps_its_jobs_lifts_and_keys(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    old = sqlite3.connect(tmp_path / "data" / "service.sqlite")
    old.executescript("".join(MIGRATIONS[:BEFORE_KINDS]) + f"PRAGMA user_version = {BEFORE_KINDS};")
    for asset in ("splats", "cameras", "features"):
        old.execute("INSERT INTO assets VALUES (?, ?, 1, 'blobs/x', '{}', '[]')", (asset[0], asset))
        old.execute("INSERT INTO asset_owners VALUES (?, '', 0)", (asset[0],))
    body = {"splats": "s", "cameras": "c", "features": ["f"], "settings": {}}
    for job, state in (("a", "succeeded"), ("b", "queued")):
        old.execute(
            "INSERT INTO jobs (id, state, splats, cameras, settings, created, idempotency_key, fingerprint)"
            " VALUES (?, ?, 's', 'c', '{}', 0, ?, ?)",
            (job, state, job, fingerprint(body)),
        )
        old.execute("INSERT INTO job_features VALUES (?, 0, 'f')", (job,))
    old.execute("INSERT INTO lifts VALUES ('a', 7, 'x', 'lifts/a.safetensors', 1, 1, '{}', 0)")
    old.commit()
    old.close()
    store = Store.open(tmp_path / "data")
    assert {job.id: job.state for job in store.jobs.all(SERVICE)} == {
        "a": JobState.SUCCEEDED,
        "b": JobState.QUEUED,
    }
    assert {job.kind for job in store.jobs.all(SERVICE)} == {JobKind.LIFT}
    assert store.lifts.get(SERVICE, "a").bytes == 7
    claimed = store.jobs.claim()
    assert claimed is not None and (claimed.id, claimed.kind, claimed.parameters) == ("b", JobKind.LIFT, {})
    store.close()
