"""The database: one connection that writes, a few that read, and the schema."""

from __future__ import annotations

import queue
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service.errors import Misconfigured

SCHEMA_VERSION = 1
SCHEMA = """
CREATE TABLE assets (
    id TEXT PRIMARY KEY,            -- sha256:...
    kind TEXT NOT NULL,             -- splats, cameras, features
    bytes INTEGER NOT NULL,
    file TEXT NOT NULL,             -- path below the data directory
    counts TEXT NOT NULL,           -- JSON
    warnings TEXT NOT NULL,         -- JSON
    created REAL NOT NULL
) STRICT;

CREATE TABLE jobs (
    id TEXT PRIMARY KEY,
    state TEXT NOT NULL,            -- queued, running, succeeded, failed
    attempt INTEGER NOT NULL DEFAULT 0,
    released INTEGER NOT NULL DEFAULT 0,  -- attempts that ended with an orderly stop of the server
    splats TEXT NOT NULL REFERENCES assets (id),
    cameras TEXT NOT NULL REFERENCES assets (id),
    settings TEXT NOT NULL,         -- JSON
    progress TEXT,                  -- JSON
    problem TEXT,                   -- JSON: kind, argument, expected, got, hint
    created REAL NOT NULL,
    started REAL,
    ended REAL
) STRICT;
CREATE INDEX jobs_in_line ON jobs (state, created);

CREATE TABLE job_features (
    job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    place INTEGER NOT NULL,
    asset TEXT NOT NULL REFERENCES assets (id),
    PRIMARY KEY (job, place)
) STRICT;
CREATE INDEX job_features_of_asset ON job_features (asset);

CREATE TABLE lifts (
    id TEXT PRIMARY KEY REFERENCES jobs (id),
    bytes INTEGER NOT NULL,
    sha256 TEXT NOT NULL,
    file TEXT NOT NULL,             -- path below the data directory
    count INTEGER NOT NULL,
    channels INTEGER NOT NULL,
    metadata TEXT NOT NULL,         -- JSON, as in the lift file
    created REAL NOT NULL
) STRICT;
"""


class Database:
    """SQLite in WAL mode: an acknowledged write is on the disk (as far as the disk tells the truth)."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._write_lock = threading.Lock()
        self._idle: queue.LifoQueue[sqlite3.Connection] = queue.LifoQueue()
        self._writer = self._connect()
        self._migrate()

    def _connect(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self._path, isolation_level=None, check_same_thread=False, timeout=30)
        connection.row_factory = sqlite3.Row
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")
        return connection

    def _migrate(self) -> None:
        version = self._writer.execute("PRAGMA user_version").fetchone()[0]
        if version == 0:
            self._writer.executescript(f"BEGIN IMMEDIATE; {SCHEMA} PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;")
        elif version != SCHEMA_VERSION:
            raise Misconfigured(
                "data", expected=f"a database of schema version {SCHEMA_VERSION}", got=f"version {version}",
                hint="use the release that wrote it, or another data directory",
            )  # fmt: skip

    @contextmanager
    def write(self) -> Iterator[sqlite3.Connection]:
        """One write transaction: committed when the block ends, rolled back when it raises."""
        with self._write_lock:
            self._writer.execute("BEGIN IMMEDIATE")
            try:
                yield self._writer
            except BaseException:
                self._writer.execute("ROLLBACK")
                raise
            self._writer.execute("COMMIT")

    @contextmanager
    def read(self) -> Iterator[sqlite3.Connection]:
        """A connection to read with; readers never wait for the writer."""
        try:
            connection = self._idle.get_nowait()
        except queue.Empty:
            connection = self._connect()
        try:
            yield connection
        finally:
            self._idle.put(connection)

    def close(self) -> None:
        """Close every connection."""
        with self._write_lock:
            self._writer.close()
        while not self._idle.empty():
            self._idle.get_nowait().close()
