"""The database: one connection that writes, and a few that read."""

from __future__ import annotations

import queue
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service.errors import Misconfigured
from service.store.schema import MIGRATIONS

MOST_IDLE = 4  # connections kept for the next readers; those of a rush are closed after it


class Database:
    """SQLite in WAL mode: an acknowledged write is on the disk (as far as the disk tells the truth)."""

    def __init__(self, path: Path, *, migrate: bool = True) -> None:
        self._path = path
        self._write_lock = threading.Lock()
        self._idle: queue.LifoQueue[sqlite3.Connection] = queue.LifoQueue()
        self._writer = self._connect()
        try:
            self._migrate(migrate)
        except BaseException:
            self._writer.close()
            raise

    def _connect(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self._path, isolation_level=None, check_same_thread=False, timeout=30)
        connection.row_factory = sqlite3.Row
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")
        return connection

    def _migrate(self, allowed: bool) -> None:
        with self.write() as connection:  # all steps or none
            version = connection.execute("PRAGMA user_version").fetchone()[0]
            if version > len(MIGRATIONS):
                raise Misconfigured(
                    "data", expected=f"a database of schema version {len(MIGRATIONS)} or less", got=f"{version}",
                    hint="use the release that wrote it, or another data directory",
                )  # fmt: skip
            if version < len(MIGRATIONS) and not allowed:
                raise Misconfigured(
                    "data", expected=f"a database of schema version {len(MIGRATIONS)}", got=f"{version}",
                    hint="an older server runs over it: start it again with this release first",
                )  # fmt: skip
            for step in MIGRATIONS[version:]:
                for statement in _statements(step):
                    connection.execute(statement)
            connection.execute(f"PRAGMA user_version = {len(MIGRATIONS)}")

    @contextmanager
    def write(self) -> Iterator[sqlite3.Connection]:
        """One write transaction: committed when the block ends, rolled back when it raises."""
        with self._write_lock:
            self._writer.execute("BEGIN IMMEDIATE")
            try:
                yield self._writer
                self._writer.execute("COMMIT")
            except BaseException:
                if self._writer.in_transaction:  # on a full disk SQLite has rolled back by itself
                    self._writer.execute("ROLLBACK")
                raise

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
            if self._idle.qsize() < MOST_IDLE:
                self._idle.put(connection)
            else:
                connection.close()

    def prove_writable(self) -> None:
        """Write what is there already, as far as the disk.

        Raises:
            sqlite3.Error, OSError: it cannot be written.
        """
        with self.write() as connection:
            version = connection.execute("PRAGMA user_version").fetchone()[0]
            connection.execute(f"PRAGMA user_version = {version}")

    def close(self) -> None:
        """Close every connection."""
        with self._write_lock:
            self._writer.close()
        while not self._idle.empty():
            self._idle.get_nowait().close()


def unusable(path: Path, error: sqlite3.Error) -> Misconfigured:
    """What to say of a file that SQLite does not work with: it is none of its files, or now is not the time."""
    if isinstance(error, sqlite3.OperationalError):
        hint = "see that the disk has room, that the file may be written and that nothing else holds it"
    else:
        hint = "name another data directory, or put a backup in its place"
    return Misconfigured("data", expected="a database of this service", got=f"{path}: {error}", hint=hint)


def _statements(script: str) -> Iterator[str]:
    """The statements of a script, one by one: `executescript` would commit before it begins."""
    statement = ""
    for line in script.splitlines(keepends=True):
        statement += line
        if sqlite3.complete_statement(statement):
            yield statement
            statement = ""
