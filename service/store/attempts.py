"""Attempts at jobs: who may write what, and when an attempt no longer counts.

An attempt is a claim with a number and a lease. Every note of it names its number, and changes nothing once the job
has moved on: an attempt that was given up, however alive its process still is, can end nothing and publish nothing.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Mapping
from typing import Any

from liftcore.errors import SplatliftError
from service.child import fault_of
from service.errors import Conflict, Crashed
from service.models import ENDED, JobState
from service.store.database import Database
from service.store.events import EventKind, log_line, note
from service.store.jobs import JobRecord, find, record, row_of
from service.store.owners import Owned

MAX_ATTEMPTS = 3

# An attempt may act while this holds; ids and numbers are bound by name.
OWNS = "id = :job AND attempt = :attempt AND state IN ('running', 'canceling')"


class AttemptStore(Owned):
    """What the supervisor notes, and the one thing that a client may ask of it: to cancel."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def claim(self, lease_seconds: float) -> JobRecord | None:
        """Take the oldest queued job and make it running, as a new attempt under a lease."""
        now = time.time()
        with self._database.write() as connection:
            row = connection.execute(
                "UPDATE jobs SET state = 'running', attempt = attempt + 1, started = ?, progress = NULL,"
                " leased_until = ?"
                " WHERE id = (SELECT id FROM jobs WHERE state = 'queued' ORDER BY created, id LIMIT 1)"
                " RETURNING *",
                (now, now + lease_seconds),
            ).fetchone()
            if row is None:
                return None
            told(connection, row)
            return record(connection, row)

    def state(self, job: str) -> JobState | None:
        """Where a job is; None when there is none."""
        with self._database.read() as connection:
            row = find(connection, job, self._owner)
        return None if row is None else JobState(row["state"])

    def renew(self, job: str, attempt: int, lease_seconds: float) -> float | None:
        """Prolong the lease of an attempt; when it ends, None when the attempt no longer owns the job."""
        until = time.time() + lease_seconds
        with self._database.write() as connection:
            changed = connection.execute(
                f"UPDATE jobs SET leased_until = :until WHERE {OWNS}",
                {"until": until, "job": job, "attempt": attempt},
            )
            return until if changed.rowcount == 1 else None

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
            owned = connection.execute(f"SELECT 1 FROM jobs WHERE {OWNS}", {"job": job, "attempt": attempt})
            if owned.fetchone() is not None:
                note(connection, job, EventKind.LOG, log_line(text))

    def fail(self, job: str, attempt: int, error: Mapping[str, str]) -> None:
        """End an attempt, and its job, with a problem; a job that was to be canceled is canceled."""
        with self._database.write() as connection:
            row = _owned(connection, job, attempt)
            if row is not None and row["state"] == JobState.CANCELING:
                _move(connection, row, JobState.CANCELED)
            elif row is not None:
                _move(connection, row, JobState.FAILED, error)

    def lose(self, job: str, attempt: int, why: str) -> None:
        """End an attempt that gave no answer: the job goes back in line, or fails after its last attempt."""
        with self._database.write() as connection:
            row = _owned(connection, job, attempt)
            if row is not None:
                _lose(connection, row, why)

    def release(self, job: str, attempt: int) -> None:
        """Put an attempt that an orderly stop interrupted back in line; it does not count as a failure."""
        with self._database.write() as connection:
            row = _owned(connection, job, attempt)
            if row is not None:
                connection.execute("UPDATE jobs SET released = released + 1 WHERE id = ?", (job,))
                _move(connection, row, _without_answer(row))

    def cancel(self, job: str) -> bool:
        """Ask for the end of a job. One in line is canceled at once; a running one when its processes are gone.

        Returns:
            Whether something changed; a job that is canceled, or is being, may be canceled again.

        Raises:
            NotFound: there is none.
            Conflict: it has succeeded or failed.
        """
        with self._database.write() as connection:
            row = row_of(connection, job, self._owner)
            state = JobState(row["state"])
            if state in (JobState.CANCELING, JobState.CANCELED):
                return False
            if state in ENDED:
                raise Conflict("job", expected="a job that has not ended", got=f"one that has {state}")
            _move(connection, row, JobState.CANCELED if state is JobState.QUEUED else JobState.CANCELING)
            return True

    def unfinished(self) -> list[str]:
        """At start-up: the jobs that a dead server left in the middle of an attempt."""
        with self._database.read() as connection:
            rows = connection.execute("SELECT id FROM jobs WHERE state IN ('running', 'canceling')").fetchall()
        return [row["id"] for row in rows]

    def lose_all(self, why: str) -> None:
        """At start-up: all of these attempts are lost."""
        with self._database.write() as connection:
            rows = connection.execute("SELECT * FROM jobs WHERE state IN ('running', 'canceling')").fetchall()
            for row in rows:
                _lose(connection, row, why)


def succeed(connection: sqlite3.Connection, job: str, attempt: int) -> bool:
    """Within the transaction that keeps its result: end an attempt well.

    Returns:
        False when it is no longer the job's running one, or is to be canceled; then nothing changes.
    """
    ended = connection.execute(
        "UPDATE jobs SET state = 'succeeded', ended = ?, leased_until = NULL"
        " WHERE id = ? AND attempt = ? AND state = 'running' RETURNING *",
        (time.time(), job, attempt),
    ).fetchone()
    if ended is not None:
        told(connection, ended)
    return ended is not None


def told(connection: sqlite3.Connection, row: sqlite3.Row) -> None:
    """Note the state of a row that was just changed."""
    problem = None if row["problem"] is None else json.loads(row["problem"])
    data = {"state": row["state"], "attempt": row["attempt"], "problem": problem}
    note(connection, row["id"], EventKind.STATE, data)


def _owned(connection: sqlite3.Connection, job: str, attempt: int) -> sqlite3.Row | None:
    return connection.execute(f"SELECT * FROM jobs WHERE {OWNS}", {"job": job, "attempt": attempt}).fetchone()


def _without_answer(row: sqlite3.Row) -> JobState:
    return JobState.CANCELED if row["state"] == JobState.CANCELING else JobState.QUEUED


def _lose(connection: sqlite3.Connection, row: sqlite3.Row, why: str) -> None:
    note(connection, row["id"], EventKind.LOG, log_line(f"attempt {row['attempt']} is lost: {why}"))
    state = _without_answer(row)
    if state is JobState.QUEUED and row["attempt"] - row["released"] >= MAX_ATTEMPTS:
        _move(connection, row, JobState.FAILED, fault_of(_gave_up(why)))
    else:
        _move(connection, row, state)


def _gave_up(why: str) -> SplatliftError:
    return Crashed(
        "job", expected="an answer from the job's process", got=f"none in {MAX_ATTEMPTS} attempts; the last: {why}",
        hint="signal 9 is mostly a lack of memory; the server's log has what the process printed",
    )  # fmt: skip


def _move(
    connection: sqlite3.Connection, row: sqlite3.Row, state: JobState, problem: Mapping[str, str] | None = None
) -> None:
    changed = connection.execute(
        "UPDATE jobs SET state = :state, problem = :problem, leased_until = NULL,"
        " ended = CASE WHEN :ended THEN :now ELSE NULL END,"
        " progress = CASE WHEN :state = 'queued' THEN NULL ELSE progress END"
        " WHERE id = :job RETURNING *",
        {
            "state": state,
            "problem": None if problem is None else json.dumps(problem),
            "ended": state in ENDED,
            "now": time.time(),
            "job": row["id"],
        },
    ).fetchone()
    told(connection, changed)
