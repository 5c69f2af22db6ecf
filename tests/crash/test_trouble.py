"""Trouble of the server ends no job: what cannot be noted now is noted later, and no attempt is blamed for it."""

from __future__ import annotations

import errno
import resource
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from service import supervisor as supervisors
from service.models import JobState
from service.store import database
from service.store.database import DATABASE
from service.store.files import DataDirectory
from service.store.jobs import MAX_ATTEMPTS
from service.store.lifts import FinishedLift
from service.store.owners import SERVICE
from service.store.store import Store

from .conftest import METADATA, Supervising, order, until, wait_until_ended

Fault = Callable[[Store], AbstractContextManager[None]]


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same waits, shorter."""
    monkeypatch.setattr(supervisors, "RETRY_SECONDS", 0.05)
    monkeypatch.setattr(supervisors, "TROUBLED_SECONDS", (0.05, 0.2))
    monkeypatch.setattr(database, "BUSY_SECONDS", 0.2)


@pytest.fixture
def store(impatient: None, tmp_path: Path) -> Iterator[Store]:
    opened_store = Store.open(tmp_path / "data")
    yield opened_store
    opened_store.close()


@contextmanager
def lock_held(store: Store) -> Iterator[None]:
    """Another process holds the database's write lock."""
    other = sqlite3.connect(store.files.root / DATABASE, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    yield
    other.execute("ROLLBACK")
    other.close()


@contextmanager
def read_only(store: Store) -> Iterator[None]:
    """The disk takes nothing, as one that has failed, or is full."""
    with store.database.write() as connection:
        pass
    connection.execute("PRAGMA query_only = ON")
    yield
    connection.execute("PRAGMA query_only = OFF")


@contextmanager
def no_files_left(store: Store) -> Iterator[None]:
    """The process may open no file more."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize("fault", [lock_held, read_only])
def test_trouble_while_a_job_runs_ends_nothing(
    fault: Fault, store: Store, supervising: Supervising, caplog: pytest.LogCaptureFixture
) -> None:
    job = store.jobs.submit(SERVICE, order(store))[0]
    work = store.files.work(job)
    with supervising("obey"):
        until((work / "waiting").exists)
        with fault(store):
            (work / "go on").mkdir()  # it speaks, answers and ends, and nothing of that can be noted
            until(lambda: "cannot be stored yet" in caplog.text and "the end of a job cannot" in caplog.text)
        record = wait_until_ended(store, job)
    assert (record.state, record.attempt) == (JobState.SUCCEEDED, 1)
    assert record.plan == {"summary": ["one splat"], "warnings": [], "splats": 1} and record.progress is not None
    assert store.lifts.get(SERVICE, job).path.stat().st_size == store.lifts.get(SERVICE, job).bytes


def test_running_job_outlives_a_server_without_file_descriptors(store: Store, supervising: Supervising) -> None:
    job = store.jobs.submit(SERVICE, order(store))[0]
    work = store.files.work(job)
    with supervising("obey"):
        until((work / "waiting").exists)
        with no_files_left(store):
            (work / "go on").mkdir()
            until(lambda: not (work / "waiting").exists())  # it has answered
        record = wait_until_ended(store, job)
    assert (record.state, record.attempt - released(store, job)) == (JobState.SUCCEEDED, 1)


def released(store: Store, job: str) -> int:
    with store.database.read() as connection:
        return connection.execute("SELECT released FROM jobs WHERE id = ?", (job,)).fetchone()[0]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EMFILE, errno.EIO])
def test_attempt_that_the_server_cannot_begin_is_none(
    code: int, store: Store, supervising: Supervising, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch, tries = DataDirectory.scratch, iter(range(MAX_ATTEMPTS + 1))

    def troubled(self: DataDirectory) -> Any:
        if next(tries, None) is None:
            return scratch(self)
        raise OSError(code, "trouble")

    monkeypatch.setattr(DataDirectory, "scratch", troubled)
    job = store.jobs.submit(SERVICE, order(store))[0]
    with supervising("answer"):
        record = wait_until_ended(store, job)
    assert (record.state, record.attempt) == (JobState.SUCCEEDED, MAX_ATTEMPTS + 2)


def test_jobs_of_a_dead_server_go_back_in_line_once_that_can_be_noted(store: Store, supervising: Supervising) -> None:
    job = store.jobs.submit(SERVICE, order(store))[0]
    assert store.jobs.claim() is not None
    with lock_held(store), supervising("answer"):
        assert store.jobs.get(SERVICE, job).state is JobState.RUNNING
    with supervising("answer"):
        assert wait_until_ended(store, job).state is JobState.SUCCEEDED


@pytest.mark.parametrize(
    ("behaviour", "state", "attempt"),
    [("lack_room_once", JobState.SUCCEEDED, 2), ("lack_room", JobState.FAILED, MAX_ATTEMPTS)],
)
def test_job_that_finds_the_disk_full_is_tried_again_before_it_fails(
    behaviour: str, state: JobState, attempt: int, store: Store, supervising: Supervising
) -> None:
    job = store.jobs.submit(SERVICE, order(store))[0]
    with supervising(behaviour):
        record = wait_until_ended(store, job)
    assert (record.state, record.attempt) == (state, attempt)
    assert record.problem is None or record.problem["kind"] == "no-space"


def test_lift_that_could_not_be_recorded_is_no_file_and_its_draft_is_kept(store: Store) -> None:
    job = store.jobs.submit(SERVICE, order(store))[0]
    assert store.jobs.claim() is not None
    with store.files.draft(".safetensors") as draft:
        draft.write_bytes(b"made")
        lift = FinishedLift(draft, "0" * 64, 1, 1, METADATA)
        with store.database.write() as connection:
            connection.execute("ALTER TABLE lifts RENAME TO elsewhere")
        with pytest.raises(sqlite3.OperationalError):
            store.lifts.finish(job, 1, lift)
        assert draft.read_bytes() == b"made" and not store.files.lift(job).exists()
        with store.database.write() as connection:
            connection.execute("ALTER TABLE elsewhere RENAME TO lifts")
        assert store.lifts.finish(job, 1, lift)
