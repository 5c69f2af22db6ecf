"""The store: a database that is lost, stale or of another release costs no file; garbage is what nothing reaches."""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from liftcore.cli import main
from service.commands import serve
from service.errors import Misconfigured, StaleDatabase
from service.models import AssetKind, JobKind, JobState
from service.store import database as markers
from service.store.assets import ALL
from service.store.database import DATABASE, STEPS
from service.store.files import DataDirectory
from service.store.keys import Quota
from service.store.owners import SERVICE, Owner, Scope
from service.store.store import Collector, Store, collect, empty_quarantine

from .conftest import Supervising, asset_of, often, order, until, wait_until_ended

DAY = 86_400.0


@pytest.fixture(autouse=True)
def no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """A start that is not refused ends here, and not with the test run."""

    def fail(*arguments: object) -> None:
        raise AssertionError("the server started")

    monkeypatch.setattr(serve, "server_of", fail)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data directory with one asset, and a database beside it that knows of it."""
    store = Store.open(tmp_path / "data")
    asset_of(store, AssetKind.SPLATS, {})
    store.close()
    return tmp_path / "data"


def blobs(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("blobs/*/*") if path.is_file()]


def remove_database(data: Path) -> None:
    (data / DATABASE).unlink()


def gone_under_a_release_without_markers(data: Path) -> None:
    remove_database(data)
    (data / markers.GENERATION).unlink()


def empty(data: Path) -> None:
    (data / DATABASE).write_bytes(b"")


def without_its_wal(data: Path) -> None:
    """A copy of the main file of a server that runs: what it holds has not come from the WAL yet."""
    remove_database(data)
    shutil.rmtree(data / "blobs")
    (data / markers.GENERATION).unlink()
    store = Store.open(data)
    asset_of(store, AssetKind.SPLATS, {})
    shutil.copy(data / DATABASE, data / "copy")
    store.close()
    (data / "copy").replace(data / DATABASE)


def older(data: Path) -> None:
    """A whole backup from before the last upload."""
    shutil.copy(data / DATABASE, data / "backup")
    store = Store.open(data)
    asset_of(store, AssetKind.CAMERAS, {})
    store.close()
    (data / "backup").replace(data / DATABASE)


LOSSES = [remove_database, gone_under_a_release_without_markers, empty, without_its_wal, older]


@pytest.mark.parametrize("lose", LOSSES)
def test_start_over_files_without_their_database_is_refused_in_one_line(
    lose: Callable[[Path], None], data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lose(data)
    before = blobs(data)
    assert before
    for _ in range(2):  # a refused start makes nothing that the next would take for a database
        assert main(["serve", "--data", str(data), "--port", "0"]) == 2
        stderr = capsys.readouterr().err
        assert stderr.startswith("splatlift: data: expected the database that the files beside it were stored with")
        assert "splatlift store rebuild" in stderr and "serve --new" in stderr and stderr.count("\n") == 1
    # Makes no database either.
    assert main(["keys", "create", "--name", "a", "--scopes", "read", "--data", str(data)]) == 2
    assert "splatlift store rebuild" in capsys.readouterr().err
    assert blobs(data) == before


def test_missing_database_is_reported_beyond_loopback_too(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    remove_database(data)
    assert main(["serve", "--data", str(data), "--host", "0.0.0.0", "--port", "0"]) == 2
    assert "splatlift store rebuild" in capsys.readouterr().err


def test_crash_between_a_file_and_its_row_does_not_keep_the_server_from_starting(data: Path) -> None:
    files = DataDirectory(data)
    with files.draft(".ply") as draft:
        draft.write_bytes(b"published, and the server died before its row")
        files.publish(draft, files.blob("ab" * 32, ".ply"))
    files.close()
    Store.open(data).close()


def test_crash_between_a_commit_and_the_marker_does_not_either(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store.open(data)
    monkeypatch.setattr("service.store.database.remember_generation", lambda data, number: None)
    asset_of(store, AssetKind.CAMERAS, {})
    monkeypatch.undo()
    store.close()
    store = Store.open(data)
    assert len(store.assets.all(SERVICE)) == 2
    asset_of(store, AssetKind.FEATURES, {})
    store.close()
    assert (data / markers.GENERATION).read_text() == "3\n"


def test_marker_on_a_full_disk_fails_no_upload(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(data: Path, number: int) -> None:
        raise OSError(28, "No space left on device")

    store = Store.open(data)
    monkeypatch.setattr("service.store.database.remember_generation", full)
    asset = asset_of(store, AssetKind.CAMERAS, {})
    assert store.assets.get(SERVICE, asset).is_complete
    store.close()


def test_first_start_and_one_over_a_directory_without_files_are_not_refused(tmp_path: Path) -> None:
    for _ in range(2):
        Store.open(tmp_path).close()
        (tmp_path / DATABASE).unlink()


def test_new_moves_the_files_to_quarantine_and_begins_an_empty_database(data: Path) -> None:
    remove_database(data)
    (blob,) = blobs(data)
    store = Store.open(data, new=True)
    assert store.assets.all(SERVICE) == [] and blobs(data / "blobs") == []
    (quarantined_blob,) = blobs(data / "quarantine")
    assert quarantined_blob.relative_to(data / "quarantine").parts[1:] == blob.relative_to(data).parts
    asset = asset_of(store, AssetKind.SPLATS, {})
    store.close()
    with pytest.raises(Misconfigured, match="the right one"):
        Store.open(data, new=True)
    store = Store.open(data)  # which was left as it is, and let go
    assert [record.id for record in store.assets.all(SERVICE)] == [asset]
    store.close()


def test_new_keeps_the_database_and_remembers_its_keys(data: Path) -> None:
    store = Store.open(data)
    store.keys.create("a", frozenset({Scope.READ}), Quota())
    store.close()
    (data / markers.KEYS_REQUIRED).unlink()
    (data / markers.GENERATION).write_text("100\n")
    with pytest.raises(StaleDatabase):
        Store.open(data)
    store = Store.open(data, new=True)
    assert store.keys.all() == [] and store.keys.required()
    store.close()
    assert [*data.glob(f"quarantine/*/{DATABASE}")]


def test_folder_that_somebody_removed_is_made_again(data: Path) -> None:
    store = Store.open(data)
    for name in ("tmp", "blobs", "lifts", "work"):
        shutil.rmtree(data / name)
    collect(store, older_than=0)
    asset = asset_of(store, AssetKind.CAMERAS, {})
    with store.files.scratch() as folder:
        assert folder.is_dir() and store.assets.get(SERVICE, asset).is_complete
    store.close()


def test_collector_moves_to_quarantine_and_removes_from_there_after_its_time(data: Path) -> None:
    store = Store.open(data)
    orphans = [store.files.blob("ab" * 32, ".ply"), store.files.lift("0" * 32), store.files.work("1" * 32) / "block"]
    for path in orphans:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(path.name.encode())
        os.utime(path, (1.0, 1.0))
    os.utime(store.files.work("1" * 32), (1.0, 1.0))
    collector = Collector(store, often(quarantine_seconds=DAY))
    collector.start()
    until(lambda: not any(path.exists() for path in orphans))
    collector.stop()
    quarantined = {path.name: path.read_bytes() for path in (data / "quarantine").rglob("*") if path.is_file()}
    assert quarantined == {path.name: path.name.encode() for path in orphans}
    (data / "quarantine" / "an-operator's own folder").mkdir()
    assert empty_quarantine(store.files, time.time() - DAY) == []
    assert empty_quarantine(store.files, time.time() + 2)
    assert [path.name for path in (data / "quarantine").iterdir()] == ["an-operator's own folder"]
    store.close()


def test_quarantine_replaces_nothing(data: Path) -> None:
    store = Store.open(data)
    for content in (b"first", b"second"):
        path = store.files.lift("0" * 32)
        path.write_bytes(content)
        assert collect(store, time.time() + 1) == [path]
    contents = sorted(path.read_bytes() for path in (data / "quarantine").rglob("*.safetensors"))
    assert contents == [b"first", b"second"]
    store.close()


def test_what_a_user_deletes_frees_its_room_at_once(data: Path) -> None:
    store = Store.open(data)
    (asset,) = store.assets.all(SERVICE)
    store.assets.delete(SERVICE, asset.id)
    assert blobs(data) == [] and collect(store, time.time() + 1) == []
    store.close()


def test_marker_never_goes_back(data: Path) -> None:
    for number in (9, 7):  # as a server and `splatlift keys` may come in the other order
        markers.remember_generation(data, number)
    assert markers.expected_generation(data) == 9


def test_marker_that_holds_no_number_is_one_line(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (data / markers.GENERATION).write_text("")
    assert main(["serve", "--data", str(data), "--port", "0"]) == 2
    stderr = capsys.readouterr().err
    assert "expected a whole number in the file 'generation'" in stderr and stderr.count("\n") == 1


# Of another release


@pytest.mark.parametrize(
    ("version", "hint"),
    [(99, "the release that wrote it"), (14, "the release that wrote it"), (12, "release 0.4.0")],
)
def test_database_of_another_schema_is_refused_with_a_way_on(tmp_path: Path, version: int, hint: str) -> None:
    store = Store.open(tmp_path)
    with store.database.read() as connection:
        connection.execute(f"PRAGMA user_version = {version}")
    store.close()
    with pytest.raises(Misconfigured, match=f"{version}.*{hint}"):
        Store.open(tmp_path)
    assert sqlite3.connect(tmp_path / DATABASE).execute("PRAGMA user_version").fetchone() == (version,)


def test_database_of_release_0_4_opens_with_all_that_it_holds(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    old = sqlite3.connect(tmp_path / "data" / DATABASE)
    old.executescript(Path(__file__).with_name("database_of_0_4.sql").read_text())
    old.close()
    store = Store.open(tmp_path / "data")
    assert {job.kind for job in store.jobs.all(SERVICE)} == {JobKind.LIFT}
    assert store.jobs.get(SERVICE, "a").features == ("f",) and store.jobs.get(SERVICE, "a").plan is None
    assert store.assets.get(SERVICE, "c").counts == {"views": 2}
    assert store.assets.get(SERVICE, "c", limit=ALL).counts == {"views": 2, "names": ["w", "v"]}
    assert store.assets.get(SERVICE, "t", limit=ALL).counts == {"channels": 1, "words": ["apple"]}
    assert store.assets.names(SERVICE, "c", 1, 9) == ["v"]
    assert store.lifts.lifted(SERVICE, "d", ["w", "v"]) == {"v"}
    lift = store.lifts.get(SERVICE, "d")
    assert (lift.name, lift.metadata) == ("the desk", {"views": ["v"]})
    assert [key.name for key in store.keys.all()] == ["anna"] and store.keys.required()
    store.jobs.release_all("the server died")
    states = {job.id: job.state for job in store.jobs.all(SERVICE)}
    queued, failed, succeeded = JobState.QUEUED, JobState.FAILED, JobState.SUCCEEDED
    assert states == {"a": queued, "b": queued, "c": failed, "d": succeeded}
    (last,) = store.jobs.events(SERVICE, "c", 0)
    assert last.data["problem"]["kind"] == "crashed"
    asset_of(store, AssetKind.SPLATS, {})
    store.close()
    assert (tmp_path / "data" / markers.GENERATION).read_text() == "8\n"
    Store.open(tmp_path / "data").close()
    Store.open(tmp_path / "new").close()
    assert columns_of(tmp_path / "data" / DATABASE) == columns_of(tmp_path / "new" / DATABASE)


def columns_of(database: Path) -> set[tuple[str, str, str]]:
    """Table, column and type of all that a database has."""
    columns = "SELECT m.name, c.name, c.type FROM sqlite_master m, pragma_table_info(m.name) c WHERE m.type = 'table'"
    with closing(sqlite3.connect(database)) as connection:
        return set(connection.execute(columns))


def test_schema_that_breaks_off_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(STEPS, 0, f"{STEPS[0]};\nCREATE TABLE keys (a);\n")
    with pytest.raises(Misconfigured, match="already exists"):
        Store.open(tmp_path / "data")
    monkeypatch.undo()
    connection = sqlite3.connect(tmp_path / "data" / "service.sqlite")
    assert connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
    connection.close()
    Store.open(tmp_path / "data").close()


# Garbage


HOUR = 3600.0


def old(path: Path) -> Path:
    """The path, made older than any grace."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.is_dir():
        path.write_bytes(b"left behind")
    os.utime(path, (1.0, 1.0))
    return path


def files(store: Store) -> set[str]:
    paths = (path for folder in ("blobs", "lifts", "work", "tmp") for path in (store.files.root / folder).rglob("*"))
    return {str(path.relative_to(store.files.root)) for path in paths if path.is_file()}


def test_what_a_crash_left_goes_and_what_is_needed_stays(store: Store, supervising: Supervising) -> None:
    finished_job, queued = (store.jobs.submit(SERVICE, order(store))[0] for _ in range(2))
    store.jobs.cancel(SERVICE, queued)
    with supervising("answer"):
        wait_until_ended(store, finished_job)
    waiting = store.jobs.submit(SERVICE, order(store))[0]
    needed_files = files(store) | {f"work/{waiting}/000000.safetensors"}
    old(store.files.work(waiting) / "000000.safetensors")
    os.utime(store.files.work(waiting), (1.0, 1.0))
    remains = [
        old(store.files.blob("ab" * 32, ".ply")),  # published, and the server died before its row
        old(store.files.lift("0" * 32)),
        old(store.files.root / "tmp" / "draft.splats"),
    ]
    for job in (finished_job, queued, "1" * 32):  # ended, canceled, deleted
        old(store.files.work(job) / "000000.safetensors")
        remains.append(old(store.files.work(job)))
    assert set(collect(store, time.time() - HOUR)) == set(remains)
    assert files(store) == needed_files
    assert (
        store.assets.get(SERVICE, store.jobs.get(SERVICE, finished_job).splats).path.exists()
        and store.files.lift(finished_job).exists()
    )


def test_nothing_young_and_nothing_in_use_goes(store: Store) -> None:
    store.files.blob("cd" * 32, ".ply").parent.mkdir()
    store.files.blob("cd" * 32, ".ply").write_bytes(b"of this minute")
    with store.files.draft(".splats") as draft, store.files.scratch() as scratch:
        part = draft.with_name(f".{draft.name}.1234.part")  # as a writer keeps it beside its draft
        young = [old(draft), old(part), old(scratch), store.files.blob("cd" * 32, ".ply")]
        assert collect(store, time.time() - HOUR) == []
        assert all(path.exists() for path in young)
    assert not draft.exists() and not part.exists() and not scratch.exists()


def make_ended(store: Store, ages: dict[str, float], owner: Owner = SERVICE) -> dict[str, str]:
    """Jobs that were canceled so many seconds ago, by name."""
    jobs = {name: store.jobs.submit(owner, order(store, owner))[0] for name in ages}
    with store.database.write() as connection:
        for name, job in jobs.items():
            end_time = time.time() - ages[name]
            connection.execute("UPDATE jobs SET state = 'canceled', ended = ? WHERE id = ?", (end_time, job))
    return jobs


@pytest.mark.parametrize(
    ("ages_of_kept", "expected_names"),
    [
        ({}, {"old", "older", "oldest", "another's"}),
        ({"keep_jobs_seconds": 2.5 * HOUR}, {"old", "another's"}),
        ({"keep_jobs": 2}, {"old", "older", "another's"}),
        ({"keep_jobs_seconds": 3.5 * HOUR, "keep_jobs": 1}, {"old", "another's"}),
        ({"keep_jobs": 0}, set()),
    ],
)
def test_ended_jobs_beyond_the_bound_are_forgotten_and_results_never(
    ages_of_kept: dict[str, float], expected_names: set[str], store: Store, supervising: Supervising
) -> None:
    lifted = store.jobs.submit(SERVICE, order(store))[0]
    tradeoff = store.jobs.submit(SERVICE, replace(order(store), kind=JobKind.TRADEOFF))[0]
    with supervising("answer"):
        assert {wait_until_ended(store, job).state for job in (lifted, tradeoff)} == {"succeeded"}
    with store.database.write() as connection:
        connection.execute("UPDATE jobs SET ended = 1, created = 1")
    jobs = make_ended(store, {"old": HOUR, "older": 3 * HOUR, "oldest": 4 * HOUR})
    jobs |= make_ended(store, {"another's": 2 * HOUR}, Owner("a", sees_all=False))
    waiting = store.jobs.submit(SERVICE, order(store))[0]
    with store.database.write() as connection:
        connection.execute("UPDATE jobs SET created = 1 WHERE id = ?", (waiting,))
    collector = Collector(store, often(**ages_of_kept))
    collector.start()
    expected = {lifted, tradeoff, waiting} | {jobs[name] for name in expected_names}
    until(lambda: {job.id for job in store.jobs.all(SERVICE)} == expected)
    collector.stop()
    assert {job.id for job in store.jobs.all(SERVICE)} == expected
    assert store.lifts.get(SERVICE, lifted).path.exists() and store.tradeoffs.get(SERVICE, tradeoff).chart
    with store.database.read() as connection:
        events = {row["job"] for row in connection.execute("SELECT DISTINCT job FROM job_events")}
    assert events == expected


def test_very_many_jobs_are_forgotten_a_few_at_a_time(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.store.jobs.FORGOTTEN_AT_ONCE", 2)
    make_ended(store, {str(number): float(number) for number in range(5)})
    assert store.jobs.forget_ended(0.0, 1) == 4
    assert len(store.jobs.all(SERVICE)) == 1
