"""Garbage is what nothing reaches, and nothing else."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import pytest

from service.models import JobKind
from service.store.collect import Collector, collect
from service.store.owners import SERVICE, Owner
from service.store.store import Store

from .conftest import Supervising, ended, often, order, until

HOUR = 3600.0


def old(path: Path) -> Path:
    """The path, made older than any grace."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.is_dir():
        path.write_bytes(b"left behind")
    os.utime(path, (1.0, 1.0))
    return path


def files(store: Store) -> set[str]:
    found = (path for room in ("blobs", "lifts", "work", "tmp") for path in (store.files.root / room).rglob("*"))
    return {str(path.relative_to(store.files.root)) for path in found if path.is_file()}


def test_what_a_crash_left_goes_and_what_is_needed_stays(store: Store, supervising: Supervising) -> None:
    done, queued = (store.jobs.submit(SERVICE, order(store))[0] for _ in range(2))
    store.jobs.cancel(SERVICE, queued)
    with supervising("answer"):
        ended(store, done)
    waiting = store.jobs.submit(SERVICE, order(store))[0]
    needed = files(store) | {f"work/{waiting}/000000.safetensors"}
    old(store.files.work(waiting) / "000000.safetensors")
    os.utime(store.files.work(waiting), (1.0, 1.0))
    left = [
        old(store.files.blob("ab" * 32, ".ply")),  # published, and the server died before its row
        old(store.files.lift("0" * 32)),
        old(store.files.root / "tmp" / "draft.splats"),
    ]
    for job in (done, queued, "1" * 32):  # ended, canceled, deleted
        old(store.files.work(job) / "000000.safetensors")
        left.append(old(store.files.work(job)))
    assert set(collect(store, time.time() - HOUR)) == set(left)
    assert files(store) == needed
    assert (
        store.assets.get(SERVICE, store.jobs.get(SERVICE, done).splats).path.exists()
        and store.files.lift(done).exists()
    )


def test_nothing_young_and_nothing_in_use_goes(store: Store) -> None:
    store.files.blob("cd" * 32, ".ply").parent.mkdir()
    store.files.blob("cd" * 32, ".ply").write_bytes(b"of this minute")
    with store.files.draft(".splats") as draft, store.files.scratch() as scratch:
        part = draft.with_name(f".{draft.name}.1234.part")  # as a writer keeps it beside its draft
        kept = [old(draft), old(part), old(scratch), store.files.blob("cd" * 32, ".ply")]
        assert collect(store, time.time() - HOUR) == []
        assert all(path.exists() for path in kept)
    assert not draft.exists() and not part.exists() and not scratch.exists()


def make_ended(store: Store, ages: dict[str, float], owner: Owner = SERVICE) -> dict[str, str]:
    """Jobs that were canceled so many seconds ago, by name."""
    jobs = {name: store.jobs.submit(owner, order(store, owner))[0] for name in ages}
    with store.database.write() as connection:
        for name, job in jobs.items():
            ended = time.time() - ages[name]
            connection.execute("UPDATE jobs SET state = 'canceled', ended = ? WHERE id = ?", (ended, job))
    return jobs


@pytest.mark.parametrize(
    ("kept", "left"),
    [
        ({}, {"old", "older", "oldest", "another's"}),
        ({"keep_jobs_seconds": 2.5 * HOUR}, {"old", "another's"}),
        ({"keep_jobs": 2}, {"old", "older", "another's"}),
        ({"keep_jobs_seconds": 3.5 * HOUR, "keep_jobs": 1}, {"old", "another's"}),
        ({"keep_jobs": 0}, set()),
    ],
)
def test_ended_jobs_beyond_the_bound_are_forgotten_and_results_never(
    kept: dict[str, float], left: set[str], store: Store, supervising: Supervising
) -> None:
    lifted = store.jobs.submit(SERVICE, order(store))[0]
    compared = store.jobs.submit(SERVICE, replace(order(store), kind=JobKind.TRADEOFF))[0]
    with supervising("answer"):
        assert {ended(store, job).state for job in (lifted, compared)} == {"succeeded"}
    with store.database.write() as connection:
        connection.execute("UPDATE jobs SET ended = 1, created = 1")
    jobs = make_ended(store, {"old": HOUR, "older": 3 * HOUR, "oldest": 4 * HOUR})
    jobs |= make_ended(store, {"another's": 2 * HOUR}, Owner("a", sees_all=False))
    waiting = store.jobs.submit(SERVICE, order(store))[0]
    with store.database.write() as connection:
        connection.execute("UPDATE jobs SET created = 1 WHERE id = ?", (waiting,))
    collector = Collector(store, often(**kept))
    collector.start()
    wanted = {lifted, compared, waiting} | {jobs[name] for name in left}
    until(lambda: {job.id for job in store.jobs.all(SERVICE)} == wanted)
    collector.stop()
    assert {job.id for job in store.jobs.all(SERVICE)} == wanted
    assert store.lifts.get(SERVICE, lifted).path.exists() and store.tradeoffs.get(SERVICE, compared).chart
    with store.database.read() as connection:
        events = {row["job"] for row in connection.execute("SELECT DISTINCT job FROM job_events")}
    assert events == wanted


def test_very_many_jobs_are_forgotten_a_few_at_a_time(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.store.jobs.FORGOTTEN_AT_ONCE", 2)
    make_ended(store, {str(number): float(number) for number in range(5)})
    assert store.jobs.forget_ended(0.0, 1) == 4
    assert len(store.jobs.all(SERVICE)) == 1
