"""Lifts: the results of jobs."""

from __future__ import annotations

import json
import sqlite3
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from liftcore.errors import NotFound
from service.errors import InvalidRequest
from service.store.assets import own
from service.store.attempts import succeed, told
from service.store.database import Database
from service.store.files import DataDirectory
from service.store.jobs import JobOrder
from service.store.owners import SEEN, Owned
from service.store.pages import Page, after, page_of


@dataclass(frozen=True)
class FinishedLift:
    """What a job's process made: a draft and what it says about it."""

    draft: Path
    sha256: str
    count: int  # P
    channels: int  # F
    metadata: dict[str, Any]


@dataclass(frozen=True)
class LiftRecord:
    """A lift as the store knows it."""

    id: str  # the id of its job
    bytes: int
    sha256: str
    path: Path
    count: int
    channels: int
    metadata: dict[str, Any]
    created: float
    splats: str  # ids of the assets that it was made of
    cameras: str
    features: tuple[str, ...]


# A lift belongs to whom its job does. One statement, so that no lift is without its job.
VISIBLE = (
    "SELECT lifts.*, splats, cameras, (SELECT json_group_array(asset) FROM"
    " (SELECT asset FROM job_features WHERE job = jobs.id ORDER BY place)) AS features"
    f" FROM lifts JOIN jobs USING (id) WHERE {SEEN}"
)


class LiftStore(Owned):
    """Lifts in the database, their bytes in lifts/."""

    def __init__(self, database: Database, files: DataDirectory) -> None:
        self._database = database
        self._files = files

    def finish(self, job: str, attempt: int, made: FinishedLift) -> bool:
        """End an attempt with its lift: the file, the lift and the job's last state become true together.

        Returns:
            False when the attempt may not (`succeed`); then nothing changes.
        """
        path = self._files.lift(job)
        size = made.draft.stat().st_size
        with self._database.write(counted=True) as connection:
            if not succeed(connection, job, attempt):
                return False
            self._files.publish(made.draft, path)
            self._insert(connection, job, made, size, time.time())
        return True

    def adopt(self, job: str, order: JobOrder, made: FinishedLift) -> None:
        """Keep a lift whose file lies where it belongs and whose row, and perhaps its job, was lost.

        Args:
            job: its id.
            order: what it was made of; the assets are here.
            made: of the file itself, not of a draft.
        """
        status = made.draft.stat()
        with self._database.write(counted=True) as connection:
            row = connection.execute(
                "INSERT INTO jobs (id, owner, state, attempt, splats, cameras, settings, created, started, ended)"
                " VALUES (:id, :owner, 'succeeded', 1, :splats, :cameras, :settings, :time, :time, :time)"
                " ON CONFLICT (id) DO UPDATE SET state = 'succeeded', ended = :time, problem = NULL,"
                " leased_until = NULL RETURNING *",
                {
                    "id": job,
                    "owner": self._owner.key,
                    "splats": order.splats,
                    "cameras": order.cameras,
                    "settings": json.dumps(order.settings),
                    "time": status.st_mtime,
                },
            ).fetchone()
            for place, asset in enumerate(order.features):
                connection.execute("INSERT OR IGNORE INTO job_features VALUES (?, ?, ?)", (job, place, asset))
            for asset, _ in order.assets():
                own(connection, asset, row["owner"])
            told(connection, row)
            self._insert(connection, job, made, status.st_size, status.st_mtime)

    def _insert(
        self, connection: sqlite3.Connection, job: str, made: FinishedLift, size: int, created: float
    ) -> None:
        connection.execute(
            "INSERT INTO lifts (id, bytes, sha256, file, count, channels, metadata, created)"
            " VALUES (?,?,?,?,?,?,?,?)",
            (
                job,
                size,
                made.sha256,
                self._files.relative(self._files.lift(job)),
                made.count,
                made.channels,
                json.dumps(made.metadata),
                created,
            ),
        )

    def find(self, lift: str) -> LiftRecord | None:
        """The lift of that id, None when there is none."""
        with self._database.read() as connection:
            row = connection.execute(f"{VISIBLE} AND id = :lift", self._owner.terms(lift=lift)).fetchone()
        return None if row is None else self._record(row)

    def get(self, lift: str) -> LiftRecord:
        """The lift of that id.

        Raises:
            NotFound: there is none.
        """
        found = self.find(lift)
        if found is None:
            raise NotFound(
                "lift",
                expected="the id of a lift",
                got=lift,
                hint="GET /lifts lists them; a lift has its job's id",
            )
        return found

    def only(self) -> LiftRecord:
        """The one lift that is here.

        Raises:
            NotFound: there is none at all.
            InvalidRequest: there are several, so one must be named.
        """
        with self._database.read() as connection:
            rows = connection.execute(f"{VISIBLE} LIMIT 2", self._owner.terms()).fetchall()
        if not rows:
            raise NotFound("lift", expected="at least one lift", got="none", hint="POST /lift first")
        if len(rows) > 1:
            raise InvalidRequest(
                "lift",
                expected="the id of a lift, as there are several",
                got="nothing",
                hint="GET /lifts lists them",
            )
        return self._record(rows[0])

    def page(self, limit: int, cursor: str | None = None) -> Page[LiftRecord]:
        """So many lifts after a cursor, newest first."""
        terms = self._owner.terms(most=limit + 1, **after(cursor))
        with self._database.read() as connection:
            rows = connection.execute(
                f"{VISIBLE} AND lifts.created <= :created AND (lifts.created < :created OR id > :after)"
                " ORDER BY lifts.created DESC, id LIMIT :most",
                terms,
            ).fetchall()
        return page_of(rows, limit, self._record)

    def all(self) -> list[LiftRecord]:
        """Every lift, newest first."""
        return self.page(sys.maxsize - 1).records

    def collect(self, older_than: float) -> list[Path]:
        """Move files that no lift has to quarantine: what a crash between a file and its row left.

        Args:
            older_than: seconds since 1970; younger files stay.

        Returns:
            What was moved.
        """
        with self._database.write() as connection:  # so no lift is between its file and its row
            known = {row["file"] for row in connection.execute("SELECT file FROM lifts")}
            found = (self._files.root / "lifts").iterdir()
            lost = [path for path in found if self._files.relative(path) not in known]
            return self._files.quarantine(path for path in lost if path.stat().st_mtime < older_than)

    def _record(self, row: sqlite3.Row) -> LiftRecord:
        return LiftRecord(
            id=row["id"],
            bytes=row["bytes"],
            sha256=row["sha256"],
            path=self._files.root / row["file"],
            count=row["count"],
            channels=row["channels"],
            metadata=json.loads(row["metadata"]),
            created=row["created"],
            splats=row["splats"],
            cameras=row["cameras"],
            features=tuple(json.loads(row["features"])),
        )
