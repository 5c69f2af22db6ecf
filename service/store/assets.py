"""Assets: uploaded files, known by the digest of their bytes."""

from __future__ import annotations

import json
import sqlite3
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from liftcore.errors import NotFound
from service.errors import InUse
from service.store.database import Database
from service.store.files import DataDirectory
from service.wire import AssetKind


@dataclass(frozen=True)
class AssetRecord:
    """An asset as the store knows it."""

    id: str  # sha256:...
    kind: AssetKind
    bytes: int
    path: Path
    counts: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    created: float = 0.0  # seconds since 1970


@dataclass(frozen=True)
class CheckedUpload:
    """A draft that is whole and valid, ready to become an asset."""

    draft: Path
    kind: AssetKind
    sha256: str
    suffix: str
    counts: dict[str, Any]
    warnings: list[str]


class AssetStore:
    """Assets in the database, their bytes in blobs/."""

    def __init__(self, database: Database, files: DataDirectory) -> None:
        self._database = database
        self._files = files
        # Held while a blob appears or goes, so that no delete removes the bytes of a new upload.
        self._blobs = threading.Lock()

    def add(self, upload: CheckedUpload) -> tuple[AssetRecord, bool]:
        """Keep a checked upload.

        Returns:
            The asset, and whether it is new.
        """
        asset = f"sha256:{upload.sha256}"
        path = self._files.blob(upload.sha256, upload.suffix)
        size = upload.draft.stat().st_size
        with self._blobs, self._database.write() as connection:
            if connection.execute("SELECT 1 FROM assets WHERE id = ?", (asset,)).fetchone():
                new = False
            else:
                self._files.publish(upload.draft, path)
                connection.execute(
                    "INSERT INTO assets (id, kind, bytes, file, counts, warnings, created) VALUES (?,?,?,?,?,?,?)",
                    (
                        asset,
                        upload.kind,
                        size,
                        self._files.relative(path),
                        json.dumps(upload.counts),
                        json.dumps(upload.warnings),
                        time.time(),
                    ),
                )
                new = True
        return self.get(asset), new

    def find(self, asset: str) -> AssetRecord | None:
        """The asset of that id, None when there is none."""
        with self._database.read() as connection:
            row = connection.execute("SELECT * FROM assets WHERE id = ?", (asset,)).fetchone()
        return None if row is None else self._record(row)

    def get(self, asset: str, kind: AssetKind | None = None) -> AssetRecord:
        """The asset of that id.

        Raises:
            NotFound: there is none, or it is of another kind.
        """
        found = self.find(asset)
        name = f"{kind or 'asset'}"
        if found is None:
            raise NotFound(name, expected="the id of an asset that is here", got=asset, hint="PUT /assets/... first")
        if kind is not None and found.kind is not kind:
            raise NotFound(name, expected=f"an asset of kind {kind}", got=f"{asset}, which is of kind {found.kind}")
        return found

    def all(self) -> list[AssetRecord]:
        """Every asset, newest first."""
        with self._database.read() as connection:
            rows = connection.execute("SELECT * FROM assets ORDER BY created DESC, id").fetchall()
        return [self._record(row) for row in rows]

    def delete(self, asset: str) -> None:
        """Forget an asset and its bytes.

        Raises:
            NotFound: there is none.
            InUse: a job or a lift refers to it.
        """
        with self._blobs:
            found = self.get(asset)
            with self._database.write() as connection:
                users = connection.execute(
                    "SELECT id FROM jobs WHERE splats = :a OR cameras = :a"
                    " UNION SELECT job FROM job_features WHERE asset = :a LIMIT 4",
                    {"a": asset},
                ).fetchall()
                if users:
                    raise InUse(
                        "asset", expected="an asset that no job and no lift refers to", got=asset,
                        hint=f"jobs that refer to it: {', '.join(row['id'] for row in users)}",
                    )  # fmt: skip
                connection.execute("DELETE FROM assets WHERE id = ?", (asset,))
            # After the commit: a crash here leaves bytes that nobody knows of, never an asset without bytes.
            found.path.unlink(missing_ok=True)

    def collect(self, older_than: float) -> list[Path]:
        """Remove bytes that no asset has: what a crash between a blob and its row left.

        Args:
            older_than: seconds since 1970; younger files stay.

        Returns:
            What was removed.
        """
        removed = []
        with self._blobs:  # so no upload is between its blob and its row
            with self._database.read() as connection:
                known = {row["file"] for row in connection.execute("SELECT file FROM assets")}
            for path in (self._files.root / "blobs").glob("*/*"):
                if self._files.relative(path) not in known and path.stat().st_mtime < older_than:
                    path.unlink()
                    removed.append(path)
        return removed

    def _record(self, row: sqlite3.Row) -> AssetRecord:
        return AssetRecord(
            id=row["id"],
            kind=AssetKind(row["kind"]),
            bytes=row["bytes"],
            path=self._files.root / row["file"],
            counts=json.loads(row["counts"]),
            warnings=json.loads(row["warnings"]),
            created=row["created"],
        )
