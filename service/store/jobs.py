"""Jobs: what was acknowledged, and how far it is."""

from __future__ import annotations

import json
import secrets
import sqlite3
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from liftcore.errors import NotFound
from service.errors import Crashed
from service.faults import fault_of
from service.store.database import Database
from service.wire import AssetKind, JobState

MAX_ATTEMPTS = 3


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


class JobStore:
    """The queue of jobs and its history."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def submit(self, splats: str, cameras: str, features: Sequence[str], settings: Mapping[str, Any]) -> str:
        """Put a job in line; it is on the disk when this returns.

        Raises:
            NotFound: an asset was deleted meanwhile.
        """
        job = secrets.token_hex(16)
        with self._database.write() as connection:
            wanted = [(splats, AssetKind.SPLATS), (cameras, AssetKind.CAMERAS)]
            wanted += [(asset, AssetKind.FEATURES) for asset in features]
            for asset, kind in wanted:
                if not connection.execute("SELECT 1 FROM assets WHERE id = ? AND kind = ?", (asset, kind)).fetchone():
                    raise NotFound(kind, expected=f"the id of an asset of kind {kind}", got=asset)
            connection.execute(
                "INSERT INTO jobs (id, state, splats, cameras, settings, created) VALUES (?, 'queued', ?, ?, ?, ?)",
                (job, splats, cameras, json.dumps(settings), time.time()),
            )
            connection.executemany(
                "INSERT INTO job_features (job, place, asset) VALUES (?, ?, ?)",
                [(job, place, asset) for place, asset in enumerate(features)],
            )
        return job

    def get(self, job: str) -> JobRecord:
        """The job of that id.

        Raises:
            NotFound: there is none.
        """
        with self._database.read() as connection:
            row = connection.execute("SELECT * FROM jobs WHERE id = ?", (job,)).fetchone()
            if row is None:
                raise NotFound("job", expected="the id of a job", got=job)
            return _record(connection, row)

    def all(self) -> list[JobRecord]:
        """Every job, newest first."""
        with self._database.read() as connection:
            rows = connection.execute("SELECT * FROM jobs ORDER BY created DESC, id").fetchall()
            return [_record(connection, row) for row in rows]

    def claim(self) -> JobRecord | None:
        """Take the oldest queued job and make it running, as a new attempt."""
        with self._database.write() as connection:
            row = connection.execute(
                "UPDATE jobs SET state = 'running', attempt = attempt + 1, started = ?, progress = NULL"
                " WHERE id = (SELECT id FROM jobs WHERE state = 'queued' ORDER BY created, id LIMIT 1)"
                " RETURNING *",
                (time.time(),),
            ).fetchone()
            return None if row is None else _record(connection, row)

    def advance(self, job: str, attempt: int, progress: Mapping[str, Any]) -> None:
        """Note how far an attempt is; a note from an older attempt is dropped."""
        with self._database.write() as connection:
            connection.execute(
                "UPDATE jobs SET progress = ? WHERE id = ? AND attempt = ? AND state = 'running'",
                (json.dumps(progress), job, attempt),
            )

    def fail(self, job: str, attempt: int, error: Mapping[str, str]) -> None:
        """End an attempt with a problem."""
        with self._database.write() as connection:
            connection.execute(
                "UPDATE jobs SET state = 'failed', problem = ?, ended = ?"
                " WHERE id = ? AND attempt = ? AND state = 'running'",
                (json.dumps(error), time.time(), job, attempt),
            )

    def release(self, job: str, attempt: int) -> None:
        """Put an attempt that an orderly stop interrupted back in line; it does not count as a failure."""
        with self._database.write() as connection:
            connection.execute(
                "UPDATE jobs SET state = 'queued', released = released + 1, progress = NULL"
                " WHERE id = ? AND attempt = ? AND state = 'running'",
                (job, attempt),
            )

    def requeue_orphans(self) -> None:
        """At start-up: what a dead server left running goes back in line, or fails after its last attempt."""
        ended = Crashed(
            "job", expected="an attempt that ends", got=f"a server that died in all {MAX_ATTEMPTS} attempts",
            hint="look at the server's memory and log, then POST /lift again",
        )  # fmt: skip
        with self._database.write() as connection:
            connection.execute(
                "UPDATE jobs SET state = 'failed', problem = ?, ended = ?"
                " WHERE state = 'running' AND attempt - released >= ?",
                (json.dumps(fault_of(ended)), time.time(), MAX_ATTEMPTS),
            )
            connection.execute("UPDATE jobs SET state = 'queued', progress = NULL WHERE state = 'running'")


def _record(connection: sqlite3.Connection, row: sqlite3.Row) -> JobRecord:
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
    )
