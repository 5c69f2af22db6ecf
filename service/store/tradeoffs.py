"""Trade-offs: what jobs that compare lifts found. They are small, and lie in the database whole."""

from __future__ import annotations

import hashlib
import json
import sqlite3
import time
from dataclasses import dataclass
from typing import Any

from liftcore.errors import NotFound
from service.store.attempts import succeed
from service.store.database import Database
from service.store.owners import SEEN, Owned


@dataclass(frozen=True)
class FinishedTradeoff:
    """What a job's process found."""

    document: dict[str, Any]  # as liftcore.evaluate.tradeoff.compare gives it
    page: str  # Markdown
    chart: bytes  # PNG


@dataclass(frozen=True)
class TradeoffRecord:
    """A trade-off as the store knows it."""

    id: str  # the id of its job
    document: dict[str, Any]
    page: str
    chart: bytes
    sha256: str  # of the chart
    created: float
    splats: str  # ids of the assets that were lifted
    cameras: str
    features: tuple[str, ...]
    labels: dict[str, Any] | None  # of the order


# A trade-off belongs to whom its job does.
VISIBLE = (
    "SELECT tradeoffs.*, splats, cameras, json_extract(parameters, '$.labels') AS labels,"
    " (SELECT json_group_array(asset) FROM"
    " (SELECT asset FROM job_features WHERE job = jobs.id ORDER BY place)) AS features"
    f" FROM tradeoffs JOIN jobs USING (id) WHERE {SEEN}"
)


class TradeoffStore(Owned):
    """Trade-offs in the database."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def finish(self, job: str, attempt: int, made: FinishedTradeoff) -> bool:
        """End an attempt with its trade-off: it and the job's last state become true together.

        Returns:
            False when the attempt may not (`succeed`); then nothing changes.
        """
        document = json.dumps(made.document)
        size = len(document) + len(made.page.encode()) + len(made.chart)
        digest = hashlib.sha256(made.chart).hexdigest()
        with self._database.write(counted=True) as connection:
            if not succeed(connection, job, attempt):
                return False
            connection.execute(
                "INSERT INTO tradeoffs (id, bytes, document, page, chart, sha256, created) VALUES (?,?,?,?,?,?,?)",
                (job, size, document, made.page, made.chart, digest, time.time()),
            )
        return True

    def get(self, tradeoff: str) -> TradeoffRecord:
        """The trade-off of that id.

        Raises:
            NotFound: there is none.
        """
        terms = self._owner.terms(tradeoff=tradeoff)
        with self._database.read() as connection:
            row = connection.execute(f"{VISIBLE} AND id = :tradeoff", terms).fetchone()
        if row is None:
            raise NotFound(
                "tradeoff", expected="the id of a trade-off", got=tradeoff,
                hint="POST /tradeoff makes one; it has its job's id",
            )  # fmt: skip
        return _record(row)


def _record(row: sqlite3.Row) -> TradeoffRecord:
    return TradeoffRecord(
        id=row["id"],
        document=json.loads(row["document"]),
        page=row["page"],
        chart=row["chart"],
        sha256=row["sha256"],
        created=row["created"],
        splats=row["splats"],
        cameras=row["cameras"],
        features=tuple(json.loads(row["features"])),
        labels=None if row["labels"] is None else json.loads(row["labels"]),
    )
