"""What jobs promise: crashes are told, and the jobs of a stopped or dead server go on."""

from __future__ import annotations

import errno
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.errors import Misconfigured
from service.jobs import process
from service.jobs.supervisor import Supervisor
from service.store.assets import CheckedUpload
from service.store.files import DataDirectory
from service.store.jobs import MAX_ATTEMPTS
from service.store.store import Store
from service.wire import AssetKind, JobState

from .conftest import Uploaded
from .following import ended
from .tiny_scene import TinyScene


@pytest.fixture
def store(tmp_path: Path) -> Any:
    opened = Store.open(tmp_path / "data")
    yield opened
    opened.close()


def submit(store: Store) -> str:
    """A job over assets whose content nobody looks at."""
    ids = []
    for kind in AssetKind:
        with store.files.draft(".bin") as draft:
            draft.write_bytes(kind.encode())
            digest = kind.encode().hex().ljust(64, "0")
            ids.append(store.assets.add(CheckedUpload(draft, kind, digest, ".bin", {}, []))[0].id)
    return store.jobs.submit(ids[0], ids[1], ids[2:], {})


def test_child_that_dies_without_a_word_fails_its_job(
    client: TestClient, uploaded: Uploaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[int] = []
    begin = process.JobProcess.__init__

    def killed(self: process.JobProcess, order: dict[str, Any], scratch: Path) -> None:
        begin(self, order, scratch)
        started.append(self.pid)
        os.kill(self.pid, signal.SIGKILL)

    monkeypatch.setattr(process.JobProcess, "__init__", killed)
    job = ended(client, client.post("/lift", json=uploaded.order()).headers["location"])
    assert job["state"] == "failed" and job["problem"]["type"] == "/problems/crashed"
    assert "signal 9" in job["problem"]["detail"]
    assert len(started) == 1


def upload(client: TestClient, scene: TinyScene) -> Uploaded:
    contents = {"splats": scene.splats, "cameras": scene.cameras, "features": scene.features}
    return Uploaded(*(client.put(f"/assets/{kind}", content=body).json()["id"] for kind, body in contents.items()))


def test_job_interrupted_by_a_stop_goes_on_where_the_data_directory_is_next(
    start: Callable[..., Any], scene: TinyScene, tmp_path: Path
) -> None:
    with start() as client:
        uploaded = upload(client, scene)
        location = client.post("/lift", json=uploaded.order()).headers["location"]
        while client.get(location).json()["state"] == "queued":
            time.sleep(0.01)
    (tmp_path / "data").rename(tmp_path / "moved")
    with start("moved") as client:
        job = ended(client, location)
        assert job["state"] == "succeeded" and job["attempt"] in (1, 2)
        assert client.get("/query", params={"text": "apple"}).status_code == 200
        assert client.get("/query/mask", params={"text": "apple", "view": "left"}).status_code == 200


def test_query_worker_that_died_is_replaced(client: TestClient, lift: dict[str, Any]) -> None:
    assert isinstance(client.app, FastAPI)
    worker = client.app.state.parts.queries
    assert client.get("/query", params={"text": "apple", "lift": lift["id"]}).status_code == 200
    worker._process.kill()
    assert client.get("/query", params={"text": "book", "lift": lift["id"]}).status_code == 200


def test_job_that_gets_no_room_fails_instead_of_running_for_ever(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: DataDirectory) -> Any:
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(DataDirectory, "scratch", full)
    job = submit(store)
    supervisor = Supervisor(store, threads=1)
    supervisor.start()
    deadline = time.monotonic() + 20
    while store.jobs.get(job).state is not JobState.FAILED:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    supervisor.stop()


def test_job_of_a_dead_server_is_queued_again_then_failed(store: Store) -> None:
    job = submit(store)
    for attempt in range(1, MAX_ATTEMPTS + 1):
        claimed = store.jobs.claim()
        assert claimed is not None and (claimed.id, claimed.attempt) == (job, attempt)
        store.jobs.requeue_orphans()
    found = store.jobs.get(job)
    assert found.state is JobState.FAILED and found.problem is not None and "3 attempts" in found.problem["got"]
    assert store.jobs.claim() is None


def test_orderly_stops_do_not_use_up_attempts(store: Store) -> None:
    job = submit(store)
    for _ in range(2 * MAX_ATTEMPTS):
        claimed = store.jobs.claim()
        assert claimed is not None
        store.jobs.release(job, claimed.attempt)
    store.jobs.requeue_orphans()
    assert store.jobs.get(job).state is JobState.QUEUED


def test_word_of_a_stale_attempt_is_dropped(store: Store) -> None:
    job = submit(store)
    assert store.jobs.claim() is not None
    store.jobs.requeue_orphans()
    assert store.jobs.claim() is not None
    store.jobs.fail(job, 1, {"kind": "crashed"})
    store.jobs.advance(job, 1, {"stage": "old"})
    found = store.jobs.get(job)
    assert (found.state, found.attempt, found.progress) == (JobState.RUNNING, 2, None)


def test_jobs_are_claimed_in_order(store: Store) -> None:
    jobs = [submit(store) for _ in range(3)]
    claimed = [store.jobs.claim() for _ in jobs]
    assert [job.id for job in claimed if job is not None] == jobs
    assert [job.id for job in store.jobs.all()] == jobs[::-1]


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
    job = submit(store)
    (tmp_path / "tmp" / "left-over").write_bytes(b"half a file")
    store.close()
    store = Store.open(tmp_path)
    assert store.jobs.get(job).state is JobState.QUEUED and len(store.assets.all()) == 3
    assert list((tmp_path / "tmp").iterdir()) == []
    store.close()
