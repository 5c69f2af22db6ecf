"""What happened to a job, numbered: its states, its log, its plan and its latest progress."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from liftcore.errors import NotFound
from service.store.database import Database
from service.store.owners import SEEN, Owned

LOG_LINES = 200  # a job; older ones go
LINE_CHARACTERS = 500


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


class EventStore(Owned):
    """The events of all jobs, for those who follow them."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def after(self, job: str, number: int) -> list[Event]:
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
