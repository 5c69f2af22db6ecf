"""The store: everything below one data directory."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from service.errors import Misconfigured, StaleDatabase
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


@dataclass(frozen=True)
class Store:
    """The files and the database of a data directory. Who asks for assets, jobs or results says for which owner."""

    files: DataDirectory
    database: Database
    keys: KeyStore
    assets: AssetStore
    jobs: JobStore
    lifts: LiftStore
    tradeoffs: TradeoffStore

    @classmethod
    def open(cls, root: Path, *, floor_bytes: int = 0, new: bool = False, rebuilding: bool = False) -> Self:
        """Open or make the data directory.

        Args:
            root: the directory.
            floor_bytes: free disk that new work must leave.
            new: where the database is gone or older than the files, move these to quarantine and begin an empty one.
            rebuilding: let it be so: `splatlift store rebuild` mends it.

        Raises:
            StaleDatabase: it is so, and neither was asked for.
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
        )

    def close(self) -> None:
        """Close the database and let the directory go."""
        self.database.close()
        self.files.close()


def _database(files: DataDirectory, *, new: bool, rebuilding: bool) -> Database:
    path = files.root / DATABASE
    if rebuilding:  # until `Database.catch_up` it is not the one that belongs here
        remember_generation(files.root, (expected_generation(files.root) or 0) + 1)
    known = path.exists()
    try:
        database = Database(path, rebuilding=rebuilding)
        if new and known:
            database.close()
            raise Misconfigured(
                "--new", expected="a database that is gone or older than its files", got="the right one",
                hint="start without --new, or name another directory with --data",
            )  # fmt: skip
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
