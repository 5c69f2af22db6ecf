"""Jobs: acknowledged orders, their states, and their events.

An attempt at a job is a claim with a number. Every note of it names its number, and changes nothing once the job has
moved on: an attempt that was given up, however alive its process still is, can end nothing and publish nothing.
"""

from __future__ import annotations

import hashlib
import json
import secrets
import sqlite3
import sys
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from liftcore.errors import NotFound
from service.child import fault_of
from service.errors import Conflict, KeyReused, ProcessDied, ServiceUnavailable, Unauthorized
from service.models import FINAL_STATES, AssetKind, JobKind, JobState
from service.store.assets import add_owner
from service.store.database import Database, Page, insert, page_of, parsed, record_of
from service.store.files import DataDirectory
from service.store.owners import (
    INVALID_KEYS,
    OWNER_CLAUSE,
    QUEUE_RETRY_SECONDS,
    VISIBLE_JOBS,
    Owner,
    require_quota,
    require_turn,
)

LOG_LINES = 200  # a job; older ones are deleted
LINE_CHARACTERS = 500
FORGOTTEN_AT_ONCE = 500  # jobs a transaction, so that others can write
MAX_ATTEMPTS = 3  # without an answer that count against the job
# Condition under which an attempt may act; ids and numbers are bound by name.
OWNS = "id = :job AND attempt = :attempt AND state IN ('running', 'canceling')"
RESULTS = {JobKind.LIFT: "lifts", JobKind.TRADEOFF: "tradeoffs"}  # tables of results, by kind of job


@dataclass(frozen=True)
class JobOrder:
    """Order of a client."""

    splats: str
    cameras: str
    features: tuple[str, ...]
    settings: dict[str, Any] = field(default_factory=dict)  # complete, with defaults
    key: str | None = None  # Idempotency-Key
    fingerprint: str | None = None  # of the order as it was sent, if it has a key
    request_id: str | None = None  # of the request that brings it
    kind: JobKind = JobKind.LIFT
    parameters: dict[str, Any] = field(default_factory=dict)  # of its kind, beside settings

    def assets(self) -> list[tuple[str, AssetKind]]:
        """Return the ids that it needs, with the kind that each must have."""
        inputs = [(self.splats, AssetKind.SPLATS), (self.cameras, AssetKind.CAMERAS)]
        return [*inputs, *((asset, AssetKind.FEATURES) for asset in self.features), *labels_of(self.parameters)]


@dataclass(frozen=True)
class JobRecord:
    """Record of a job."""

    id: str
    state: JobState
    attempt: int
    splats: str
    cameras: str
    features: tuple[str, ...]
    settings: dict[str, Any]
    progress: dict[str, Any] | None
    problem: dict[str, str] | None
    created: float
    started: float | None
    ended: float | None
    request_id: str | None = None
    kind: JobKind = JobKind.LIFT
    parameters: dict[str, Any] = field(default_factory=dict)
    plan: dict[str, Any] | None = None


class EventKind(StrEnum):
    """Kind of an event."""

    STATE = "state"
    PLAN = "plan"
    PROGRESS = "progress"
    LOG = "log"


@dataclass(frozen=True)
class Event:
    """Event of a job."""

    number: int  # ascending in a job
    kind: EventKind
    data: dict[str, Any]


def labels_of(parameters: Mapping[str, Any]) -> list[tuple[str, AssetKind]]:
    """Return the assets in a job's parameters, with their kinds: the labels of a trade-off, or a lift's words."""
    labels = parameters.get("labels")
    if labels is not None:
        return [(labels[str(kind)], kind) for kind in (AssetKind.MASKS, AssetKind.TABLE)]
    return [(parameters["table"], AssetKind.TABLE)] if "table" in parameters else []


def fingerprint(order: dict[str, Any]) -> str:
    """Return the digest of an order, which identifies a repeated one."""
    return hashlib.sha256(json.dumps(order, sort_keys=True).encode()).hexdigest()


class JobStore:
    """The queue of jobs and their history. Jobs of other owners count as absent; attempts serve all owners alike."""

    def __init__(self, database: Database, files: DataDirectory) -> None:
        self._database = database
        self._files = files
        self._claims: list[str] = []  # owners of claimed jobs, each once, the latest last

    def submit(self, owner: Owner, order: JobOrder, *, max_queued: int = 1_000_000) -> tuple[str, bool]:
        """Queue a job; it is on the disk when this returns.

        Returns:
            The id, and whether the job is new: an order with the key of an earlier one is that one.

        Raises:
            NotFound: an asset was deleted meanwhile, or is not the owner's.
            ServiceUnavailable: there are ``max_queued`` jobs in line.
            KeyLimitReached, OverQuota: the owner has as many in line, or stored, as it may.
            KeyReused: the key came with another order before.
        """
        job = secrets.token_hex(16)
        with self._database.write(is_counted=True) as connection:
            earlier = _of_key(connection, order, owner)
            if earlier is not None:
                return earlier, False
            _require_place(connection, order.kind, max_queued)
            require_turn(connection, order.kind, owner)
            _take_assets(connection, order, owner)
            require_quota(connection, owner, 1)
            row = {
                "id": job,
                "owner": owner.key,
                "kind": order.kind,
                "state": JobState.QUEUED,
                "splats": order.splats,
                "cameras": order.cameras,
                "settings": json.dumps(order.settings),
                "parameters": json.dumps(order.parameters),
                "created": time.time(),
                "idempotency_key": order.key,
                "fingerprint": order.fingerprint,
                "request_id": order.request_id,
            }
            insert(connection, "jobs", row)
            connection.executemany(
                "INSERT INTO job_features (job, place, asset) VALUES (?, ?, ?)",
                [(job, place, asset) for place, asset in enumerate(order.features)],
            )
            connection.executemany(
                "INSERT INTO job_labels (job, asset) VALUES (?, ?)",
                [(job, asset) for asset, _ in labels_of(order.parameters)],
            )
            note(connection, job, EventKind.STATE, {"state": JobState.QUEUED, "attempt": 0, "problem": None})
        return job, True

    def find_repeated(self, owner: Owner, order: JobOrder) -> str | None:
        """Return the job of an earlier order of this owner with this Idempotency-Key; None if there is none.

        Raises:
            KeyReused: the key came with another order before.
        """
        with self._database.read() as connection:
            return _of_key(connection, order, owner)

    def get(self, owner: Owner, job: str) -> JobRecord:
        """Return the job of that id.

        Raises:
            NotFound: there is none.
        """
        with self._database.read() as connection:
            return record(connection, row_of(connection, job, owner))

    def count_by_state(self) -> dict[JobState, int]:
        """Return the number of jobs in each state that has any."""
        with self._database.read() as connection:
            rows = connection.execute("SELECT state, count(*) FROM jobs GROUP BY state").fetchall()
        return {JobState(state): count for state, count in rows}

    def page(self, owner: Owner, limit: int, cursor: str | None = None) -> Page[JobRecord]:
        """Return so many jobs after a cursor, newest first."""
        with self._database.read() as connection:
            select = f"SELECT * FROM jobs WHERE {OWNER_CLAUSE}"
            return page_of(connection, select, owner.terms(), limit, cursor, lambda row: record(connection, row))

    def all(self, owner: Owner) -> list[JobRecord]:
        """Return every job, newest first."""
        return self.page(owner, sys.maxsize - 1).records

    def state(self, owner: Owner, job: str) -> JobState | None:
        """Return the state of a job; None if there is none."""
        with self._database.read() as connection:
            row = find(connection, job, owner)
        return None if row is None else JobState(row["state"])

    def cancel(self, owner: Owner, job: str) -> bool:
        """Cancel a job. A queued one is canceled at once, a running one when its processes have ended.

        Returns:
            True if something changed; a job that is canceled, or canceling, may be canceled again.

        Raises:
            NotFound: there is none.
            Conflict: it has succeeded or failed.
        """
        with self._database.write() as connection:
            row = row_of(connection, job, owner)
            state = JobState(row["state"])
            if state in (JobState.CANCELING, JobState.CANCELED):
                return False
            if state in FINAL_STATES:
                raise Conflict("job", expected="a job that has not ended", got=f"one that has {state}")
            move(connection, row, JobState.CANCELED if state is JobState.QUEUED else JobState.CANCELING)
            return True

    def events(self, owner: Owner, job: str, number: int) -> list[Event]:
        """Return the events of a job after a number, in order.

        Raises:
            NotFound: there is no such job, or the key that follows it is no longer valid.
        """
        with self._database.read() as connection:
            visible = connection.execute(
                f"SELECT 1 FROM jobs WHERE id = :job AND {OWNER_CLAUSE} AND :owner NOT IN ({INVALID_KEYS})",
                owner.terms(job=job, now=time.time()),
            )
            if visible.fetchone() is None:
                raise NotFound("job", expected="the id of a job", got=job)
            rows = connection.execute(
                "SELECT number, kind, data FROM job_events WHERE job = ? AND number > ? ORDER BY number",
                (job, number),
            ).fetchall()
        return [Event(row["number"], EventKind(row["kind"]), json.loads(row["data"])) for row in rows]

    def delete(self, owner: Owner, job: str, *, given_up: Collection[JobKind] = ()) -> None:
        """Delete a job that has ended, with its events and its result.

        Args:
            job: its id.
            given_up: the kinds of jobs whose result may go with them.

        Raises:
            NotFound: there is none.
            Conflict: it has not ended, or it has a result that was not given up.
        """

        def forget(connection: sqlite3.Connection) -> list[Path]:
            row = row_of(connection, job, owner)
            if row["state"] not in FINAL_STATES:
                raise Conflict(
                    "job", expected="a job that has ended", got=f"one that is {row['state']}",
                    hint=f"POST /jobs/{job}/cancel first",
                )  # fmt: skip
            kind = JobKind(row["kind"])
            result = connection.execute(f"DELETE FROM {RESULTS[kind]} WHERE id = ? RETURNING id", (job,)).fetchall()
            if result and kind not in given_up:
                raise Conflict(
                    "job", expected=f"a job without a {kind}", got=f"one whose {kind} would go with it",
                    hint=f"say with_{kind}=true if that is meant",
                )  # fmt: skip
            connection.execute("DELETE FROM jobs WHERE id = ?", (job,))
            return [self._files.lift(job), self._files.lift_changes(job), self._files.work(job)]

        self._database.write_freeing(forget)

    def forget_ended(self, before: float, limit: int) -> int:
        """Delete jobs that have ended without a result, or whose result was deleted; lifts and trade-offs stay.

        Args:
            before: seconds since 1970; those that ended earlier go.
            limit: number of jobs to keep for each owner, the latest.

        Returns:
            The number of removed jobs.
        """
        count = 0
        while True:
            batch: list[str] = []

            def forget(connection: sqlite3.Connection, batch: list[str] = batch) -> list[Path]:
                rows = connection.execute(
                    "DELETE FROM jobs WHERE id IN (SELECT id FROM (SELECT id, coalesce(ended, created) AS since,"
                    " row_number() OVER (PARTITION BY owner ORDER BY coalesce(ended, created) DESC, id) AS place"
                    " FROM jobs WHERE state IN ('succeeded', 'failed', 'canceled')"
                    " AND id NOT IN (SELECT id FROM lifts UNION ALL SELECT id FROM tradeoffs))"
                    " WHERE since < :before OR place > :most LIMIT :at_once) RETURNING id",
                    {"before": before, "most": limit, "at_once": FORGOTTEN_AT_ONCE},
                ).fetchall()
                batch[:] = [row["id"] for row in rows]
                return [self._files.work(job) for job in batch]

            self._database.write_freeing(forget)
            count += len(batch)
            if len(batch) < FORGOTTEN_AT_ONCE:
                return count

    def claim(self) -> JobRecord | None:
        """Claim a queued job: start a new attempt.

        Owners take turns: it is the oldest job of the one that has the fewest running, and of these of the one whose
        last turn is longest ago.
        """
        with self._database.write() as connection:
            stop_waiting(connection)
            owners = connection.execute(
                "SELECT owner, (SELECT count(*) FROM jobs WHERE owner = waiting.owner"
                " AND state IN ('running', 'canceling')) AS running"
                " FROM jobs AS waiting WHERE state = 'queued' GROUP BY owner ORDER BY min(created)"
            ).fetchall()
            if not owners:
                return None
            turns = {owner: turn for turn, owner in enumerate(self._claims)}
            owner = min(owners, key=lambda row: (row["running"], turns.get(row["owner"], -1)))["owner"]
            row = connection.execute(
                "UPDATE jobs SET state = 'running', attempt = attempt + 1, started = ?, progress = NULL WHERE id ="
                " (SELECT id FROM jobs WHERE state = 'queued' AND owner = ? ORDER BY created, id LIMIT 1)"
                " RETURNING *",
                (time.time(), owner),
            ).fetchone()
            record_state(connection, row)
            job = record(connection, row)
        self._claims = [*(other for other in self._claims if other != owner), owner]
        return job

    def advance(self, job: str, attempt: int, progress: Mapping[str, Any]) -> None:
        """Record the progress of an attempt."""
        self._note_latest(job, attempt, EventKind.PROGRESS, progress)

    def plan(self, job: str, attempt: int, plan: Mapping[str, Any]) -> None:
        """Record the plan of an attempt. It stays with the job until the next attempt has planned."""
        self._note_latest(job, attempt, EventKind.PLAN, plan)

    def _note_latest(self, job: str, attempt: int, kind: EventKind, data: Mapping[str, Any]) -> None:
        """Store a single value: in the job's column of that name, and as an event."""
        with self._database.write() as connection:
            update = connection.execute(
                f"UPDATE jobs SET {kind} = :data WHERE {OWNS}",
                {"data": json.dumps(data), "job": job, "attempt": attempt},
            )
            if update.rowcount == 1:
                note(connection, job, kind, data)

    def log(self, job: str, attempt: int, text: str) -> None:
        """Add a line to the job's log."""
        with self._database.write() as connection:
            if _owned_row(connection, job, attempt) is not None:
                note(connection, job, EventKind.LOG, log_line(text))

    def fail(self, job: str, attempt: int, error: Mapping[str, str]) -> None:
        """End an attempt and its job with a problem; a job that is being canceled is canceled."""
        with self._database.write() as connection:
            row = _owned_row(connection, job, attempt)
            if row is not None and row["state"] == JobState.CANCELING:
                move(connection, row, JobState.CANCELED)
            elif row is not None:
                move(connection, row, JobState.FAILED, error)

    def lose(self, job: str, attempt: int, reason: str, error: Mapping[str, str] | None = None) -> None:
        """End an attempt without an answer: the job is requeued, or fails after its last attempt.

        Args:
            job: its id.
            attempt: its number.
            reason: for the job's log.
            error: the job's problem after its last attempt, in place of that of a crash.
        """
        with self._database.write() as connection:
            row = _owned_row(connection, job, attempt)
            if row is None:
                return
            note(connection, job, EventKind.LOG, log_line(f"attempt {attempt} is lost: {reason}"))
            if row["state"] == JobState.RUNNING and attempt - row["released"] >= MAX_ATTEMPTS:
                move(connection, row, JobState.FAILED, error or _gave_up(reason))
            else:
                move(connection, row, _without_answer(row))

    def release(self, job: str, attempt: int, reason: str) -> None:
        """Requeue the job of an attempt that the server ended or failed: it does not count."""
        with self._database.write() as connection:
            row = _owned_row(connection, job, attempt)
            if row is not None:
                _release(connection, row, reason)

    def release_all(self, reason: str) -> None:
        """At start-up: requeue all of these. The end of the server is not the job's fault."""
        with self._database.write() as connection:
            for row in connection.execute("SELECT * FROM jobs WHERE state IN ('running', 'canceling')").fetchall():
                _release(connection, row, reason)


def find(connection: sqlite3.Connection, job: str, owner: Owner) -> sqlite3.Row | None:
    """Return the row of a job that an owner may see."""
    select = f"SELECT * FROM jobs WHERE id = :job AND {VISIBLE_JOBS}"
    return connection.execute(select, owner.terms(job=job)).fetchone()


def row_of(connection: sqlite3.Connection, job: str, owner: Owner) -> sqlite3.Row:
    """Return the job as `find` does; raise NotFound if there is none.

    Raises:
        NotFound: there is no such job, or the owner does not see it.
    """
    row = find(connection, job, owner)
    if row is None:
        raise NotFound("job", expected="the id of a job", got=job)
    return row


def record(connection: sqlite3.Connection, row: sqlite3.Row) -> JobRecord:
    """Return a row of the table as a record."""
    features = connection.execute("SELECT asset FROM job_features WHERE job = ? ORDER BY place", (row["id"],))
    return record_of(
        JobRecord,
        row,
        state=JobState(row["state"]),
        kind=JobKind(row["kind"]),
        features=tuple(feature["asset"] for feature in features),
        **{name: parsed(row[name]) for name in ("settings", "parameters", "progress", "plan", "problem")},
    )


def _of_key(connection: sqlite3.Connection, order: JobOrder, owner: Owner) -> str | None:
    if order.key is None:
        return None
    row = connection.execute(
        "SELECT id, fingerprint FROM jobs WHERE owner = ? AND idempotency_key = ?", (owner.key, order.key)
    ).fetchone()
    if row is not None and row["fingerprint"] != order.fingerprint:
        raise KeyReused(
            "Idempotency-Key", expected="the order that came with this key before", got="another order",
            hint=f"the key belongs to /jobs/{row['id']}; take a new one",
        )  # fmt: skip
    return None if row is None else row["id"]


def _require_place(connection: sqlite3.Connection, kind: JobKind, max_queued: int) -> None:
    queued = connection.execute("SELECT count(*) FROM jobs WHERE state = 'queued'").fetchone()[0]
    if queued >= max_queued:
        raise ServiceUnavailable(
            kind, expected=f"fewer than {max_queued} jobs in line", got=f"{queued}", hint="try again later",
            retry_after=QUEUE_RETRY_SECONDS,
        )  # fmt: skip


def _take_assets(connection: sqlite3.Connection, order: JobOrder, owner: Owner) -> None:
    """Require that the assets are there; an admin becomes an owner of those that its job needs."""
    for asset, kind in order.assets():
        visible = connection.execute(
            "SELECT 1 FROM assets JOIN asset_owners ON asset = id WHERE id = :asset AND kind = :kind"
            f" AND {OWNER_CLAUSE}",
            owner.terms(asset=asset, kind=kind),
        )
        if visible.fetchone() is None:
            raise NotFound(kind, expected=f"the id of an asset of kind {kind}", got=asset)
        add_owner(connection, asset, owner.key)


def note(connection: sqlite3.Connection, job: str, kind: EventKind, data: Mapping[str, Any]) -> None:
    """Add an event within a write transaction. Of plan and progress the latest is kept, of the log the last lines."""
    connection.execute(
        "INSERT INTO job_events (job, number, kind, data, created)"
        " SELECT ?, coalesce(max(number), 0) + 1, ?, ?, ? FROM job_events WHERE job = ?",
        (job, kind, json.dumps(data), time.time(), job),
    )
    limit = {EventKind.PLAN: 1, EventKind.PROGRESS: 1, EventKind.LOG: LOG_LINES}.get(kind)
    if limit is not None:
        connection.execute(
            "DELETE FROM job_events WHERE job = :job AND kind = :kind AND number NOT IN"
            " (SELECT number FROM job_events WHERE job = :job AND kind = :kind ORDER BY number DESC LIMIT :kept)",
            {"job": job, "kind": kind, "kept": limit},
        )


def log_line(text: str) -> dict[str, Any]:
    """Return a line of the log as the data of an event."""
    return {"line": text[:LINE_CHARACTERS], "time": round(time.time(), 3)}


def record_state(connection: sqlite3.Connection, row: sqlite3.Row) -> None:
    """Record the state of a row that was just changed."""
    data = {"state": row["state"], "attempt": row["attempt"], "problem": parsed(row["problem"])}
    note(connection, row["id"], EventKind.STATE, data)


def move(
    connection: sqlite3.Connection, row: sqlite3.Row, state: JobState, problem: Mapping[str, str] | None = None
) -> None:
    """Set a job's state, within a write transaction, and record it."""
    after = connection.execute(
        "UPDATE jobs SET state = :state, problem = :problem,"
        " ended = CASE WHEN :ended THEN :now ELSE NULL END,"
        " progress = CASE WHEN :state = 'queued' THEN NULL ELSE progress END"
        " WHERE id = :job RETURNING *",
        {
            "state": state,
            "problem": None if problem is None else json.dumps(problem),
            "ended": state in FINAL_STATES,
            "now": time.time(),
            "job": row["id"],
        },
    ).fetchone()
    record_state(connection, after)


def succeed(connection: sqlite3.Connection, job: str, attempt: int) -> bool:
    """End an attempt with success, within the transaction that stores its result.

    Returns:
        False when it is no longer the job's running one, or is to be canceled; then nothing changes.
    """
    row = _owned_row(connection, job, attempt)
    if row is None or row["state"] == JobState.CANCELING:
        return False
    move(connection, row, JobState.SUCCEEDED)
    return True


def stop_waiting(connection: sqlite3.Connection) -> None:
    """Cancel the queued jobs of keys that are no longer valid, within a write transaction."""
    now = time.time()
    rows = connection.execute(
        f"SELECT * FROM jobs WHERE state = 'queued' AND owner IN ({INVALID_KEYS})", {"now": now}
    )
    for row in rows.fetchall():
        error = Unauthorized("key", expected="a key that is valid when its job begins", got="one that no longer is")
        move(connection, row, JobState.CANCELED, fault_of(error))


def _owned_row(connection: sqlite3.Connection, job: str, attempt: int) -> sqlite3.Row | None:
    return connection.execute(f"SELECT * FROM jobs WHERE {OWNS}", {"job": job, "attempt": attempt}).fetchone()


def _without_answer(row: sqlite3.Row) -> JobState:
    return JobState.CANCELED if row["state"] == JobState.CANCELING else JobState.QUEUED


def _release(connection: sqlite3.Connection, row: sqlite3.Row, reason: str) -> None:
    note(connection, row["id"], EventKind.LOG, log_line(f"attempt {row['attempt']} does not count: {reason}"))
    connection.execute("UPDATE jobs SET released = released + 1 WHERE id = ?", (row["id"],))
    move(connection, row, _without_answer(row))


def _gave_up(reason: str) -> dict[str, str]:
    crashed = ProcessDied(
        "job", expected="an answer from the job's process", got=f"none in {MAX_ATTEMPTS} attempts; last: {reason}",
        hint="signal 9 is mostly a lack of memory; the server's log has what the process printed",
    )  # fmt: skip
    return fault_of(crashed)
