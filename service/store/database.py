"""The database: one connection for writes, a few for reads; and marker files that reveal a lost database."""

from __future__ import annotations

import json
import logging
import os
import queue
import re
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from liftcore.files import whole_file
from service.errors import InvalidRequest, Misconfigured, StaleDatabase
from service.store.files import remove, sync_directory

VERSION = 15  # SQLite's user_version
OF_0_4 = 13  # of release 0.4; migrations start there
MIGRATING_RELEASE = "0.4.0"
TABLES_OF_0_4, SINCE_0_4 = (
    Path(__file__).with_name(f"{name}.sql").read_text(encoding="utf-8") for name in ("schema_of_0_4", "since_0_4")
)
# Migrations by the version of the database; a new one has version 0. No release had version 14.
STEPS = {0: TABLES_OF_0_4 + SINCE_0_4, OF_0_4: SINCE_0_4}
DATABASE = "service.sqlite"  # in the data directory; the two files below reveal an empty or older database
GENERATION = "generation"  # number of the newest counted transaction
KEYS_REQUIRED = "keys.required"  # exists once a key was ever made
RESERVE = "reserve"  # space for deletions on a full disk
RESERVE_BYTES = 1 << 20
BUSY_SECONDS = 10.0  # that a write waits for other writes, of any process, and a read for other reads
LOOK_SECONDS = 0.3  # for a check of the pages: enough for about 200 MB
LOOK_STEPS = 1000  # of SQLite's virtual machine, between two checks of the time
READERS = 4  # at once: more threads would only compete with the event loop
CURSOR = r"^[0-9]{1,20}(\.[0-9]{1,20})?(e[+-]?[0-9]{1,2})?~[0-9a-z:]{1,80}$"  # time and id of a page's last record

R = TypeVar("R")
log = logging.getLogger(__name__)


class Database:
    """SQLite in WAL mode: a committed write is on the disk, if the disk reports the truth.

    Args:
        path: the file; made when it is not there.
        rebuilding: True if it may be gone or older than the files beside it.

    Raises:
        StaleDatabase: it is, and may not; then it is left as it was.
        Misconfigured: a release with another schema wrote it.
    """

    def __init__(self, path: Path, *, rebuilding: bool = False) -> None:
        self._path = path
        self._rebuilding = rebuilding  # no transaction counts until `catch_up`
        # Read before the database: a running server may count further meanwhile.
        least = None if rebuilding else expected_generation(path.parent)
        if least is not None:
            require_database(path)
        self._write_lock = threading.Lock()
        self._readers: queue.LifoQueue[sqlite3.Connection | None] = queue.LifoQueue()
        for _ in range(READERS):
            self._readers.put(None)  # opened by the first reader
        self._writer = self._connect("rwc")
        self._identity = _identity(path)
        try:
            self._require_schema(least)
        except BaseException:
            self._writer.close()
            raise

    def _connect(self, mode: str = "rw") -> sqlite3.Connection:
        """Return a connection; only the first may create the file: later ones would hide that it is lost."""
        connection = sqlite3.connect(
            f"{self._path.absolute().as_uri()}?mode={mode}", uri=True,
            isolation_level=None, check_same_thread=False, timeout=BUSY_SECONDS,
        )  # fmt: skip
        connection.row_factory = sqlite3.Row
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")
        return connection

    def _require_schema(self, least: int | None) -> None:
        """Require the schema of this release; create it in an empty database."""
        with self.write() as connection:
            version = connection.execute("PRAGMA user_version").fetchone()[0]
            if version == 0 and least is not None:
                raise StaleDatabase(self._path.parent, "an empty one")
            if version != VERSION and version not in STEPS:
                hint = "use the release that wrote it, or another data directory"
                if version < OF_0_4:
                    hint = f"start a service of release {MIGRATING_RELEASE} over it once, which migrates it"
                expected = f"a database of schema version {VERSION}"
                raise Misconfigured("data", expected=expected, got=f"{version}", hint=hint)
            if version != VERSION:
                for statement in STEPS[version].split(";\n"):  # `executescript` would commit before it begins
                    connection.execute(statement)
                connection.execute(f"PRAGMA user_version = {VERSION}")
            self._require_generation(least)

    def _require_generation(self, least: int | None) -> None:
        generation = self._writer.execute("SELECT number FROM generation").fetchone()[0]
        if least is not None and generation < least:
            raise StaleDatabase(self._path.parent, f"an older one (generation {generation}, not {least})")

    @contextmanager
    def write(self, *, is_counted: bool = False) -> Iterator[sqlite3.Connection]:
        """Run one write transaction: committed at the end of the block, rolled back after an exception.

        Args:
            is_counted: True counts the write in the data directory, so that an older database is noticed.

        Raises:
            sqlite3.OperationalError: busy, full, or the file is no longer the one that was opened.
        """
        if not self._write_lock.acquire(timeout=BUSY_SECONDS):
            raise _error("database is locked", "SQLITE_BUSY")
        try:
            self.require_same_file()
            if is_counted:
                self._require_readable()
            self._writer.execute("BEGIN IMMEDIATE")
            try:
                generation = self._next_generation() if is_counted and not self._rebuilding else None
                yield self._writer
                self._writer.execute("COMMIT")
            except BaseException:
                if self._writer.in_transaction:  # on a full disk SQLite rolls back by itself
                    self._writer.execute("ROLLBACK")
                raise
            self.require_same_file()  # a commit to a removed file would be lost
            if generation is not None:
                self._remember(generation)
        finally:
            self._write_lock.release()

    def write_freeing(self, work: Callable[[sqlite3.Connection], Iterable[Path]]) -> None:
        """Run a counted write transaction that frees space: on a full disk the reserve is given up for it.

        Args:
            work: deletes rows, and returns the files and folders that go after the commit. A crash between leaves
                files that the collection of garbage finds, and never a row without its file.
        """
        try:
            with self.write(is_counted=True) as connection:
                paths = list(work(connection))
        except sqlite3.OperationalError as error:
            if getattr(error, "sqlite_errorcode", 0) & 0xFF not in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR):
                raise
            (self._path.parent / RESERVE).unlink(missing_ok=True)
            with self.write(is_counted=True) as connection:
                paths = list(work(connection))
        for path in paths:
            remove(path)
        self.keep_reserve()

    def keep_reserve(self) -> None:
        """Create the reserve, if the disk has space for it."""
        path = self._path.parent / RESERVE
        if path.exists():
            return
        try:
            with whole_file(path) as handle:
                handle.write(os.urandom(RESERVE_BYTES))  # random bytes, which no file system compresses
        except OSError as error:
            log.warning("there is no room for %s, from which deletions on a full disk live: %s", path, error)

    def require_same_file(self) -> None:
        """Require that the database is the file that was opened: writes to another file would be lost.

        Raises:
            sqlite3.OperationalError: it is gone, or another.
        """
        try:
            is_same = _identity(self._path) == self._identity
        except OSError as error:  # an error of the disk does not prove another file
            is_same = not isinstance(error, FileNotFoundError)
        if not is_same:
            raise _error("another file, or none, is in the place of the database", "SQLITE_READONLY_DBMOVED")

    def _require_readable(self, seconds: float = 0.0) -> None:
        """Require that a new connection would find a database, which an open connection does not notice.

        Args:
            seconds: time to check its pages; 0 = no check.

        Only SQLite may open the file: a process that closes it in any other way gives up all of SQLite's locks on it
        (POSIX), and the next program that closes the database takes the WAL for its own and removes it.
        """
        with closing(open_to_read(self._path)) as connection:
            connection.execute("PRAGMA schema_version").fetchone()
            if seconds:
                deadline = time.monotonic() + seconds
                connection.set_progress_handler(lambda: time.monotonic() > deadline, LOOK_STEPS)
                try:
                    result = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
                except sqlite3.OperationalError as error:
                    result = "ok" if error.sqlite_errorcode == sqlite3.SQLITE_INTERRUPT else str(error)
                if result != "ok":
                    raise _error(f"the database is damaged: {result}", "SQLITE_CORRUPT")

    def _next_generation(self) -> int:
        return self._writer.execute("UPDATE generation SET number = number + 1 RETURNING number").fetchone()[0]

    def _remember(self, generation: int) -> None:
        """Update the marker after the commit, which stands in any case: an old marker only reveals less."""
        try:
            remember_generation(self._path.parent, generation)
        except (OSError, Misconfigured) as error:
            log.warning("the generation of the database is not remembered outside of it: %s", error)

    @contextmanager
    def read(self) -> Iterator[sqlite3.Connection]:
        """Yield a connection for reads; readers never wait for the writer. A thread must not hold two.

        Raises:
            sqlite3.OperationalError: others read for too long, or the file is no longer the one that was opened.
        """
        try:
            connection = self._readers.get(timeout=BUSY_SECONDS)
        except queue.Empty:
            raise _error("others read it", "SQLITE_BUSY") from None
        try:
            self.require_same_file()  # else garbage collection would find every file unreferenced
            connection = connection or self._connect()
            yield connection
        except sqlite3.Error:
            self.require_same_file()  # results of another file do not count
            raise
        finally:
            self._readers.put(connection)

    def catch_up(self) -> None:
        """Declare this the newest database of its directory, after its records were rebuilt."""
        self._rebuilding = False
        with self.write(is_counted=True) as connection:
            expected = expected_generation(self._path.parent)
            connection.execute("UPDATE generation SET number = max(number, ?)", (expected or 0,))

    def prove_usable(self) -> None:
        """Require that the file is the one that was opened, and that new connections can read and write it.

        Raises:
            sqlite3.Error, OSError: it is not so.
        """
        self.require_same_file()
        self._require_readable(LOOK_SECONDS)
        with self.write() as connection:
            version = connection.execute("PRAGMA user_version").fetchone()[0]
            connection.execute(f"PRAGMA user_version = {version}")

    def close(self) -> None:
        """Close every connection."""
        with self._write_lock:
            self._writer.close()
        while not self._readers.empty():
            if (connection := self._readers.get_nowait()) is not None:
                connection.close()


def expected_generation(data: Path) -> int | None:
    """Return the least generation that the database of a data directory must have; None if a new one does no harm.

    Raises:
        Misconfigured: the marker is there and holds no number.
    """
    marker = _marker_version(data)
    if marker is None and (any(data.glob("blobs/*/*")) or any(data.glob("lifts/*"))):
        return 0  # files of a release without the marker
    return marker


def remember_generation(data: Path, number: int) -> None:
    """Store the number of a transaction that is on the disk; a larger one, of another process, stays."""
    if (_marker_version(data) or 0) < number:
        _write(data / GENERATION, f"{number}\n")


def keys_were_made(data: Path) -> bool:
    """Return True if there was ever a key."""
    return (data / KEYS_REQUIRED).exists()


def remember_keys(data: Path) -> None:
    """Record that there is a key."""
    if not keys_were_made(data):
        _write(data / KEYS_REQUIRED, "A key was made for this data directory: without one nobody is let in.\n")


def _marker_version(data: Path) -> int | None:
    path = data / GENERATION
    try:
        return int(path.read_text("ascii"))
    except FileNotFoundError:
        return None
    except ValueError:
        raise Misconfigured(
            "data", expected="a whole number in the file 'generation'", got=f"something else at {path}",
            hint="remove it, if the database is the newest one",
        ) from None  # fmt: skip


def _write(path: Path, text: str) -> None:
    with whole_file(path) as handle:
        handle.write(text.encode())
    sync_directory(path.parent)


def copy_database(source: Path, target: Path) -> None:
    """Copy a database as of its last commit, whole or not at all, while others use it."""
    draft = target.with_name(f".{target.name}.part")
    draft.unlink(missing_ok=True)
    try:
        with closing(open_to_read(source)) as original, closing(sqlite3.connect(draft)) as copy:
            original.backup(copy)
            copy.execute("PRAGMA journal_mode = DELETE")  # to have one file
        with draft.open("rb") as handle:
            os.fsync(handle.fileno())
        draft.replace(target)
        sync_directory(target.parent)
    finally:
        draft.unlink(missing_ok=True)


def require_database(path: Path) -> None:
    """Require that there is a database, or nothing that one belongs to; it is not opened.

    Raises:
        StaleDatabase: it is gone.
    """
    if not path.exists() and expected_generation(path.parent) is not None:
        raise StaleDatabase(path.parent, "none")


def _error(message: str, name: str) -> sqlite3.OperationalError:
    """Return the error that SQLite would give for what it cannot see."""
    error = sqlite3.OperationalError(message)
    error.sqlite_errorcode, error.sqlite_errorname = getattr(sqlite3, name), name
    return error


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino


def open_to_read(path: Path) -> sqlite3.Connection:
    """Return a connection to a database that another process may hold; it creates and changes nothing."""
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)


def unusable(path: Path, error: sqlite3.Error) -> Misconfigured:
    """Return the error for a file that SQLite cannot use: not a database, or locked."""
    if isinstance(error, sqlite3.OperationalError):
        hint = "see that the disk has room, that the file may be written and that nothing else holds it"
    else:
        hint = "name another data directory, or put a backup in its place"
    return Misconfigured("data", expected="a database of this service", got=f"{path}: {error}", hint=hint)


def insert(
    connection: sqlite3.Connection, table: str, values: Mapping[str, Any], *, on_conflict: str = "ABORT"
) -> None:
    """Add a row within a write transaction.

    Args:
        connection: of the transaction.
        table: that gets it.
        values: by column.
        on_conflict: action for a row that exists already: ``ABORT`` or ``IGNORE``.
    """
    columns, places = ", ".join(values), ", ".join("?" * len(values))
    connection.execute(f"INSERT OR {on_conflict} INTO {table} ({columns}) VALUES ({places})", list(values.values()))


def record_of(kind: type[R], row: sqlite3.Row, /, **values: Any) -> R:
    """Return a row as a dataclass, whose fields are columns, or are given."""
    names = [field.name for field in fields(cast("Any", kind))]
    return kind(**{name: values[name] if name in values else row[name] for name in names})


def parsed(text: str | None) -> Any:
    """Return the parsed JSON of a column that may be NULL."""
    return None if text is None else json.loads(text)


@dataclass(frozen=True)
class Page(Generic[R]):
    """Some records of a list, newest first, with the cursor of the next page; None after the last one."""

    records: list[R]
    cursor: str | None


def page_of(
    connection: sqlite3.Connection,
    query: str,
    terms: Mapping[str, Any],
    limit: int,
    cursor: str | None,
    record: Callable[[sqlite3.Row], R],
) -> Page[R]:
    """Return so many records after a cursor, newest first.

    Args:
        connection: to read with.
        query: a SELECT of all records, with columns ``created`` and ``id``.
        terms: for the names in it.
        limit: maximum number of records.
        cursor: of the page before, None for the first one.
        record: a row as a record.

    Raises:
        InvalidRequest: it is no cursor.
    """  # fmt: skip
    if cursor is not None and not re.match(CURSOR, cursor):
        raise InvalidRequest("cursor", expected="the next of a page", got=repr(cursor[:80]))
    created, _, ident = ("inf", "", "") if cursor is None else cursor.partition("~")
    rows = connection.execute(
        f"SELECT * FROM ({query}) WHERE created <= :created AND (created < :created OR id > :after)"
        " ORDER BY created DESC, id LIMIT :most",
        {**terms, "created": float(created), "after": ident, "most": limit + 1},
    ).fetchall()
    last = rows[limit - 1] if len(rows) > limit else None
    following = None if last is None else f"{last['created']!r}~{last['id']}"
    return Page([record(row) for row in rows[:limit]], following)
