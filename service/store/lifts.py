"""Results of jobs: lifts, which are files, and trade-offs, which are stored in the database whole."""

from __future__ import annotations

import contextlib
import hashlib
import json
import secrets
import sqlite3
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from liftcore.errors import NotFound
from liftcore.files import whole_file, with_metadata
from service.errors import InvalidRequest
from service.store.assets import add_owner
from service.store.database import Database, Page, insert, page_of, parsed, record_of
from service.store.files import DataDirectory, sync_directory
from service.store.jobs import JobOrder, record_state, succeed
from service.store.owners import OWNER_CLAUSE, VISIBLE_JOBS, Owner, require_quota

BY_HAND = "set by hand"  # reason of the rendering in a lift's plan: the setting was not auto
WORLD_CHANGED = "world_changed"  # in a lift's metadata in the database: its file has another world
SET_WORLD = f"""
    UPDATE lifts SET metadata = json_set(metadata, '$.world', json(?), '$.{WORLD_CHANGED}', json('true')) WHERE id = ?
"""


@dataclass(frozen=True)
class FinishedLift:
    """Result of a lift job: a draft and its description."""

    draft: Path
    sha256: str
    count: int  # P
    channels: int  # F
    metadata: dict[str, Any]


@dataclass(frozen=True)
class LiftRecord:
    """Record of a lift."""

    id: str  # the id of its job
    bytes: int
    sha256: str
    path: Path
    count: int
    channels: int
    name: str | None  # given by a user
    metadata: dict[str, Any]  # without long lists of views and words
    view_count: int
    first_view: str | None
    created: float
    splats: str  # ids of the assets that it was made of
    cameras: str
    features: tuple[str, ...]
    photos: str | None  # of its views

    def changed_header(self) -> bytes | None:
        """Return the length and the header of the lift's file with the present ``world``; None if the file has it.

        Raises:
            NotFound: the file is not there, or no longer a lift.
        """
        if not self.metadata.get(WORLD_CHANGED):
            return None
        try:
            handle: Any
            with safe_open(str(self.path), framework="np") as handle:
                metadata = json.loads(handle.metadata()["splatlift"])
            in_file, now = (
                {name: value for name, value in (world or {}).items() if value is not None}
                for world in (metadata.get("world"), self.metadata["world"])
            )
            if in_file == now:
                return None
            metadata |= {"world": self.metadata["world"]}
            return next(
                with_metadata(
                    self.path, {"splatlift": json.dumps(metadata, ensure_ascii=False, separators=(",", ":"))}
                )
            )
        except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
            got = f"one that does not open: {error}"[:200]
            raise NotFound("content", expected="the file of a lift", got=got, hint="lift again") from None


@dataclass(frozen=True)
class FinishedTradeoff:
    """Result of a trade-off job."""

    document: dict[str, Any]  # from liftcore.evaluate.tradeoff.compare
    page: str  # Markdown
    chart: bytes  # PNG


@dataclass(frozen=True)
class TradeoffRecord:
    """Record of a trade-off."""

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


# A result belongs to its job's owner: one statement, so that no result is without its job.
FEATURES = "(SELECT json_group_array(asset) FROM (SELECT asset FROM job_features WHERE job = jobs.id ORDER BY place))"
NAMES_OF_VIEWS = ("views_without_camera", "views_without_splats")  # in the diagnostics
SHOWN_BYTES = 64 << 10  # of metadata; longer lists of views are given in pages
LONG = ("views", "words")  # left out of long metadata
VISIBLE = (
    f"SELECT lifts.*, splats, cameras, {FEATURES} AS features FROM lifts JOIN jobs USING (id) WHERE {VISIBLE_JOBS}"
)
VISIBLE_TRADEOFFS = (
    "SELECT tradeoffs.*, splats, cameras, json_extract(parameters, '$.labels') AS labels,"
    f" {FEATURES} AS features FROM tradeoffs JOIN jobs USING (id) WHERE {OWNER_CLAUSE}"
)


def order_of(metadata: Mapping[str, Any]) -> JobOrder:
    """Return the order that a lift's file records: what it was made of.

    Raises:
        KeyError, TypeError: these are no metadata of a lift.
    """
    files = (metadata["splats"], metadata["cameras"], *metadata["features"])
    splats, cameras, *features = [f"sha256:{file['sha256']}" for file in files]
    settings, diagnostics = dict(metadata["settings"]), metadata.get("diagnostics")
    plan = diagnostics.get("plan") if isinstance(diagnostics, Mapping) else None
    if isinstance(plan, Mapping) and BY_HAND not in str(plan.get("rendering", BY_HAND)):
        settings["antialiased"] = "auto"  # the lift records the resolved value
    return JobOrder(splats, cameras, tuple(features), settings)


class LiftStore:
    """Lifts in the database, with their bytes in lifts/. Lifts of other owners count as absent."""

    def __init__(self, database: Database, files: DataDirectory) -> None:
        self._database = database
        self._files = files

    def finish(self, job: str, attempt: int, result: FinishedLift) -> bool:
        """End an attempt with its lift: the file, the lift and the job's last state are stored together.

        Returns:
            False when the attempt may not (`succeed`); then nothing changes.
        """
        path, size, published = self._files.lift(job), result.draft.stat().st_size, False
        try:
            with self._database.write(is_counted=True) as connection:
                if not succeed(connection, job, attempt):
                    return False
                self._files.publish(result.draft, path)
                published = True
                self._insert(connection, job, result, size, time.time())
        except BaseException:
            if published:  # the next attempt finds the draft again
                with contextlib.suppress(OSError):
                    path.replace(result.draft)
            raise
        return True

    def take(self, owner: Owner, order: JobOrder, result: FinishedLift) -> LiftRecord:
        """Store an uploaded lift, as the result of a job that never ran.

        Args:
            owner: whose it is.
            order: its inputs, which are in the store.
            result: of a checked draft.

        Raises:
            OverQuota: it would be more than the owner may store.
            NotFound: an asset was deleted meanwhile.
        """
        job = secrets.token_hex(16)
        try:
            self.adopt(owner, job, order, result)
        except sqlite3.IntegrityError:
            raise NotFound("lift", expected="its splats and cameras", got="one was deleted a moment ago") from None
        return self.get(owner, job)

    def adopt(self, owner: Owner, job: str, order: JobOrder, result: FinishedLift) -> None:
        """Store a lift without a row, and perhaps without a job, from a draft or from its own place.

        Args:
            owner: of the job, if there is none.
            job: its id.
            order: its inputs, which are in the store.
            result: of the draft, or of the file itself.
        """
        path, status = self._files.lift(job), result.draft.stat()
        with self._database.write(is_counted=True) as connection:
            if result.draft != path:
                require_quota(connection, owner, status.st_size)
            row = connection.execute(
                "INSERT INTO jobs (id, owner, state, attempt, splats, cameras, settings, created, started, ended)"
                " VALUES (:id, :owner, 'succeeded', 1, :splats, :cameras, :settings, :time, :time, :time)"
                " ON CONFLICT (id) DO UPDATE SET state = 'succeeded', ended = :time, problem = NULL RETURNING *",
                {
                    "id": job,
                    "owner": owner.key,
                    "splats": order.splats,
                    "cameras": order.cameras,
                    "settings": json.dumps(order.settings),
                    "time": status.st_mtime,
                },
            ).fetchone()
            for place, asset in enumerate(order.features):
                connection.execute("INSERT OR IGNORE INTO job_features VALUES (?, ?, ?)", (job, place, asset))
            for asset, _ in order.assets():
                add_owner(connection, asset, row["owner"])
            record_state(connection, row)
            self._insert(connection, job, result, status.st_size, status.st_mtime)
            if result.draft != path:
                self._files.publish(result.draft, path)

    def change(self, owner: Owner, lift: str, changes: Mapping[str, Any]) -> LiftRecord:
        """Set a lift's ``name``, ``photos`` (an asset) or ``world``; None removes them.

        Raises:
            NotFound: there is no such lift, or there are no such photos.
        """
        with self._database.write(is_counted=True) as connection:
            self.get(owner, lift)  # within the transaction, so that it is not deleted meanwhile
            photos = changes.get("photos")
            if photos is not None:
                self._own_photos(connection, owner, lift, photos)
            for column in changes.keys() & {"name", "photos"}:
                connection.execute(f"UPDATE lifts SET {column} = ? WHERE id = ?", (changes[column] or None, lift))
            if "world" in changes:
                connection.execute(SET_WORLD, (json.dumps(changes["world"] or {}), lift))
            self._write_changes(connection, lift)
        return self.get(owner, lift)

    def _write_changes(self, connection: sqlite3.Connection, lift: str) -> None:
        """Store the changes of a lift beside its file, which never changes, within a write transaction."""
        row = connection.execute("SELECT name, photos, metadata FROM lifts WHERE id = ?", (lift,)).fetchone()
        metadata, path = json.loads(row["metadata"]), self._files.lift_changes(lift)
        world = {"world": metadata["world"]} if metadata.get(WORLD_CHANGED) else {}
        with whole_file(path) as handle:
            handle.write(json.dumps({"name": row["name"], "photos": row["photos"], **world}).encode())
        sync_directory(path.parent)

    def _own_photos(self, connection: sqlite3.Connection, owner: Owner, lift: str, photos: str) -> None:
        """Add the lift's owner to assets, within a write transaction, also if an admin requested it."""
        row = connection.execute(
            "SELECT 1 FROM assets JOIN asset_owners ON asset = id"
            f" WHERE id = :photos AND kind = 'photos' AND {OWNER_CLAUSE}",
            owner.terms(photos=photos),
        ).fetchone()
        if row is None:
            hint = "PUT /assets/photos first"
            raise NotFound("photos", expected="an asset of kind photos that is here", got=photos, hint=hint)
        add_owner(
            connection, photos, connection.execute("SELECT owner FROM jobs WHERE id = ?", (lift,)).fetchone()["owner"]
        )

    def of_file(self, owner: Owner, sha256: str) -> LiftRecord | None:
        """Return the lift of a file with that digest; None if there is none."""
        with self._database.read() as connection:
            terms = owner.terms(sha256=sha256)
            row = connection.execute(f"{VISIBLE} AND sha256 = :sha256 LIMIT 1", terms).fetchone()
        return None if row is None else self._record(row)

    def _insert(
        self, connection: sqlite3.Connection, job: str, result: FinishedLift, size: int, created: float
    ) -> None:
        values = dict(result.metadata)
        metadata, views = json.dumps(values), values["views"]
        if len(metadata) > SHOWN_BYTES:
            diagnostics = _without(values["diagnostics"], *NAMES_OF_VIEWS)
            metadata = json.dumps(_without(values, *LONG) | {"diagnostics": diagnostics})
        row = {
            "id": job,
            "bytes": size,
            "sha256": result.sha256,
            "file": self._files.relative(self._files.lift(job)),
            "count": result.count,
            "channels": result.channels,
            "metadata": metadata,
            "view_count": len(views),
            "first_view": next(iter(views), None),
            "created": created,
        }
        insert(connection, "lifts", row)
        connection.executemany("INSERT OR IGNORE INTO lifted_views VALUES (?, ?)", ((job, view) for view in views))

    def find(self, owner: Owner, lift: str) -> LiftRecord | None:
        """Return the lift of that id; None if there is none."""
        with self._database.read() as connection:
            row = connection.execute(f"{VISIBLE} AND id = :lift", owner.terms(lift=lift)).fetchone()
        return None if row is None else self._record(row)

    def get(self, owner: Owner, lift: str) -> LiftRecord:
        """Return the lift of that id.

        Raises:
            NotFound: there is none.
        """
        record = self.find(owner, lift)
        if record is None:
            raise NotFound(
                "lift", expected="the id of a lift", got=lift, hint="GET /lifts lists them; a lift has its job's id"
            )
        return record

    def lifted(self, owner: Owner, lift: str, names: list[str]) -> set[str]:
        """Return the set of these views that were lifted."""
        select, ident = "SELECT 1 FROM lifted_views WHERE lift = ? AND name = ?", self.get(owner, lift).id
        with self._database.read() as connection:
            return {name for name in names if connection.execute(select, (ident, name)).fetchone()}

    def only(self, owner: Owner) -> LiftRecord:
        """Return the only lift.

        Raises:
            NotFound: there is none at all.
            InvalidRequest: there are several, so one must be named.
        """
        with self._database.read() as connection:
            rows = connection.execute(f"{VISIBLE} LIMIT 2", owner.terms()).fetchall()
        if not rows:
            raise NotFound("lift", expected="at least one lift", got="none", hint="POST /lift first")
        if len(rows) > 1:
            raise InvalidRequest(
                "lift", expected="the id of a lift, as there are several", got="nothing", hint="GET /lifts lists them"
            )
        return self._record(rows[0])

    def page(self, owner: Owner, limit: int, cursor: str | None = None) -> Page[LiftRecord]:
        """Return so many lifts after a cursor, newest first."""
        with self._database.read() as connection:
            return page_of(connection, VISIBLE, owner.terms(), limit, cursor, self._record)

    def all(self, owner: Owner) -> list[LiftRecord]:
        """Return every lift, newest first."""
        return self.page(owner, sys.maxsize - 1).records

    def _record(self, row: sqlite3.Row) -> LiftRecord:
        return record_of(
            LiftRecord,
            row,
            path=self._files.root / row["file"],
            metadata=json.loads(row["metadata"]),
            features=tuple(json.loads(row["features"])),
        )


def _without(values: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name not in names}


class TradeoffStore:
    """Trade-offs in the database. Those of other owners count as absent."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def finish(self, job: str, attempt: int, result: FinishedTradeoff) -> bool:
        """End an attempt with its trade-off: it and the job's last state are stored together.

        Returns:
            False when the attempt may not (`succeed`); then nothing changes.
        """
        document = json.dumps(result.document)
        row = {
            "id": job,
            "bytes": len(document) + len(result.page.encode()) + len(result.chart),
            "document": document,
            "page": result.page,
            "chart": result.chart,
            "sha256": hashlib.sha256(result.chart).hexdigest(),
            "created": time.time(),
        }
        with self._database.write(is_counted=True) as connection:
            if not succeed(connection, job, attempt):
                return False
            insert(connection, "tradeoffs", row)
        return True

    def get(self, owner: Owner, tradeoff: str) -> TradeoffRecord:
        """Return the trade-off of that id.

        Raises:
            NotFound: there is none.
        """
        terms = owner.terms(tradeoff=tradeoff)
        with self._database.read() as connection:
            row = connection.execute(f"{VISIBLE_TRADEOFFS} AND id = :tradeoff", terms).fetchone()
        if row is None:
            raise NotFound(
                "tradeoff", expected="the id of a trade-off", got=tradeoff,
                hint="POST /tradeoff makes one; it has its job's id",
            )  # fmt: skip
        return record_of(
            TradeoffRecord,
            row,
            document=json.loads(row["document"]),
            features=tuple(json.loads(row["features"])),
            labels=parsed(row["labels"]),
        )
