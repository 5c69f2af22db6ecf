"""The store: a database that is lost, stale or of another release costs no file; garbage is what nothing reaches."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import pytest

from service.commands import serve
from service.models import AssetKind
from service.store.database import DATABASE
from service.store.files import DataDirectory
from service.store.owners import SERVICE
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


def older(data: Path) -> None:
    """A whole backup from before the last upload."""
    shutil.copy(data / DATABASE, data / "backup")
    store = Store.open(data)
    asset_of(store, AssetKind.CAMERAS, {})
    store.close()
    (data / "backup").replace(data / DATABASE)


def test_crash_between_a_file_and_its_row_does_not_keep_the_server_from_starting(data: Path) -> None:
    files = DataDirectory(data)
    with files.draft(".ply") as draft:
        draft.write_bytes(b"published, and the server died before its row")
        files.publish(draft, files.blob("ab" * 32, ".ply"))
    files.close()
    Store.open(data).close()


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


def test_what_a_user_deletes_frees_its_room_at_once(data: Path) -> None:
    store = Store.open(data)
    (asset,) = store.assets.all(SERVICE)
    store.assets.delete(SERVICE, asset.id)
    assert blobs(data) == [] and collect(store, time.time() + 1) == []
    store.close()


# Of another release


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
