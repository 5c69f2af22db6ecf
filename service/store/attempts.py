"""Attempts at jobs: who may write what, and when an attempt no longer counts.

An attempt is a claim with a number. Every note of it names its number, and changes nothing once the job has moved on:
an attempt that was given up, however alive its process still is, can end nothing and publish nothing.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Mapping
from typing import Any

from liftcore.errors import SplatliftError
from service.child import fault_of
from service.errors import Crashed
from service.models import JobState
from service.store.database import Database
from service.store.jobs import EventKind, JobRecord, log_line, move, note, record, told

MAX_ATTEMPTS = 3  # that give no answer, and that the job itself is to blame for

# An attempt may act while this holds; ids and numbers are bound by name.
OWNS = "id = :job AND attempt = :attempt AND state IN ('running', 'canceling')"


class AttemptStore:
    """What the supervisor notes. It serves all owners alike."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def claim(self) -> JobRecord | None:
        """Take the oldest queued job and make it running, as a new attempt."""
        with self._database.write() as connection:
            row = connection.execute(
                "UPDATE jobs SET state = 'running', attempt = attempt + 1, started = ?, progress = NULL"
                " WHERE id = (SELECT id FROM jobs WHERE state = 'queued' ORDER BY created, id LIMIT 1)"
                " RETURNING *",
                (time.time(),),
            ).fetchone()
            if row is None:
                return None
            told(connection, row)
            return record(connection, row)

    def state(self, job: str) -> JobState | None:
        """Where a job is; None when there is none."""
        with self._database.read() as connection:
            row = connection.execute("SELECT state FROM jobs WHERE id = ?", (job,)).fetchone()
        return None if row is None else JobState(row["state"])

    def advance(self, job: str, attempt: int, progress: Mapping[str, Any]) -> None:
        """Note how far an attempt is."""
        self._note_latest(job, attempt, EventKind.PROGRESS, progress)

    def plan(self, job: str, attempt: int, plan: Mapping[str, Any]) -> None:
        """Note what an attempt is about to do. It stays with the job until the next attempt has planned."""
        self._note_latest(job, attempt, EventKind.PLAN, plan)

    def _note_latest(self, job: str, attempt: int, kind: EventKind, data: Mapping[str, Any]) -> None:
        """Keep what there is one of: in the job's column of that name, and as an event."""
        with self._database.write() as connection:
            changed = connection.execute(
                f"UPDATE jobs SET {kind} = :data WHERE {OWNS}",
                {"data": json.dumps(data), "job": job, "attempt": attempt},
            )
            if changed.rowcount == 1:
                note(connection, job, kind, data)

    def log(self, job: str, attempt: int, text: str) -> None:
        """Add a line to the job's log."""
        with self._database.write() as connection:
            if _owned(connection, job, attempt) is not None:
                note(connection, job, EventKind.LOG, log_line(text))

    def fail(self, job: str, attempt: int, error: Mapping[str, str]) -> None:
        """End an attempt, and its job, with a problem; a job that was to be canceled is canceled."""
        with self._database.write() as connection:
            row = _owned(connection, job, attempt)
            if row is not None and row["state"] == JobState.CANCELING:
                move(connection, row, JobState.CANCELED)
            elif row is not None:
                move(connection, row, JobState.FAILED, error)

    def lose(self, job: str, attempt: int, why: str, error: Mapping[str, str] | None = None) -> None:
        """End an attempt that gave no answer: the job goes back in line, or fails after its last attempt.

        Args:
            job: its id.
            attempt: its number.
            why: for the job's log.
            error: what the job fails with in the end, instead of having crashed.
        """
        with self._database.write() as connection:
            row = _owned(connection, job, attempt)
            if row is None:
                return
            note(connection, job, EventKind.LOG, log_line(f"attempt {attempt} is lost: {why}"))
            if row["state"] == JobState.RUNNING and attempt - row["released"] >= MAX_ATTEMPTS:
                move(connection, row, JobState.FAILED, error or fault_of(_gave_up(why)))
            else:
                move(connection, row, _without_answer(row))

    def release(self, job: str, attempt: int, why: str) -> None:
        """Put the job of an attempt that the server ended or could not keep up back in line: it counts as none."""
        with self._database.write() as connection:
            row = _owned(connection, job, attempt)
            if row is not None:
                _release(connection, row, why)

    def unfinished(self) -> list[str]:
        """At start-up: the jobs that a dead server left in the middle of an attempt."""
        with self._database.read() as connection:
            rows = connection.execute("SELECT id FROM jobs WHERE state IN ('running', 'canceling')").fetchall()
        return [row["id"] for row in rows]

    def release_all(self, why: str) -> None:
        """At start-up: put all of these back in line. A server's death is no job's fault."""
        with self._database.write() as connection:
            for row in connection.execute("SELECT * FROM jobs WHERE state IN ('running', 'canceling')").fetchall():
                _release(connection, row, why)


def succeed(connection: sqlite3.Connection, job: str, attempt: int) -> bool:
    """Within the transaction that keeps its result: end an attempt well.

    Returns:
        False when it is no longer the job's running one, or is to be canceled; then nothing changes.
    """
    row = _owned(connection, job, attempt)
    if row is None or row["state"] == JobState.CANCELING:
        return False
    move(connection, row, JobState.SUCCEEDED)
    return True


def _owned(connection: sqlite3.Connection, job: str, attempt: int) -> sqlite3.Row | None:
    return connection.execute(f"SELECT * FROM jobs WHERE {OWNS}", {"job": job, "attempt": attempt}).fetchone()


def _without_answer(row: sqlite3.Row) -> JobState:
    return JobState.CANCELED if row["state"] == JobState.CANCELING else JobState.QUEUED


def _release(connection: sqlite3.Connection, row: sqlite3.Row, why: str) -> None:
    note(connection, row["id"], EventKind.LOG, log_line(f"attempt {row['attempt']} does not count: {why}"))
    connection.execute("UPDATE jobs SET released = released + 1 WHERE id = ?", (row["id"],))
    move(connection, row, _without_answer(row))


def _gave_up(why: str) -> SplatliftError:
    return Crashed(
        "job", expected="an answer from the job's process", got=f"none in {MAX_ATTEMPTS} attempts; the last: {why}",
        hint="signal 9 is mostly a lack of memory; the server's log has what the process printed",
    )  # fmt: skip
