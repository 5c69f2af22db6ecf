"""The store: everything below one data directory."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from service.errors import StaleDatabase
from service.store.assets import AssetStore
from service.store.attempts import AttemptStore
from service.store.database import Database, unusable
from service.store.events import EventStore
from service.store.files import DataDirectory
from service.store.jobs import JobStore
from service.store.keys import KeyStore, any_key
from service.store.lifts import LiftStore
from service.store.markers import GENERATION, expected_generation, remember_generation, remember_keys
from service.store.owners import Owner
from service.store.tradeoffs import TradeoffStore

DATABASE = "service.sqlite"  # in the data directory


@dataclass(frozen=True)
class Store:
    """Assets, jobs, their results and keys, with the files and the database that hold them."""

    files: DataDirectory
    database: Database
    assets: AssetStore
    jobs: JobStore
    attempts: AttemptStore
    events: EventStore
    lifts: LiftStore
    tradeoffs: TradeoffStore
    keys: KeyStore

    @classmethod
    def open(cls, root: Path, *, floor_bytes: int = 0, new: bool = False, rebuilding: bool = False) -> Self:
        """Open or make the data directory.

        Args:
            root: the directory.
            floor_bytes: free disk that new work must leave.
            new: where the database is gone or older than the files, move these to quarantine and begin an empty one.
            rebuilding: let it be so: `service.store.rebuild` mends it.

        Raises:
            StaleDatabase: it is so, and neither was asked for.
            Misconfigured: another server holds it, a later release wrote it, or its database is none.
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
        return cls(
            files=files,
            database=database,
            assets=AssetStore(database, files),
            jobs=JobStore(database, files),
            attempts=AttemptStore(database),
            events=EventStore(database),
            lifts=LiftStore(database, files),
            tradeoffs=TradeoffStore(database),
            keys=KeyStore(database, files.root),
        )

    def seen_by(self, owner: Owner) -> Self:
        """The same store as an owner sees it: what others made is absent."""
        return replace(
            self,
            assets=self.assets.seen_by(owner),
            jobs=self.jobs.seen_by(owner),
            attempts=self.attempts.seen_by(owner),
            events=self.events.seen_by(owner),
            lifts=self.lifts.seen_by(owner),
            tradeoffs=self.tradeoffs.seen_by(owner),
        )

    def close(self) -> None:
        """Close the database and let the directory go."""
        self.database.close()
        self.files.close()


def _database(files: DataDirectory, *, new: bool, rebuilding: bool) -> Database:
    path = files.root / DATABASE
    if rebuilding:  # until `Database.catch_up` it is not the one that belongs here
        remember_generation(files.root, (expected_generation(files.root) or 0) + 1)
    try:
        database = Database(path, rebuilding=rebuilding)
    except StaleDatabase:
        if not new:
            raise
        if any_key(path):  # of a release that did not remember it
            remember_keys(files.root)
        files.begin_anew(DATABASE, GENERATION)
        database = Database(path)
    if any_key(path):
        remember_keys(files.root)
    return database
