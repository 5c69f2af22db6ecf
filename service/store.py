"""The store: one data directory, held by one server. SQLite says who owns the files in blobs/ and lifts/.

Files become visible whole: a draft is written, synced and renamed, and only then its row is committed. Rows are the
replies of HTTP (`service.models`). Nothing is deleted unless somebody asks for it.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import os
import secrets
import shutil
import sqlite3
import stat
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from liftcore.errors import NotFound
from service.errors import REQUEST_ID, Busy, Conflict, KeyReused, Misconfigured, NoSpace
from service.models import FINAL_STATES, Asset, Job, Key, Lift

DATABASE = "service.sqlite"
VERSION = 21  # SQLite's user_version
SCHEMA = """
CREATE TABLE IF NOT EXISTS assets (
    id TEXT, owner TEXT, kind TEXT NOT NULL, bytes INTEGER NOT NULL, file TEXT NOT NULL,
    counts TEXT NOT NULL, warnings TEXT NOT NULL, created REAL NOT NULL, PRIMARY KEY (id, owner)) STRICT;
CREATE TABLE IF NOT EXISTS jobs (
    id TEXT PRIMARY KEY, owner TEXT NOT NULL, kind TEXT NOT NULL, state TEXT NOT NULL,
    attempt INTEGER NOT NULL DEFAULT 0, splats TEXT NOT NULL, cameras TEXT NOT NULL, features TEXT NOT NULL,
    settings TEXT NOT NULL, parameters TEXT NOT NULL, plan TEXT, progress TEXT, problem TEXT, request_id TEXT,
    idempotency_key TEXT, digest TEXT, created REAL NOT NULL, started REAL, ended REAL,
    UNIQUE (owner, idempotency_key)) STRICT;
CREATE INDEX IF NOT EXISTS jobs_in_line ON jobs (state, created);
CREATE TABLE IF NOT EXISTS events (
    number INTEGER PRIMARY KEY AUTOINCREMENT, job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    kind TEXT NOT NULL, data TEXT NOT NULL) STRICT;
CREATE INDEX IF NOT EXISTS events_of_job ON events (job, number);
CREATE TABLE IF NOT EXISTS lifts (
    id TEXT PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE, name TEXT, photos TEXT, world TEXT,
    file TEXT NOT NULL, bytes INTEGER NOT NULL, sha256 TEXT NOT NULL, count INTEGER NOT NULL,
    channels INTEGER NOT NULL, metadata TEXT NOT NULL) STRICT;
CREATE INDEX IF NOT EXISTS lifts_by_digest ON lifts (sha256);
CREATE TABLE IF NOT EXISTS tradeoffs (
    id TEXT PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE, document TEXT NOT NULL, chart BLOB NOT NULL) STRICT;
CREATE TABLE IF NOT EXISTS keys (
    id TEXT PRIMARY KEY, name TEXT NOT NULL, digest TEXT NOT NULL UNIQUE, scopes TEXT NOT NULL, lifts TEXT NOT NULL,
    maker TEXT, created REAL NOT NULL, expires REAL, revoked REAL) STRICT;
CREATE TABLE IF NOT EXISTS selections (
    id TEXT PRIMARY KEY, lift TEXT NOT NULL REFERENCES lifts (id) ON DELETE CASCADE, name TEXT NOT NULL,
    version INTEGER NOT NULL, step INTEGER NOT NULL, created REAL NOT NULL, changed REAL NOT NULL) STRICT;
CREATE INDEX IF NOT EXISTS selections_of_lift ON selections (lift);
CREATE TABLE IF NOT EXISTS steps (
    selection TEXT NOT NULL REFERENCES selections (id) ON DELETE CASCADE, number INTEGER NOT NULL,
    count INTEGER NOT NULL, box TEXT, bits BLOB NOT NULL, PRIMARY KEY (selection, number)) STRICT;
CREATE TABLE IF NOT EXISTS objects (
    lift TEXT NOT NULL REFERENCES lifts (id) ON DELETE CASCADE, id INTEGER NOT NULL, name TEXT,
    hidden INTEGER NOT NULL DEFAULT 0, PRIMARY KEY (lift, id)) STRICT;
"""
MAX_ATTEMPTS = 3  # that count against a job
BUSY_SECONDS = 10.0  # that a write waits for another process
RESERVE_BYTES = 1 << 20  # of a file that is given free on a full disk: a delete writes before it makes room
JSON_COLUMNS = frozenset(
    ("counts", "warnings", "features", "settings", "parameters", "plan", "progress", "problem", "world", "metadata",
     "document", "lifts", "box")
)  # fmt: skip
# Whose records count: those of others are absent. A key with shared lifts sees these, too.
VISIBLE = "(:admin OR owner = :owner OR id IN (SELECT value FROM json_each(:lifts)))"
VALID = "revoked IS NULL AND (expires IS NULL OR expires > :now)"
LIFTS = (
    "SELECT * FROM (SELECT lifts.*, owner, splats, cameras, features, parameters, ended AS created"
    " FROM lifts JOIN jobs USING (id))"
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Owner:
    """Owner of records, by the id of a key; new records belong to it."""

    owner: str
    admin: bool = False  # True: sees the records of all owners
    lifts: str = "[]"  # JSON: the lifts that are shared with the key


SERVICE = Owner("", admin=True)  # the service itself, and every caller while there are no keys


class Store:
    """All records and files of a data directory.

    ``blobs/`` has assets by digest, ``lifts/`` lifts by job, ``work/`` checkpoints of jobs, ``tmp/`` drafts.
    New work must leave so many bytes of free disk.
    """

    def __init__(self, root: Path, floor_bytes: int = 0) -> None:
        os.umask(0o077)  # of this process and its children: nobody else may read the data
        self.root, self._floor_bytes = root.resolve(), floor_bytes
        self.root.mkdir(parents=True, exist_ok=True)
        self.root.chmod(0o700)
        self._held = (self.root / "lock").open("w")
        try:
            fcntl.flock(self._held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._held.close()
            expected, hint = (
                "a directory that no other server uses",
                "stop the other server, or name another directory",
            )
            raise Misconfigured("data", expected=expected, got=str(root), hint=hint) from None
        shutil.rmtree(self.root / "tmp", ignore_errors=True)  # drafts were never acknowledged
        self.make_folders()
        self._write_lock, self._blobs_lock, self._local = threading.RLock(), threading.Lock(), threading.local()
        self._readers: list[sqlite3.Connection] = []
        try:
            self._writer = connect(self.root / DATABASE)
            self._identity = self._identify()
            self._put_back()
            with self._room_to_delete():
                pass
            if unnamed := self.unnamed_files():
                log.warning("%d files have no row: splatlift store clean removes them", len(unnamed))
        except BaseException:
            self._held.close()
            raise

    def close(self) -> None:
        """Release the directory."""
        with self._write_lock:
            for connection in (*self._readers, self._writer):
                connection.close()
        self._held.close()

    def make_folders(self) -> None:
        """Make the folders that are missing: an operator may tidy up while the server runs."""
        for name in ("blobs", "lifts", "work", "tmp"):
            (self.root / name).mkdir(exist_ok=True)

    def _identify(self) -> tuple[int, int]:
        status = (self.root / DATABASE).stat()
        return status.st_dev, status.st_ino

    def require_usable(self) -> None:
        """Require that the database is the file that was opened and can be written, and that the disk has room."""
        if self._identify() != self._identity:
            raise sqlite3.OperationalError("another file is in the place of the database")
        self.require_room()
        with self.write() as connection:
            connection.execute(f"PRAGMA user_version = {VERSION}")

    @contextmanager
    def write(self) -> Iterator[sqlite3.Connection]:
        """Run one transaction: on the disk at the end of the block, undone by an exception."""
        if not self._write_lock.acquire(timeout=BUSY_SECONDS):
            raise sqlite3.OperationalError("the database is busy")
        try:
            self._writer.execute("BEGIN IMMEDIATE")
            self._local.writer = self._writer
            try:
                yield self._writer
                self._writer.execute("COMMIT")
            except BaseException:
                if self._writer.in_transaction:  # on a full disk SQLite rolls back by itself
                    self._writer.execute("ROLLBACK")
                raise
            finally:
                self._local.writer = None
        finally:
            self._write_lock.release()

    def rows(self, query: str, **terms: Any) -> list[dict[str, Any]]:
        """Return rows with their JSON parsed and their files below the root; a reader never waits for the writer."""
        with self._reader() as connection:
            rows = [dict(row) for row in connection.execute(query, terms).fetchall()]
        for row in rows:
            row.update({name: json.loads(row[name]) for name in JSON_COLUMNS & row.keys() if row[name] is not None})
            row.update({"file": self.root / row["file"]} if "file" in row else {})
        return rows

    @contextmanager
    def _reader(self) -> Iterator[sqlite3.Connection]:
        """Yield the writer within its transaction, else a reader that no other thread uses; threads come and go."""
        if writer := getattr(self._local, "writer", None):
            yield writer
            return
        try:
            reader = self._readers.pop()
        except IndexError:
            reader = connect(self.root / DATABASE, "rw")
        try:
            yield reader
        finally:
            self._readers.append(reader)

    def page(
        self, table: str, owner: Owner, limit: int, cursor: str | None
    ) -> tuple[list[dict[str, Any]], str | None]:
        """Return so many records after a cursor, newest first, and the cursor of the next page; None at the end."""
        created, _, after = ("inf", "", "") if cursor is None else cursor.partition("~")
        select = f"{LIFTS if table == 'lifts' else f'SELECT * FROM {table}'} WHERE {VISIBLE}"
        if table == "assets":  # without names of views, which may be a hundred thousand
            counts = "json_remove(counts, '$.names', '$.words') AS counts"
            select = f"SELECT id, kind, bytes, file, {counts}, warnings, min(created) AS created" + (
                f" FROM assets WHERE {VISIBLE} GROUP BY id"
            )
        rows = self.rows(
            f"SELECT * FROM ({select}) WHERE created <= :created AND (created < :created OR id > :after)"
            " ORDER BY created DESC, id LIMIT :most",
            **vars(owner), created=float(created), after=after, most=limit + 1,
        )  # fmt: skip
        last = rows[limit - 1] if len(rows) > limit else None
        return rows[:limit], None if last is None else f"{last['created']!r}~{last['id']}"

    # Files

    def free_bytes(self) -> int:
        """Return the free disk below the data."""
        return shutil.disk_usage(self.root).free

    def require_room(self, coming: int = 0) -> None:
        """Require free disk for new work, of which so many bytes are known."""
        free = self.free_bytes()
        if free - coming < self._floor_bytes:
            raise NoSpace(
                "data", expected=f"{self._floor_bytes + coming} bytes of free disk", got=str(free),
                hint="delete assets, or jobs with their lifts, or ask the operator for room",
            )  # fmt: skip

    @contextmanager
    def _room_to_delete(self) -> Iterator[None]:
        """Give the reserve free if the disk is full; make it again once there is room."""
        reserve = self.root / "reserve"
        if self.free_bytes() < RESERVE_BYTES:
            reserve.unlink(missing_ok=True)
        try:
            yield
        finally:
            if not reserve.exists() and self.free_bytes() > 2 * RESERVE_BYTES:
                reserve.write_bytes(bytes(RESERVE_BYTES))

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """Yield a folder for drafts, which is removed with its content."""
        self.make_folders()
        folder = self.root / "tmp" / secrets.token_hex(16)
        folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def work(self, job: str) -> Path:
        """Return the folder for a job's checkpoint."""
        return self.root / "work" / job

    def unnamed_files(self) -> list[Path]:
        """Return the files that no row names, as a crash between a file and its row leaves them."""
        names = {row["file"] for row in self.rows("SELECT file FROM assets UNION SELECT file FROM lifts")}
        jobs = {row["id"] for row in self.rows("SELECT id FROM jobs WHERE ended IS NULL")}
        files = [path for name in ("blobs", "lifts") for path in (self.root / name).iterdir() if path not in names]
        return files + [folder for folder in (self.root / "work").iterdir() if folder.name not in jobs]

    # Assets

    def add_asset(self, owner: Owner, kind: str, draft: Path, sha256: str, content: dict[str, Any]) -> Asset:
        """Store an upload, with what its check returned."""
        size, path = draft.stat().st_size, self.root / "blobs" / f"{sha256}{content['suffix']}"
        sync(draft)
        with self._blobs_lock:  # else the deletion of the same bytes might take the new file
            present = self.find_asset(owner, f"sha256:{sha256}")
            if present is not None and present.kind != kind:
                hint = f"delete that asset, or upload a file of the {kind} alone"
                raise Conflict(
                    "asset", expected="bytes of one kind", got=f"{kind}, here as {present.kind}", hint=hint
                )
            draft.replace(path)
            sync(path.parent)
            row = (f"sha256:{sha256}", owner.owner, kind, size, f"blobs/{path.name}", json.dumps(content["counts"]),
                   json.dumps(content["warnings"]), time.time())  # fmt: skip
            with self.write() as connection:
                connection.execute("INSERT OR IGNORE INTO assets VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
        return self.asset(owner, f"sha256:{sha256}")

    def find_asset(self, owner: Owner, asset: str) -> Asset | None:
        """Return the asset of that id; None if there is none."""
        select = f"SELECT * FROM assets WHERE id = :id AND {VISIBLE} ORDER BY created LIMIT 1"
        rows = self.rows(select, id=asset, **vars(owner))
        return Asset(**rows[0]) if rows else None

    def asset(self, owner: Owner, asset: str, kind: str | None = None) -> Asset:
        """Return the asset of that id and kind."""
        record = self.find_asset(owner, asset)
        if record is not None and kind in (None, record.kind):
            return record
        expected = f"the id of an asset{f' of kind {kind}' if kind else ''} that is here"
        got = asset[:80] if record is None else f"{asset}, which is of kind {record.kind}"
        raise NotFound(kind or "asset", expected=expected, got=got, hint="PUT /assets/... first")

    def delete_asset(self, owner: Owner, asset: str) -> None:
        """Remove an asset from its owner, or from all owners for an admin. The bytes go with the last owner."""
        with self._blobs_lock, self._room_to_delete():
            record = self.asset(owner, asset)
            with self.write() as connection:
                users = self.rows(
                    f"SELECT id FROM jobs LEFT JOIN lifts USING (id) WHERE {VISIBLE} AND instr(splats || cameras ||"
                    " features || parameters || coalesce(photos, ''), :asset) LIMIT 4",
                    asset=asset, **vars(owner),
                )  # fmt: skip
                if users:
                    hint = f"jobs that refer to it: {', '.join(row['id'] for row in users)}"
                    raise Conflict("asset", expected="an asset that no job refers to", got=asset, hint=hint)
                connection.execute(f"DELETE FROM assets WHERE id = :id AND {VISIBLE}", {"id": asset, **vars(owner)})
                is_last = not self.rows("SELECT 1 FROM assets WHERE id = :id", id=asset)
            if is_last:
                record.file.unlink(missing_ok=True)

    def own_asset(self, owner: str, asset: str) -> None:
        """Give an asset to the owner of a record that needs it, within a transaction: an admin may have ordered."""
        self._writer.execute(
            "INSERT OR IGNORE INTO assets SELECT id, ?, kind, bytes, file, counts, warnings, created FROM assets"
            " WHERE id = ? LIMIT 1",
            (owner, asset),
        )

    # Jobs

    def submit(
        self, owner: Owner, fields: dict[str, Any], key: str | None = None, max_queued: int = 1_000_000
    ) -> tuple[Job, bool]:
        """Queue a job; it is on the disk when this returns. The same Idempotency-Key and fields are the same job.

        Returns:
            The job, and True if it is new.
        """
        digest = hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()
        with self.write():
            same = "SELECT * FROM jobs WHERE owner = :owner AND idempotency_key = :key"
            if key is not None and (earlier := self.rows(same, owner=owner.owner, key=key)):
                if earlier[0]["digest"] != digest:
                    raise KeyReused(
                        "Idempotency-Key", expected="the order that came with this key before", got="another order",
                        hint=f"the key belongs to /jobs/{earlier[0]['id']}; take a new one",
                    )  # fmt: skip
                return Job(**earlier[0]), False
            queued = self.rows("SELECT count(*) AS count FROM jobs WHERE state = 'queued'")[0]["count"]
            if queued >= max_queued:
                expected = f"fewer than {max_queued} jobs in line"
                raise Busy(fields["kind"], expected=expected, got=str(queued), hint="try again later")
            for asset, kind in assets_of(fields):
                self.asset(owner, asset, kind)
                self.own_asset(owner.owner, asset)
            job = self.insert_job(owner.owner, fields, idempotency_key=key, digest=digest, state="queued")
        return self.job(owner, job), True

    def insert_job(self, owner: str, fields: dict[str, Any], **columns: Any) -> str:
        """Add the row of a job within a transaction; return its id."""
        columns |= {
            "id": secrets.token_hex(16),
            "owner": owner,
            "request_id": REQUEST_ID.get(),
            "created": time.time(),
        }
        columns |= {name: value if isinstance(value, str) else json.dumps(value) for name, value in fields.items()}
        names, places = ", ".join(columns), ", ".join(f":{name}" for name in columns)
        self._writer.execute(f"INSERT INTO jobs ({names}) VALUES ({places})", columns)
        self._move(columns["id"], columns["state"])
        return columns["id"]

    def job(self, owner: Owner, job: str) -> Job:
        """Return the job of that id."""
        rows = self.rows(f"SELECT * FROM jobs WHERE id = :id AND {VISIBLE}", id=job, **vars(owner))
        if not rows:
            raise NotFound("job", expected="the id of a job", got=job[:80])
        return Job(**rows[0])

    def counts_by_state(self) -> dict[str, int]:
        """Return the number of jobs in each state that has any."""
        rows = self.rows("SELECT state, count(*) AS count FROM jobs GROUP BY state")
        return {row["state"]: row["count"] for row in rows}

    def claim(self) -> Job | None:
        """Claim the oldest queued job: a new attempt. Jobs of keys that are no longer valid are canceled."""
        if not self.rows("SELECT 1 FROM jobs WHERE state = 'queued' LIMIT 1"):
            return None
        with self.write():
            invalid = f"owner != '' AND owner NOT IN (SELECT id FROM keys WHERE {VALID})"
            for row in self.rows(f"SELECT id FROM jobs WHERE state = 'queued' AND {invalid}", now=time.time()):
                self._move(row["id"], "canceled")
            rows = self.rows("SELECT id, attempt FROM jobs WHERE state = 'queued' ORDER BY created, id LIMIT 1")
            if not rows:
                return None
            values = {"attempt": rows[0]["attempt"] + 1, "started": time.time(), "progress": None}
            self._move(rows[0]["id"], "running", **values)
        return self.job(SERVICE, rows[0]["id"])

    def note(self, job: str, kind: str, data: dict[str, Any]) -> None:
        """Store the ``plan`` or the ``progress`` of a job, and its event in place of the one before."""
        with self.write() as connection:
            connection.execute(f"UPDATE jobs SET {kind} = ? WHERE id = ?", (json.dumps(data), job))
            connection.execute("DELETE FROM events WHERE job = ? AND kind = ?", (job, kind))
            self._add_event(job, kind, data)

    def finish(self, job: Job, result: dict[str, Any], draft: Path) -> None:
        """Store the result and the success of a job together; a job that is being canceled gets none."""
        path = self.root / "lifts" / f"{job.id}.safetensors"
        if job.kind == "lift":
            sync(draft)
        try:
            with self.write() as connection:
                if self.job(SERVICE, job.id).state == "canceling":
                    self._move(job.id, "canceled")
                elif job.kind == "lift":
                    self.insert_lift(job.id, result, draft, path)
                    self._move(job.id, "succeeded")
                else:
                    row = (job.id, json.dumps(result), draft.read_bytes())
                    connection.execute("INSERT INTO tradeoffs VALUES (?, ?, ?)", row)
                    self._move(job.id, "succeeded")
        except BaseException:
            if path.exists() and not draft.exists():  # the next attempt to store it finds the draft again
                path.replace(draft)
            raise

    def insert_lift(self, job: str, result: dict[str, Any], draft: Path, path: Path) -> None:
        """Move a synced lift file to its place and add its row, within a transaction."""
        size = draft.stat().st_size
        draft.replace(path)
        sync(path.parent)
        self._writer.execute(
            "INSERT INTO lifts (id, file, bytes, sha256, count, channels, metadata) VALUES (?, ?, ?, ?, ?, ?, ?)",
            (job, f"lifts/{path.name}", size, result["sha256"], result["count"], result["channels"],
             json.dumps(result["metadata"])),
        )  # fmt: skip

    def end(self, job: Job, problem: dict[str, Any] | None = None, *, retries: bool = False) -> None:
        """End an attempt without a result: the job fails, is put back in line, or is canceled as was asked.

        Without a problem the server is the reason, and the attempt does not count.
        """
        with self.write():
            state = self.job(SERVICE, job.id).state
            if state in FINAL_STATES:  # its result was stored before something failed
                return
            if state == "canceling":
                self._move(job.id, "canceled")
            elif problem is None:
                self._move(job.id, "queued", attempt=job.attempt - 1, progress=None)
            elif retries and job.attempt < MAX_ATTEMPTS:
                self._move(job.id, "queued", progress=None)
            else:
                self._move(job.id, "failed", problem=json.dumps(problem))

    def _put_back(self) -> None:
        """Put jobs that ran when the server ended back in line: the attempt does not count."""
        with self.write():
            for row in self.rows("SELECT * FROM jobs WHERE state IN ('running', 'canceling')"):
                state = "canceled" if row["state"] == "canceling" else "queued"
                self._move(row["id"], state, attempt=row["attempt"] - 1, progress=None)

    def cancel(self, owner: Owner, job: str) -> Job:
        """Cancel a job: a queued one at once, a running one when its processes have ended."""
        with self.write():
            state = self.job(owner, job).state
            if state in ("succeeded", "failed"):
                raise Conflict("job", expected="a job that has not ended", got=f"one that has {state}")
            if state in ("queued", "running"):
                self._move(job, "canceled" if state == "queued" else "canceling")
        return self.job(owner, job)

    def delete_job(self, owner: Owner, job: str, *, with_result: bool) -> None:
        """Delete a job that has ended, with its events and its result."""
        with self._room_to_delete(), self.write() as connection:
            record = self.job(owner, job)
            if record.state not in FINAL_STATES:
                hint, got = f"POST /jobs/{job}/cancel first", f"one that is {record.state}"
                raise Conflict("job", expected="a job that has ended", got=got, hint=hint)
            if record.state == "succeeded" and not with_result:
                hint, got = (
                    f"say with_{record.kind}=true if that is meant",
                    f"one whose {record.kind} would go with it",
                )
                raise Conflict("job", expected=f"a job without a {record.kind}", got=got, hint=hint)
            connection.execute("DELETE FROM jobs WHERE id = ?", (job,))
        (self.root / "lifts" / f"{job}.safetensors").unlink(missing_ok=True)
        self.forget_work(job)

    def forget_work(self, job: str) -> None:
        """Remove the checkpoint of a job."""
        shutil.rmtree(self.work(job), ignore_errors=True)

    def events(self, owner: Owner, job: str, after: int) -> list[dict[str, Any]]:
        """Return ``number``, ``kind`` and ``data`` (JSON text) of the events of a job after a number."""
        self.job(owner, job)
        valid = f"SELECT 1 FROM keys WHERE id = :owner AND {VALID}"
        if owner.owner and not self.rows(valid, owner=owner.owner, now=time.time()):
            raise NotFound("job", expected="the id of a job", got=job)
        select = "SELECT number, kind, data FROM events WHERE job = :job AND number > :after ORDER BY number"
        return self.rows(select, job=job, after=after)

    def _move(self, job: str, state: str, **values: Any) -> None:
        """Set the state and other columns of a job within a transaction, and add the event."""
        values |= {"state": state} | ({"ended": time.time()} if state in FINAL_STATES else {})
        columns = ", ".join(f"{name} = :{name}" for name in values)
        update = f"UPDATE jobs SET {columns} WHERE id = :id RETURNING state, attempt, problem"
        data = dict(self._writer.execute(update, {**values, "id": job}).fetchone())
        self._add_event(job, "state", data | {"problem": json.loads(data["problem"] or "null")})

    def _add_event(self, job: str, kind: str, data: dict[str, Any]) -> None:
        insert = "INSERT INTO events (job, kind, data) VALUES (?, ?, ?)"
        self._writer.execute(insert, (job, kind, json.dumps(data)))

    # Lifts

    def lift(self, owner: Owner, lift: str | None) -> Lift:
        """Return the lift of that id; the newest one without an id."""
        select = f"{LIFTS} WHERE {VISIBLE} AND id = coalesce(:id, id) ORDER BY created DESC, id LIMIT 1"
        rows = self.rows(select, id=lift, **vars(owner))
        if rows:
            return Lift.of_row(rows[0])
        expected, hint = "the id of a lift", "GET /lifts lists them; a lift has the id of its job"
        if lift is None:
            expected, hint = "at least one lift", "POST /lift first"
        raise NotFound("lift", expected=expected, got=(lift or "none")[:80], hint=hint)


def assets_of(fields: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the ids of the assets that a job needs, with the kind that each must have."""
    inputs = [(fields["splats"], "splats"), (fields["cameras"], "cameras")]
    inputs += [(pack, "features") for pack in fields["features"]]
    parameters = fields["parameters"]
    if labels := parameters.get("labels"):
        inputs += [(labels["masks"], "masks"), (labels["table"], "table")]
    return inputs + ([(parameters["table"], "table")] if "table" in parameters else [])


def sync(path: Path) -> None:
    """Flush a file, or a directory with renamed files, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def require_whole(path: Path, size: int) -> None:
    """Require that a file still has its stored size; a pipe in its place would block."""
    with suppress(OSError):
        status = path.stat()
        if stat.S_ISREG(status.st_mode) and status.st_size == size:
            return
    hint = "it was deleted a moment ago, or something else wrote there: upload it again, or lift again"
    expected = f"a file of {size} bytes in the data directory"
    raise NotFound("content", expected=expected, got="none, or one of another size", hint=hint)


def connect(path: Path, mode: str = "rwc") -> sqlite3.Connection:
    """Return a connection to the database; ``rwc`` makes it and its tables in a directory without files."""
    is_new = not (path.exists() and path.stat().st_size)
    if (
        mode == "rwc"
        and is_new
        and any(file for name in ("blobs", "lifts") for file in path.parent.glob(f"{name}/*"))
    ):
        hint = "put its newest backup there, or name another directory with --data"
        expected = f"the {DATABASE} that the files beside it were stored with"
        raise Misconfigured("data", expected=expected, got=f"none in {path.parent}", hint=hint)
    uri = f"{path.absolute().as_uri()}?mode={mode}"
    try:
        connection = sqlite3.connect(
            uri, uri=True, isolation_level=None, check_same_thread=False, timeout=BUSY_SECONDS
        )
        connection.row_factory = sqlite3.Row
        if mode == "ro":
            return connection
        for pragma in ("journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON"):
            connection.execute(f"PRAGMA {pragma}")
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        if version not in (0, VERSION):
            hint = "use the release that wrote it, or another data directory"
            raise Misconfigured("data", expected=f"a database of schema {VERSION}", got=str(version), hint=hint)
        if version == 0:
            connection.executescript(f"{SCHEMA}PRAGMA user_version = {VERSION};")
    except sqlite3.DatabaseError as error:
        if isinstance(error, sqlite3.OperationalError) and mode != "rwc":
            raise
        raise Misconfigured("data", expected="a database of this service", got=f"{path}: {error}") from None
    return connection


# Keys. Each call reads the database, so that changes of the command line count at once.


@contextmanager
def open_keys(root: Path, *, make: bool = False) -> Iterator[sqlite3.Connection]:
    """Yield a connection for changes of keys, also while a server holds the directory."""
    if make:
        root.mkdir(parents=True, exist_ok=True, mode=0o700)
        os.umask(0o077)
    elif not (root / DATABASE).exists():
        raise NotFound("data", expected="the data directory of a service", got=str(root), hint="name it with --data")
    with closing(connect(root / DATABASE)) as connection:
        yield connection


def digest_of(secret: str) -> str:
    """Return the digest of a secret. A secret has 256 random bits: neither digest nor timing helps to guess it."""
    return hashlib.sha256(secret.encode()).hexdigest()


def create_key(
    connection: sqlite3.Connection, name: str, scopes: str, expires: float | None = None,
    lifts: list[str] | None = None, maker: str | None = None,
) -> tuple[Key, str]:  # fmt: skip
    """Create a key; return it and its secret, which is not stored and cannot be read again."""
    key = Key(id=secrets.token_hex(6), name=name, scopes=scopes, lifts=lifts or [], maker=maker, created=time.time(),
              expires=expires, revoked=None)  # fmt: skip
    secret = f"splatlift_{secrets.token_urlsafe(32)}"  # the prefix identifies it, for scanners of leaked secrets
    row = (key.id, name, digest_of(secret), scopes, json.dumps(key.lifts), maker, key.created, expires)
    connection.execute("INSERT INTO keys VALUES (?, ?, ?, ?, ?, ?, ?, ?, NULL)", row)
    return key, secret


def list_keys(connection: sqlite3.Connection) -> list[Key]:
    """Return every key, oldest first, with those that are revoked."""
    return [_key(row) for row in connection.execute("SELECT * FROM keys ORDER BY created, id")]


def revoke_key(connection: sqlite3.Connection, key: str) -> Key:
    """Revoke a key, and the keys with which it shared lifts. What it made stays, for admins."""
    update = "UPDATE keys SET revoked = coalesce(revoked, ?) WHERE id = ? OR maker = ?"
    connection.execute(update, (time.time(), key, key))
    row = connection.execute("SELECT * FROM keys WHERE id = ?", (key,)).fetchone()
    if row is None:
        raise NotFound("key", expected="the id of a key", got=key[:80], hint="keys list shows them")
    return _key(row)


def admit(store: Store, secret: str | None) -> tuple[bool, Key | None]:
    """Return whether requests need a key, and the valid key of a secret.

    From the first key on every request needs one, also once that key is revoked.
    """
    if secret is not None:
        valid = f"SELECT * FROM keys WHERE digest = :digest AND {VALID}"
        if rows := store.rows(valid, digest=digest_of(secret), now=time.time()):
            return True, Key(**rows[0])
    return bool(store.rows("SELECT 1 FROM keys LIMIT 1")), None


def _key(row: sqlite3.Row) -> Key:
    return Key(**{**row, "lifts": json.loads(row["lifts"])})
