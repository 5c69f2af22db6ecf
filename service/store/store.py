"""The store: everything below one data directory; and garbage collection of files that no record refers to and no
running work needs."""

from __future__ import annotations

import logging
import math
import shutil
import sqlite3
import sys
import threading
import time
from collections.abc import Container, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from service.errors import Misconfigured, StaleDatabase
from service.models import FINAL_STATES
from service.settings import ServiceSettings
from service.store.assets import AssetStore
from service.store.database import (
    DATABASE,
    GENERATION,
    Database,
    expected_generation,
    remember_generation,
    remember_keys,
    unusable,
)
from service.store.files import DataDirectory
from service.store.jobs import JobStore
from service.store.keys import KeyStore, any_key
from service.store.lifts import LiftStore, TradeoffStore
from service.store.owners import SERVICE
from service.store.selections import SelectionStore


@dataclass(frozen=True)
class Store:
    """The files and the database of a data directory. Callers name the owner for assets, jobs and results."""

    files: DataDirectory
    database: Database
    keys: KeyStore
    assets: AssetStore
    jobs: JobStore
    lifts: LiftStore
    tradeoffs: TradeoffStore
    selections: SelectionStore

    @classmethod
    def open(cls, root: Path, *, floor_bytes: int = 0, new: bool = False, rebuilding: bool = False) -> Self:
        """Open or create the data directory.

        Args:
            root: the directory.
            floor_bytes: free disk that new work must leave.
            new: if the database is gone or older than the files, move these to quarantine and begin an empty one.
            rebuilding: accept such a database: `splatlift store rebuild` mends it.

        Raises:
            StaleDatabase: the database is gone or older than the files, and neither argument is set.
            Misconfigured: another server holds it, a release of another schema wrote it, its database is none, or it
                is to begin anew and is the right one.
        """
        files = DataDirectory(root, floor_bytes=floor_bytes)
        try:
            database = _database(files, new=new, rebuilding=rebuilding)
        except sqlite3.DatabaseError as error:
            files.close()
            raise unusable(files.root / DATABASE, error) from None
        except BaseException:
            files.close()
            raise
        database.keep_reserve()
        return cls(
            files=files,
            database=database,
            keys=KeyStore(database, files.root),
            assets=AssetStore(database, files),
            jobs=JobStore(database, files),
            lifts=LiftStore(database, files),
            tradeoffs=TradeoffStore(database),
            selections=SelectionStore(database, files),
        )

    def close(self) -> None:
        """Close the database and release the directory."""
        self.database.close()
        self.files.close()


def _database(files: DataDirectory, *, new: bool, rebuilding: bool) -> Database:
    path = files.root / DATABASE
    if rebuilding:  # until `Database.catch_up` it is not the directory's database
        remember_generation(files.root, (expected_generation(files.root) or 0) + 1)
    existed = path.exists()
    try:
        database = Database(path, rebuilding=rebuilding)
        if new and existed:
            database.close()
            raise Misconfigured(
                "--new", expected="a database that is gone or older than its files", got="the right one",
                hint="start without --new, or name another directory with --data",
            )  # fmt: skip
    except StaleDatabase:
        if not new:
            raise
        if any_key(path):  # keys of a release without the marker
            remember_keys(files.root)
        files.begin_anew(DATABASE, GENERATION)
        database = Database(path)
    if any_key(path):
        remember_keys(files.root)
    return database


# Garbage, and jobs that ended long ago

log = logging.getLogger(__name__)


def collect(store: Store, older_than: float) -> list[Path]:
    """Remove the remains of crashes: blobs and lifts without a row, drafts without a writer, unused work.

    Files without a record go to quarantine, as the database may be wrong. Drafts, which were never acknowledged, and
    the work of jobs that have ended are removed.

    Args:
        store: whose files are looked through.
        older_than: seconds since 1970; what was changed later stays.

    Returns:
        The files that were moved or removed.
    """
    files, quarantined = store.files, []
    files.make_folders()
    with (
        files.blobs_changing,
        store.database.read() as connection,
    ):  # so that no upload is between its blob and its row
        recorded = {row["file"] for row in connection.execute("SELECT file FROM assets")}
        quarantined += _lost_paths(files, (files.root / "blobs").glob("*/*"), recorded, older_than)
    with store.database.write() as connection:  # so that no lift is between its file and its row
        rows = connection.execute("SELECT id, file FROM lifts").fetchall()
        recorded = {file for row in rows for file in (row["file"], files.relative(files.lift_changes(row["id"])))}
        quarantined += _lost_paths(files, (files.root / "lifts").iterdir(), recorded, older_than)
    finished, unknown = _unused_work(store)
    quarantined += files.quarantine(path for path in unknown if _changed_at(path) < older_than)
    garbage = [path for path in finished + files.left_over() if _changed_at(path) < older_than]
    for path in garbage:
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    return quarantined + garbage


def _lost_paths(
    files: DataDirectory, paths: Iterable[Path], recorded: Container[str], older_than: float
) -> list[Path]:
    """Move files that have no row to quarantine."""
    garbage = [path for path in paths if files.relative(path) not in recorded and _changed_at(path) < older_than]
    return files.quarantine(garbage)


def empty_quarantine(files: DataDirectory, since_before: float) -> list[Path]:
    """Remove files that were moved to quarantine long ago.

    Args:
        files: whose quarantine it is.
        since_before: seconds since 1970; what was moved later stays.

    Returns:
        The folders that were removed.
    """
    folders = [folder for folder, since in files.quarantined() if since < since_before]
    for folder in folders:
        shutil.rmtree(folder)
    return folders


def _unused_work(store: Store) -> tuple[list[Path], list[Path]]:
    """Return the folders of jobs that have ended, and of unknown jobs."""
    states = {folder: store.jobs.state(SERVICE, folder.name) for folder in (store.files.root / "work").iterdir()}
    finished = [folder for folder, state in states.items() if state in FINAL_STATES]
    return finished, [folder for folder, state in states.items() if state is None]


def _changed_at(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except FileNotFoundError:  # its owner removed it
        return float("inf")


class Collector:
    """Thread that collects garbage at start-up and periodically."""

    def __init__(self, store: Store, settings: ServiceSettings) -> None:
        self._store = store
        self._settings = settings
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="collector", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread; return when it has ended."""
        self._stopping.set()
        self._thread.join()

    def _loop(self) -> None:
        while True:
            try:
                self._collect()
            except Exception:  # an error of today must not stop later collections
                log.exception("the collection of garbage stumbled")
            if self._stopping.wait(self._settings.garbage_seconds):
                return

    def _collect(self) -> None:
        store, settings, now = self._store, self._settings, time.time()
        for path in empty_quarantine(store.files, now - settings.quarantine_seconds):
            log.info("removed %s, whose time in quarantine is over", path)
        before = -math.inf if settings.keep_jobs_seconds is None else now - settings.keep_jobs_seconds
        limit = sys.maxsize if settings.keep_jobs is None else settings.keep_jobs
        if count := store.jobs.forget_ended(before, limit):
            log.info("forgot %d jobs that ended long ago, without a result", count)
        store.database.keep_reserve()
        for path in collect(store, now - settings.garbage_grace_seconds):
            log.info("moved %s away, which nothing refers to", path)
