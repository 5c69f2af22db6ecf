"""Jobs: what was acknowledged, what became of it, and what happened on the way."""

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
from typing import Any

from liftcore.errors import NotFound
from service.errors import Busy, Conflict, KeyReused
from service.models import ENDED, AssetKind, JobKind, JobState
from service.store.assets import own
from service.store.database import Database
from service.store.files import DataDirectory
from service.store.owners import QUEUE_RETRY_SECONDS, SEEN, Owner, require_quota, require_turn
from service.store.pages import Page, after, page_of

LOG_LINES = 200  # a job; older ones go
LINE_CHARACTERS = 500
RESULTS = {JobKind.LIFT: "lifts", JobKind.TRADEOFF: "tradeoffs"}  # the tables of what jobs make, by their ids


@dataclass(frozen=True)
class JobOrder:
    """What a client wants to have done."""

    splats: str
    cameras: str
    features: tuple[str, ...]
    settings: dict[str, Any] = field(default_factory=dict)  # all of them, with defaults filled in
    key: str | None = None  # Idempotency-Key
    fingerprint: str | None = None  # of the order as it was sent, with a key
    request_id: str | None = None  # of the request that brings it
    kind: JobKind = JobKind.LIFT
    parameters: dict[str, Any] = field(default_factory=dict)  # what its kind takes beside settings

    def assets(self) -> list[tuple[str, AssetKind]]:
        """What it needs: ids, and the kind that each must be."""
        wanted = [(self.splats, AssetKind.SPLATS), (self.cameras, AssetKind.CAMERAS)]
        return [*wanted, *((asset, AssetKind.FEATURES) for asset in self.features), *labels_of(self.parameters)]


@dataclass(frozen=True)
class JobRecord:
    """A job as the store knows it."""

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
    """What an event tells of."""

    STATE = "state"
    PLAN = "plan"
    PROGRESS = "progress"
    LOG = "log"


@dataclass(frozen=True)
class Event:
    """Something that happened to a job."""

    number: int  # ascending in a job
    kind: EventKind
    data: dict[str, Any]


def labels_of(parameters: Mapping[str, Any]) -> list[tuple[str, AssetKind]]:
    """The assets that a job's parameters name, with their kinds: what a trade-off is judged by."""
    named = parameters.get("labels")
    return [] if named is None else [(named[str(kind)], kind) for kind in (AssetKind.MASKS, AssetKind.TABLE)]


def fingerprint(order: dict[str, Any]) -> str:
    """The digest of an order, by which a repeated one is known."""
    return hashlib.sha256(json.dumps(order, sort_keys=True).encode()).hexdigest()


class JobStore:
    """The line of jobs and their history, as an owner sees them. Attempts at them are in `service.store.attempts`."""

    def __init__(self, database: Database, files: DataDirectory, owner: Owner) -> None:
        self._database = database
        self._files = files
        self._owner = owner

    def submit(self, order: JobOrder, *, max_queued: int = 1_000_000) -> tuple[str, bool]:
        """Put a job in line; it is on the disk when this returns.

        Returns:
            The id, and whether the job is new: an order with the key of an earlier one is that one.

        Raises:
            NotFound: an asset was deleted meanwhile, or is not the owner's.
            Busy: there are ``max_queued`` jobs in line.
            TooMany, OverQuota: the owner has as many in line, or stored, as it may.
            KeyReused: the key came with another order before.
        """
        job = secrets.token_hex(16)
        with self._database.write(counted=True) as connection:
            known = _of_key(connection, order, self._owner)
            if known is not None:
                return known, False
            _require_place(connection, order.kind, max_queued)
            require_turn(connection, order.kind, self._owner)
            _take_assets(connection, order, self._owner)
            require_quota(connection, self._owner, 1)
            connection.execute(
                "INSERT INTO jobs (id, owner, kind, state, splats, cameras, settings, parameters, created,"
                " idempotency_key, fingerprint, request_id) VALUES (?, ?, ?, 'queued', ?, ?, ?, ?, ?, ?, ?, ?)",
                (
                    job,
                    self._owner.key,
                    order.kind,
                    order.splats,
                    order.cameras,
                    json.dumps(order.settings),
                    json.dumps(order.parameters),
                    time.time(),
                    order.key,
                    order.fingerprint,
                    order.request_id,
                ),
            )
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

    def repeated(self, order: JobOrder) -> str | None:
        """The job that an earlier order of this owner with this Idempotency-Key made, None when there is none.

        Raises:
            KeyReused: the key came with another order before.
        """
        with self._database.read() as connection:
            return _of_key(connection, order, self._owner)

    def get(self, job: str) -> JobRecord:
        """The job of that id.

        Raises:
            NotFound: there is none.
        """
        with self._database.read() as connection:
            row = row_of(connection, job, self._owner)
            return record(connection, row)

    def count_by_state(self) -> dict[JobState, int]:
        """How many jobs there are in each state that has any."""
        with self._database.read() as connection:
            rows = connection.execute("SELECT state, count(*) FROM jobs GROUP BY state").fetchall()
        return {JobState(state): count for state, count in rows}

    def page(self, limit: int, cursor: str | None = None) -> Page[JobRecord]:
        """So many jobs after a cursor, newest first."""
        terms = self._owner.terms(most=limit + 1, **after(cursor))
        with self._database.read() as connection:
            rows = connection.execute(
                f"SELECT * FROM jobs WHERE {SEEN} AND created <= :created AND (created < :created OR id > :after)"
                " ORDER BY created DESC, id LIMIT :most",
                terms,
            ).fetchall()
            return page_of(rows, limit, lambda row: record(connection, row))

    def all(self) -> list[JobRecord]:
        """Every job, newest first."""
        return self.page(sys.maxsize - 1).records

    def state(self, job: str) -> JobState | None:
        """Where a job is; None when there is none."""
        with self._database.read() as connection:
            row = find(connection, job, self._owner)
        return None if row is None else JobState(row["state"])

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
            move(connection, row, JobState.CANCELED if state is JobState.QUEUED else JobState.CANCELING)
            return True

    def events(self, job: str, number: int) -> list[Event]:
        """The events of a job beyond a number, in order.

        Raises:
            NotFound: there is no such job, or the key that follows it was revoked.
        """
        with self._database.read() as connection:
            seen = connection.execute(
                f"SELECT 1 FROM jobs WHERE id = :job AND {SEEN}"
                " AND NOT EXISTS (SELECT 1 FROM keys WHERE id = :owner AND revoked IS NOT NULL)",
                self._owner.terms(job=job),
            )
            if seen.fetchone() is None:
                raise NotFound("job", expected="the id of a job", got=job)
            rows = connection.execute(
                "SELECT number, kind, data FROM job_events WHERE job = ? AND number > ? ORDER BY number",
                (job, number),
            ).fetchall()
        return [Event(row["number"], EventKind(row["kind"]), json.loads(row["data"])) for row in rows]

    def delete(self, job: str, *, given_up: Collection[JobKind] = ()) -> None:
        """Forget a job that has ended, its events and its result.

        Args:
            job: its id.
            given_up: the kinds of jobs whose result may go with them.

        Raises:
            NotFound: there is none.
            Conflict: it has not ended, or it has a result that was not given up.
        """
        with self._database.write(counted=True) as connection:
            row = row_of(connection, job, self._owner)
            if row["state"] not in ENDED:
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
        # After the commit: a crash here leaves files that the collection of garbage finds.
        self._files.lift(job).unlink(missing_ok=True)
        self._files.forget_work(job)


def find(connection: sqlite3.Connection, job: str, owner: Owner) -> sqlite3.Row | None:
    """The row of a job that an owner sees."""
    return connection.execute(f"SELECT * FROM jobs WHERE id = :job AND {SEEN}", owner.terms(job=job)).fetchone()


def row_of(connection: sqlite3.Connection, job: str, owner: Owner) -> sqlite3.Row:
    """`find`, where there must be one.

    Raises:
        NotFound: there is no such job, or the owner does not see it.
    """
    row = find(connection, job, owner)
    if row is None:
        raise NotFound("job", expected="the id of a job", got=job)
    return row


def record(connection: sqlite3.Connection, row: sqlite3.Row) -> JobRecord:
    """A row of the table as a record."""
    features = connection.execute("SELECT asset FROM job_features WHERE job = ? ORDER BY place", (row["id"],))
    return JobRecord(
        id=row["id"],
        state=JobState(row["state"]),
        attempt=row["attempt"],
        splats=row["splats"],
        cameras=row["cameras"],
        features=tuple(found["asset"] for found in features),
        settings=json.loads(row["settings"]),
        progress=None if row["progress"] is None else json.loads(row["progress"]),
        problem=None if row["problem"] is None else json.loads(row["problem"]),
        created=row["created"],
        started=row["started"],
        ended=row["ended"],
        request_id=row["request_id"],
        kind=JobKind(row["kind"]),
        parameters=json.loads(row["parameters"]),
        plan=None if row["plan"] is None else json.loads(row["plan"]),
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
        raise Busy(
            kind, expected=f"fewer than {max_queued} jobs in line", got=f"{queued}", hint="try again later",
            retry_after=QUEUE_RETRY_SECONDS,
        )  # fmt: skip


def _take_assets(connection: sqlite3.Connection, order: JobOrder, owner: Owner) -> None:
    """See that the assets are there; what the job of an admin needs of others, the admin has from now on."""
    for asset, kind in order.assets():
        seen = connection.execute(
            f"SELECT 1 FROM assets JOIN asset_owners ON asset = id WHERE id = :asset AND kind = :kind AND {SEEN}",
            owner.terms(asset=asset, kind=kind),
        )
        if seen.fetchone() is None:
            raise NotFound(kind, expected=f"the id of an asset of kind {kind}", got=asset)
        own(connection, asset, owner.key)


def note(connection: sqlite3.Connection, job: str, kind: EventKind, data: Mapping[str, Any]) -> None:
    """Add an event within a write transaction. Of plan and progress the latest is kept, of the log the last lines."""
    connection.execute(
        "INSERT INTO job_events (job, number, kind, data, created)"
        " SELECT ?, coalesce(max(number), 0) + 1, ?, ?, ? FROM job_events WHERE job = ?",
        (job, kind, json.dumps(data), time.time(), job),
    )
    kept = {EventKind.PLAN: 1, EventKind.PROGRESS: 1, EventKind.LOG: LOG_LINES}.get(kind)
    if kept is not None:
        connection.execute(
            "DELETE FROM job_events WHERE job = :job AND kind = :kind AND number NOT IN"
            " (SELECT number FROM job_events WHERE job = :job AND kind = :kind ORDER BY number DESC LIMIT :kept)",
            {"job": job, "kind": kind, "kept": kept},
        )


def log_line(text: str) -> dict[str, Any]:
    """A line of the log as the data of an event."""
    return {"line": text[:LINE_CHARACTERS], "time": round(time.time(), 3)}


def told(connection: sqlite3.Connection, row: sqlite3.Row) -> None:
    """Note the state of a row that was just changed."""
    problem = None if row["problem"] is None else json.loads(row["problem"])
    data = {"state": row["state"], "attempt": row["attempt"], "problem": problem}
    note(connection, row["id"], EventKind.STATE, data)


def move(
    connection: sqlite3.Connection, row: sqlite3.Row, state: JobState, problem: Mapping[str, str] | None = None
) -> None:
    """Within a write transaction: bring a job to a state, and note it."""
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
