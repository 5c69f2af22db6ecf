"""What a database that is full, or none at all, does to its user: one clear error, and nothing lasting."""

from __future__ import annotations

import fcntl
import sqlite3
import threading
from pathlib import Path

import pytest

from service import __main__ as server
from service.errors import Misconfigured
from service.store.database import DATABASE, Database
from service.store.keys import any_key
from service.store.store import Store


@pytest.mark.parametrize("bytes_of_row", [100_000, 1])
def test_full_database_says_so_and_takes_the_next_write(tmp_path: Path, bytes_of_row: int) -> None:
    database = Database(tmp_path / "small.sqlite")
    with database.write() as connection:
        connection.execute("CREATE TABLE notes (note BLOB)")
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
    with database.write() as connection:
        connection.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(sqlite3.OperationalError) as caught, database.write() as connection:
        for _ in range(100_000):
            connection.execute("INSERT INTO notes VALUES (zeroblob(?))", (bytes_of_row,))
    assert caught.value.sqlite_errorcode == sqlite3.SQLITE_FULL  # which is answered 507
    with database.write() as connection:
        connection.execute("INSERT INTO notes VALUES ('small')")
    with database.read() as connection:
        assert [row["note"] for row in connection.execute("SELECT note FROM notes")] == ["small"]
    database.close()


def test_write_that_cannot_be_committed_is_no_part_of_the_next(tmp_path: Path) -> None:
    database = Database(tmp_path / "strict.sqlite")
    with database.write() as connection:
        connection.execute("CREATE TABLE parents (id INTEGER PRIMARY KEY)")
        connection.execute("CREATE TABLE children (of INTEGER REFERENCES parents (id) DEFERRABLE INITIALLY DEFERRED)")
    with pytest.raises(sqlite3.IntegrityError), database.write() as connection:
        connection.execute("INSERT INTO children VALUES (7)")  # found out by COMMIT
    with database.write() as connection:
        connection.execute("INSERT INTO parents VALUES (1)")
    with database.read() as connection:
        assert connection.execute("SELECT count(*) FROM children").fetchone()[0] == 0
    database.close()


@pytest.fixture
def no_database(tmp_path: Path) -> Path:
    """A data directory whose database is something else."""
    (tmp_path / DATABASE).write_bytes(b"this is a letter to nobody. " * 1000)
    return tmp_path


def test_file_that_is_no_database_is_a_misconfiguration(no_database: Path) -> None:
    for look in (lambda: any_key(no_database / DATABASE), lambda: Store.open(no_database)):
        with pytest.raises(Misconfigured, match="expected a database of this service"):
            look()


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_server_over_no_database_ends_with_one_line(
    no_database: Path, host: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert server.main(["--data", str(no_database), "--host", host, "--port", "0"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("splatlift: data: expected a database") and said.count("\n") <= 2


def test_a_look_at_the_lock_does_not_keep_a_server_from_starting(tmp_path: Path) -> None:
    Store.open(tmp_path).close()
    with (tmp_path / "lock").open("a") as looking:
        fcntl.flock(looking, fcntl.LOCK_SH)
        timer = threading.Timer(0.1, fcntl.flock, (looking, fcntl.LOCK_UN))
        timer.start()
        Store.open(tmp_path).close()
        timer.join()
