"""A backup is complete, damage is reported, and no other user can read a data directory."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from service.errors import Misconfigured
from service.models import AssetKind, JobState
from service.store import recovery
from service.store.database import KEYS_REQUIRED
from service.store.keys import Quota
from service.store.owners import SERVICE, Scope
from service.store.recovery import back_up, restore, verify
from service.store.store import Store

from .conftest import Supervising, asset_of, order, supervised, until, wait_until_ended


@pytest.fixture
def filled_store(store: Store, supervising: Supervising) -> Store:
    """A store that a server holds, with a lift and a key."""
    job = store.jobs.submit(SERVICE, order(store))[0]
    with supervising("answer"):
        assert wait_until_ended(store, job).state is JobState.SUCCEEDED
    store.keys.create("a", frozenset({Scope.READ}), Quota())
    return store


def files(data: Path) -> dict[str, bytes]:
    paths = (path for folder in ("blobs", "lifts") for path in (data / folder).rglob("*") if path.is_file())
    return {str(path.relative_to(data)): path.read_bytes() for path in paths}


@pytest.mark.parametrize("links", [True, False])
def test_backup_beside_a_server_is_restored_as_it_was(
    filled_store: Store, tmp_path: Path, links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    if not links:
        monkeypatch.setattr(os, "link", refuse)
    assert back_up(filled_store.files.root, tmp_path / "backup") == 4
    assert verify(tmp_path / "backup") == []
    before, jobs = files(filled_store.files.root), filled_store.jobs.all(SERVICE)
    asset_of(filled_store, AssetKind.MASKS, {})  # after it, and none of it
    assert restore(tmp_path / "backup", tmp_path / "again") == 4
    restored = Store.open(tmp_path / "again")  # which is refused where the database is older than the files
    assert files(restored.files.root) == before == files(tmp_path / "backup")
    assert restored.jobs.all(SERVICE) == jobs and restored.keys.required()
    assert (tmp_path / "again" / KEYS_REQUIRED).exists()
    restored.close()


def test_job_that_runs_during_a_backup_ends_in_the_restored(
    store: Store, supervising: Supervising, tmp_path: Path
) -> None:
    job = store.jobs.submit(SERVICE, order(store))[0]
    with supervising("hang"):
        until(lambda: store.jobs.get(SERVICE, job).plan)
        back_up(store.files.root, tmp_path / "backup")
    assert verify(tmp_path / "backup") == []
    restore(tmp_path / "backup", tmp_path / "again")
    restored = Store.open(tmp_path / "again")
    with supervised(restored, "answer"):
        assert wait_until_ended(restored, job).state is JobState.SUCCEEDED
    restored.close()


def test_asset_that_is_deleted_during_a_backup_is_no_loss(
    filled_store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asset, copy = asset_of(filled_store, AssetKind.MASKS, {}), recovery.copy_database

    def copy_then_delete(source: Path, target: Path) -> None:
        copy(source, target)
        if filled_store.assets.find(SERVICE, asset) is not None:
            filled_store.assets.delete(SERVICE, asset)

    monkeypatch.setattr(recovery, "copy_database", copy_then_delete)
    assert back_up(filled_store.files.root, tmp_path / "backup") == 4
    assert verify(tmp_path / "backup") == [] and files(tmp_path / "backup") == files(filled_store.files.root)


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[0] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [(flip, "other bytes"), (cut, "in place of"), (Path.unlink, "No such file"), (pipe, "no regular file")],
)
def test_damaged_file_is_reported_and_not_restored(
    damage: Callable[[Path], None], message: str, filled_store: Store, tmp_path: Path
) -> None:
    back_up(filled_store.files.root, tmp_path / "backup")
    (lift,) = (tmp_path / "backup" / "lifts").iterdir()
    content = lift.read_bytes()
    lift.unlink()  # it is the server's file too
    lift.write_bytes(content)
    damage(lift)
    (line,) = [line for line in verify(tmp_path / "backup") if line.startswith("lifts/")]
    assert message in line
    with pytest.raises(Misconfigured, match="files as they were stored"):
        restore(tmp_path / "backup", tmp_path / "again")
    assert not (tmp_path / "again").exists() and not (tmp_path / ".again.part").exists()
