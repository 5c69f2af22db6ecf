"""What is kept and told of jobs: the newest first, of each no more than the latest, and how long it will take."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.jobs import supervisor as pace
from service.store.jobs import LINE_CHARACTERS, LOG_LINES, EventKind, log_line, note
from service.store.owners import SERVICE
from service.store.store import Store
from tests.crash.conftest import order

from .conftest import Uploaded
from .guarded import finish

TIMES = (20.0, 10.0, 30.0)
NEWEST_FIRST = (2, 0, 1)


def test_lists_begin_with_the_newest(store: Store) -> None:
    jobs = [store.jobs.submit(SERVICE, order(store))[0] for _ in TIMES]
    for job in jobs:
        finish(store, job.encode())
    assets = [asset.id for asset in store.assets.all(SERVICE)]
    with store.database.write() as connection:
        for created, job, asset in zip(TIMES, jobs, assets, strict=True):
            connection.execute("UPDATE jobs SET created = ? WHERE id = ?", (created, job))
            connection.execute("UPDATE lifts SET created = ? WHERE id = ?", (created, job))
            connection.execute("UPDATE asset_owners SET created = ? WHERE asset = ?", (created, asset))
    assert [job.id for job in store.jobs.all(SERVICE)] == [jobs[place] for place in NEWEST_FIRST]
    assert [lift.id for lift in store.lifts.all(SERVICE)] == [jobs[place] for place in NEWEST_FIRST]
    assert [asset.id for asset in store.assets.all(SERVICE)] == [assets[place] for place in NEWEST_FIRST]


def test_list_tells_of_a_lift_what_it_tells_of_it_alone(
    client: TestClient, lift: dict[str, Any], uploaded: Uploaded
) -> None:
    (found,) = [entry for entry in client.get("/lifts").json()["lifts"] if entry["id"] == lift["id"]]
    assert found == lift
    assert (found["splats"], found["cameras"], found["features"]) == (
        uploaded.splats, uploaded.cameras, [uploaded.features]
    )  # fmt: skip


def test_job_keeps_its_states_the_last_of_its_log_and_its_latest_progress(store: Store) -> None:
    job, _ = store.jobs.submit(SERVICE, order(store))
    with store.database.write() as connection:
        for number in range(LOG_LINES + 5):
            note(connection, job, EventKind.LOG, log_line(f"{number:03} {'x' * LINE_CHARACTERS}"))
            note(connection, job, EventKind.PROGRESS, {"done": number})
    events = store.jobs.events(SERVICE, job, 0)
    assert [event.data["state"] for event in events if event.kind is EventKind.STATE] == ["queued"]
    lines = [event.data["line"] for event in events if event.kind is EventKind.LOG]
    assert [int(line[:3]) for line in lines] == list(range(5, LOG_LINES + 5))
    assert {len(line) for line in lines} == {LINE_CHARACTERS}
    assert [event.data for event in events if event.kind is EventKind.PROGRESS] == [{"done": LOG_LINES + 4}]
    numbers = [event.number for event in events]
    assert numbers == sorted(set(numbers)) and store.jobs.events(SERVICE, job, numbers[-2]) == events[-1:]


def test_what_a_stage_will_still_take_follows_from_its_own_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(pace, "time", SimpleNamespace(monotonic=lambda: now))
    stages = pace.StagePace()

    def left(stage: str, done: int) -> float | None:
        return stages.progress({"stage": stage, "done": done, "total": 10, "unit": "views"})["eta_s"]

    assert left("walk", 4) is None  # what an earlier attempt has done says nothing of the pace
    now += 10
    assert left("walk", 4) is None
    assert left("walk", 6) == 20
    assert left("solve", 0) is None
    now += 3
    assert left("solve", 3) == 7
    assert left("solve", 10) == 0
