"""A disk that is full or only read, and a database that is locked, malformed or gone: said, and nothing half done."""

from __future__ import annotations

import errno
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from fastapi.testclient import TestClient

from liftcore.cli import main
from service.commands import serve
from service.errors import Misconfigured
from service.store import database as databases
from service.store.database import DATABASE, RESERVE, Database
from service.store.keys import any_key
from service.store.owners import SERVICE
from service.store.store import Store, collect

from .conftest import order, until, wait_until_ended
from .server import standing_in


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of three megabytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "none", str(folder)], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip("mounting a small file system takes rights that this user lacks")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(disk: Path) -> Path:
    """The file that takes all the room there is."""
    with (disk / "filler").open("wb", buffering=0) as handle, pytest.raises(OSError, match="space"):
        while True:
            handle.write(b"x" * 4096)
    return disk / "filler"


@contextmanager
def serving(data: Path) -> Iterator[tuple[Store, TestClient, dict[str, Any]]]:
    """The service over a directory, with stand-ins for lifts, and the body of an order that it takes."""
    with closing(Store.open(data)) as store, standing_in(store, "answer") as (client, body):
        yield store, client, body


def test_full_disk_is_507_and_the_service_lives(small_disk: Path) -> None:
    with serving(small_disk / "data") as (store, client, body):
        upload = client.put("/assets/splats", content=b"x" * 4_000_000)
        assert (upload.status_code, upload.json()["type"]) == (507, "/problems/no-space")
        assert not any((small_disk / "data" / "tmp").iterdir())
        filler = fill(small_disk)
        replies = [client.post("/lift", json=body).status_code for _ in range(20)]
        assert replies[-1] == 507 and set(replies) <= {202, 507}
        assert client.get("/healthz").status_code == 200
        assert "disk" in client.get("/readyz").json()["argument"]
        filler.unlink()
        acknowledged = [job["id"] for job in client.get("/jobs").json()["jobs"]]
        assert len(acknowledged) == replies.count(202)
        reply = client.post("/lift", json=body)
        assert reply.status_code == 202
        assert wait_until_ended(store, reply.json()["id"]).state == "succeeded"
        assert {wait_until_ended(store, job).state for job in acknowledged} <= {"succeeded", "failed"}


def test_upload_to_a_disk_that_may_only_be_read_is_503_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving(tmp_path / "data") as (_, client, _):
        read_only = OSError(errno.EROFS, "Read-only file system", "/srv/data/tmp/1")
        monkeypatch.setattr(Path, "open", Mock(side_effect=read_only))
        reply = client.put("/assets/cameras", content=b"{}")
        monkeypatch.undo()
        assert (reply.status_code, reply.json()["type"]) == (503, "/problems/not-ready")
        assert "Read-only file system" in reply.json()["detail"] and "/srv" not in reply.text


def test_delete_works_on_a_full_disk_and_makes_room(small_disk: Path) -> None:
    with serving(small_disk / "data") as (store, client, body):
        job = client.post("/lift", json=body).json()["id"]
        assert wait_until_ended(store, job).state == "succeeded"
        (small_disk / "data" / RESERVE).unlink()
        store.database.keep_reserve()
        fill(small_disk)
        while client.post("/lift", json=body).status_code == 202:  # what room there is in the database's own files
            pass
        for other in client.get("/jobs").json()["jobs"]:
            deleted_job = f"/jobs/{other['id']}"
            if other["state"] not in ("succeeded", "failed", "canceled"):
                assert client.post(f"{deleted_job}/cancel").status_code in (200, 202, 507)
        assert client.delete(f"/jobs/{job}?with_lift=true").status_code == 204
        assert client.get(f"/jobs/{job}").status_code == 404 and not store.files.lift(job).exists()


@pytest.mark.parametrize("existing", [True, False])
@pytest.mark.parametrize("full", [True, False])
def test_start_on_a_full_or_read_only_disk_is_one_line(
    full: bool, existing: bool, small_disk: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if existing:
        Store.open(small_disk / "data").close()
    if full:
        fill(small_disk)
    else:
        subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    monkeypatch.setattr(serve, "server_of", lambda *arguments: pytest.fail("the server started"))
    assert main(["serve", "--data", str(small_disk / "data"), "--port", "0"]) == 2
    stderr = capsys.readouterr().err
    assert stderr.startswith("splatlift: data: expected") and stderr.count("\n") == 1


def malformed(path: Path) -> None:
    path.write_bytes(b"this is a letter to nobody. " * 1000)


def overwritten(path: Path) -> None:
    """All pages but the first two."""
    with path.open("r+b") as file:
        size = path.stat().st_size
        file.seek(8192)
        file.write(b"\xa5" * (size - 8192))


def replaced(path: Path) -> None:
    other = path.with_name("other.sqlite")  # made aside: beside the WAL of the one in use, locks would meet
    Database(other, rebuilding=True).close()
    path.rename(path.with_name("elsewhere"))
    other.rename(path)


@pytest.mark.parametrize("broken", [malformed, Path.unlink, replaced])
def test_readyz_reports_a_broken_database_that_takes_no_order(broken: Callable[[Path], None], tmp_path: Path) -> None:
    with serving(tmp_path / "data") as (store, client, body):
        assert client.get("/healthz").status_code == 200
        with store.database.read() as connection:  # what lies in the WAL alone would still be there
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        broken(tmp_path / "data" / DATABASE)
        for _ in range(3):
            reply = client.post("/lift", json=body)
            assert (reply.status_code, reply.json()["type"]) == (503, "/problems/not-ready"), reply.text
            assert reply.json()["argument"] == "database" and int(reply.headers["retry-after"]) > 0
        ready = client.get("/readyz")
        assert ready.status_code == 503 and "database" in ready.json()["argument"]
        assert client.get("/healthz").status_code == 200
        other_connection = sqlite3.connect(tmp_path / "data" / DATABASE)
        if broken is replaced:
            # Nothing goes to a stranger.
            assert other_connection.execute("SELECT count(*) FROM jobs").fetchone()[0] == 0
        other_connection.close()


def test_readyz_tells_of_pages_that_somebody_overwrote(tmp_path: Path) -> None:
    with serving(tmp_path / "data") as (store, client, _):
        assert client.get("/readyz").status_code == 200
        with store.database.read() as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        overwritten(tmp_path / "data" / DATABASE)
        until(lambda: client.get("/readyz").status_code == 503)
        assert client.get("/readyz").json()["argument"] == "database"


def test_another_database_in_its_place_costs_no_file(tmp_path: Path) -> None:
    store = Store.open(tmp_path)
    asset = store.assets.get(SERVICE, order(store).splats)
    replaced(tmp_path / DATABASE)
    for access in (lambda: collect(store, time.time() + 1), lambda: store.assets.all(SERVICE)):
        with pytest.raises(sqlite3.OperationalError, match="in the place of the database"):
            access()
    assert asset.is_complete
    store.close()


def test_other_process_that_opens_and_closes_the_database_costs_no_commit(tmp_path: Path) -> None:
    store = Store.open(tmp_path)
    before, wal = order(store), (tmp_path / f"{DATABASE}-wal").stat().st_ino
    program = (
        "import sqlite3, sys; c = sqlite3.connect(sys.argv[1]); print(*c.execute('SELECT id FROM jobs')); c.close()"
    )
    command = [sys.executable, "-c", program, str(tmp_path / DATABASE)]
    subprocess.run(command, check=True)
    job = store.jobs.submit(SERVICE, before)[0]
    assert (tmp_path / f"{DATABASE}-wal").stat().st_ino == wal  # it would go with the last one that has it open
    assert job in subprocess.run(command, check=True, capture_output=True, text=True).stdout
    store.close()


def test_lock_that_another_holds_for_long_is_503_with_retry_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(databases, "BUSY_SECONDS", 0.2)
    with serving(tmp_path / "data") as (store, client, body):
        other = sqlite3.connect(tmp_path / "data" / DATABASE, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        for reply in (client.post("/lift", json=body), client.delete(f"/assets/{body['splats']}")):
            assert (reply.status_code, reply.json()["type"]) == (503, "/problems/busy"), reply.text
            assert int(reply.headers["retry-after"]) > 0
        assert client.get("/jobs").status_code == 200  # who reads waits for nobody
        other.execute("ROLLBACK")
        other.close()
        assert wait_until_ended(store, client.post("/lift", json=body).json()["id"]).state == "succeeded"


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


def test_file_that_is_no_database_is_a_misconfiguration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    malformed(tmp_path / DATABASE)
    for access in (lambda: any_key(tmp_path / DATABASE), lambda: Store.open(tmp_path)):
        with pytest.raises(Misconfigured, match="expected a database of this service"):
            access()
    for host in ("127.0.0.1", "0.0.0.0"):
        assert main(["serve", "--data", str(tmp_path), "--host", host, "--port", "0"]) == 2
        stderr = capsys.readouterr().err
        assert stderr.startswith("splatlift: data: expected a database") and stderr.count("\n") <= 2


def test_too_few_files_for_the_connections_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(serve.resource, "getrlimit", lambda resource_id: (256, 256))
    assert main(["serve", "--data", str(tmp_path / "data"), "--port", "0"]) == 2
    stderr = capsys.readouterr().err
    assert "max_connections: expected at most 64" in stderr and "ulimit -n" in stderr and stderr.count("\n") == 1
    assert not (tmp_path / "data").exists()
