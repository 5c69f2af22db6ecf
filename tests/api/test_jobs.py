"""What jobs promise over HTTP: keys, cancel, events, limits; and that they outlive their server."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.app import create_app
from service.errors import Misconfigured
from service.jobs.process import JobLimits
from service.jobs.supervisor import Supervisor
from service.models import JobState
from service.queries.client import QueryClient, QueryLimits
from service.settings import ServiceSettings
from service.store.assets import ALL
from service.store.owners import SERVICE
from service.store.schema import MIGRATIONS
from service.store.store import Store
from tests.crash.conftest import order, stand_in, until

from .conftest import ADDRESS
from .following import ended
from .test_problems import assert_problem
from .tiny_scene import TinyScene

Quick = Callable[..., AbstractContextManager[tuple[TestClient, dict[str, Any]]]]


@pytest.fixture
def quick(store: Store) -> Quick:
    """The application with stand-ins for lifts, and the body of an order that it takes."""

    @contextmanager
    def serve(behaviour: str, **settings: Any) -> Iterator[tuple[TestClient, dict[str, Any]]]:
        chosen = ServiceSettings.model_validate({"data": store.files.root, **settings})
        worker = QueryClient(QueryLimits(waiting=1, seconds=1, scenes=1, cache_bytes=0, encoder="lvis"))
        supervisor = Supervisor(store, JobLimits(), command=stand_in(behaviour))
        known = order(store)
        body = {"splats": known.splats, "cameras": known.cameras, "features": list(known.features)}
        app = create_app(chosen, store, supervisor, worker)
        with TestClient(app, ADDRESS, raise_server_exceptions=False) as client:
            yield client, body

    return serve


def application(client: TestClient) -> FastAPI:
    """The application behind a client."""
    assert isinstance(client.app, FastAPI)
    return client.app


def events(text: str) -> list[tuple[int, str, dict[str, Any]]]:
    """The events of a stream: id, name, data."""
    found = []
    for block in text.strip().split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.split("\n") if not line.startswith(":"))
        if fields:
            found.append((int(fields["id"]), fields["event"], json.loads(fields["data"])))
    return found


def test_same_key_and_order_are_the_same_job(quick: Quick) -> None:
    with quick("answer") as (client, body):
        first = client.post("/lift", json=body, headers={"Idempotency-Key": "one"})
        again = client.post("/lift", json=body, headers={"Idempotency-Key": "one"})
        assert (first.status_code, again.status_code) == (202, 200)
        assert first.json()["id"] == again.json()["id"] and first.headers["location"] == again.headers["location"]
        ended(client, first.headers["location"])
        late = client.post("/lift", json=body, headers={"Idempotency-Key": "one"})
        assert late.status_code == 200 and late.json()["state"] == "succeeded"
        assert len(client.get("/jobs").json()["jobs"]) == 1
        other = client.post("/lift", json=body, headers={"Idempotency-Key": "two"})
        assert other.status_code == 202 and other.json()["id"] != first.json()["id"]


def test_same_key_with_another_order_is_refused(quick: Quick) -> None:
    with quick("answer") as (client, body):
        client.post("/lift", json=body, headers={"Idempotency-Key": "one"})
        changed = body | {"settings": {"preset": "row-sum"}}
        reply = client.post("/lift", json=changed, headers={"Idempotency-Key": "one"})
        assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/key-reused", 422)
        for key in ("", "x" * 256):
            reply = client.post("/lift", json=body, headers={"Idempotency-Key": key})
            assert assert_problem(reply)["status"] == 422


def test_full_line_is_503_with_retry_after_and_a_known_key_still_finds_its_job(quick: Quick) -> None:
    with quick("hang", max_queued=1) as (client, body):
        location = client.post("/lift", json=body).headers["location"]
        until(lambda: client.get(location).json()["state"] != "queued")
        assert client.post("/lift", json=body, headers={"Idempotency-Key": "k"}).status_code == 202
        reply = client.post("/lift", json=body)
        assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/busy", 503)
        assert int(reply.headers["retry-after"]) > 0
        assert client.post("/lift", json=body, headers={"Idempotency-Key": "k"}).status_code == 200


def test_cancel_over_http(quick: Quick) -> None:
    with quick("hang") as (client, body):
        running = client.post("/lift", json=body).headers["location"]
        until(lambda: client.get(running).json()["state"] == "running")
        waiting = client.post("/lift", json=body).headers["location"]
        assert client.get(waiting).json()["links"]["cancel"] == f"{waiting}/cancel"
        reply = client.post(f"{waiting}/cancel")
        assert (reply.status_code, reply.json()["state"]) == (200, "canceled")
        reply = client.post(f"{running}/cancel")
        assert (reply.status_code, reply.json()["state"]) == (202, "canceling")
        assert ended(client, running)["state"] == "canceled"
        for job in (running, waiting):
            reply = client.post(f"{job}/cancel")
            assert (reply.status_code, reply.json()["state"]) == (200, "canceled")


def test_ended_job_cannot_be_canceled_and_only_an_ended_one_can_be_deleted(quick: Quick, store: Store) -> None:
    with quick("slowly") as (client, body):
        job = client.post("/lift", json=body).headers["location"]
        reply = client.delete(job)
        assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/conflict", 409)
        assert ended(client, job)["state"] == "succeeded"
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
        kept = [event for event in events(client.get(f"{job}/events", headers=third).text) if event[1] != "progress"]
        assert kept == [event for event in story[3:] if event[1] != "progress"]
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


def test_streams_are_bounded(quick: Quick) -> None:
    with quick("answer", max_streams=1) as (client, body):
        job = client.post("/lift", json=body).headers["location"]
        ended(client, job)
        streams = application(client).state.deps.streams
        streams._open["another"] = 1  # as if another client followed
        reply = client.get(f"{job}/events")
        assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/busy", 503)
        del streams._open["another"]
        assert client.get(f"{job}/events").status_code == 200 and streams.open == 0


def test_no_work_is_taken_below_the_disk_floor_and_the_service_lives(
    quick: Quick, scene: TinyScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage("/")
    with quick("answer", disk_floor_bytes=1000) as (client, body):
        application(client).state.deps.store.files._floor = 1000
        monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=999))
        for reply in (
            client.put("/assets/splats", content=scene.splats),
            client.post("/lift", json=body),
        ):
            assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/no-space", 507)
        assert client.get("/jobs").json() == {"jobs": []} and len(client.get("/assets").json()["assets"]) == 3
        monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
        assert ended(client, client.post("/lift", json=body).headers["location"])["state"] == "succeeded"


def test_query_worker_that_died_is_replaced(client: TestClient, lift: dict[str, Any]) -> None:
    assert isinstance(client.app, FastAPI)
    worker = client.app.state.deps.queries
    assert client.get("/query", params={"text": "apple", "lift": lift["id"]}).status_code == 200
    worker._process.kill()
    assert client.get("/query", params={"text": "book", "lift": lift["id"]}).status_code == 200


def test_one_server_a_data_directory(store: Store) -> None:
    with pytest.raises(Misconfigured, match="no other server"):
        Store.open(store.files.root)


def test_database_of_a_later_release_is_refused(tmp_path: Path) -> None:
    store = Store.open(tmp_path)
    with store.database.read() as connection:
        connection.execute("PRAGMA user_version = 99")
    store.close()
    with pytest.raises(Misconfigured, match="99"):
        Store.open(tmp_path)


def test_store_remembers_after_reopening(tmp_path: Path) -> None:
    store = Store.open(tmp_path)
    job = store.jobs.submit(SERVICE, order(store))[0]
    (tmp_path / "tmp" / "left-over").write_bytes(b"half a file")
    store.close()
    store = Store.open(tmp_path)
    assert store.jobs.get(SERVICE, job).state is JobState.QUEUED and len(store.assets.all(SERVICE)) == 3
    assert list((tmp_path / "tmp").iterdir()) == []
    store.close()


def test_database_of_the_first_schema_is_taken_over(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    old = sqlite3.connect(tmp_path / "data" / "service.sqlite")
    old.executescript(f"BEGIN; {MIGRATIONS[0]} PRAGMA user_version = 1; COMMIT;")
    old.executemany(
        "INSERT INTO assets VALUES (?, ?, 1, 'blobs/x', '{}', '[]', 0)",
        [("s", "splats"), ("c", "cameras"), ("f", "features"), ("t", "table")],
    )
    for asset, counts in (("c", {"views": 2, "names": ["w", "v"]}), ("t", {"words": ["apple"], "channels": 1})):
        old.execute("UPDATE assets SET counts = ? WHERE id = ?", (json.dumps(counts), asset))
    old.execute("INSERT INTO lifts VALUES ('c', 1, 'd', 'lifts/c', 1, 1, ?, 0)", (json.dumps({"views": ["v"]}),))
    problem = json.dumps({"kind": "crashed", "argument": "job", "expected": "a", "got": "b", "hint": ""})
    for job, state, told in (("a", "running", None), ("b", "queued", None), ("c", "failed", problem)):
        old.execute(
            "INSERT INTO jobs (id, state, attempt, splats, cameras, settings, problem, created)"
            " VALUES (?, ?, 1, 's', 'c', '{}', ?, 0)",
            (job, state, told),
        )
        old.execute("INSERT INTO job_features VALUES (?, 0, 'f')", (job,))
    old.commit()
    old.close()
    store = Store.open(tmp_path / "data")
    assert store.jobs.get(SERVICE, "a").features == ("f",) and store.jobs.get(SERVICE, "a").plan is None
    assert store.assets.get(SERVICE, "c").counts == {"views": 2}
    assert store.assets.get(SERVICE, "c", most=ALL).counts == {"views": 2, "names": ["w", "v"]}
    assert store.assets.get(SERVICE, "t", most=ALL).counts == {"channels": 1, "words": ["apple"]}
    assert store.assets.names(SERVICE, "c", 1, 9) == ["v"]
    assert store.lifts.lifted(SERVICE, "c", ["w", "v"]) == {"v"}
    assert store.lifts.get(SERVICE, "c").metadata == {"views": ["v"]}
    store.jobs.release_all("the server died")
    assert [store.jobs.get(SERVICE, job).state for job in "abc"] == [
        JobState.QUEUED,
        JobState.QUEUED,
        JobState.FAILED,
    ]
    (last,) = store.jobs.events(SERVICE, "c", 0)
    assert last.data == {"state": "failed", "attempt": 1, "problem": json.loads(problem)}
    with store.database.read() as connection:
        assert connection.execute("PRAGMA user_version").fetchone()[0] == len(MIGRATIONS)
    store.close()
    Store.open(tmp_path / "data").close()  # and once is enough


def test_migration_that_breaks_off_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "service.store.database.MIGRATIONS", (*MIGRATIONS, "CREATE TABLE x (a);\nCREATE TABLE x (a);")
    )
    with pytest.raises(Misconfigured, match="already exists"):
        Store.open(tmp_path / "data")
    monkeypatch.undo()
    left = sqlite3.connect(tmp_path / "data" / "service.sqlite")
    assert left.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
    left.close()
    Store.open(tmp_path / "data").close()
