"""Assets: uploaded files, identified by the digest of their bytes."""

from __future__ import annotations

import json
import sqlite3
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from liftcore.errors import NotFound
from service.errors import InUse
from service.models import AssetKind, UploadKind
from service.store.database import Database, Page, insert, page_of, record_of
from service.store.files import DataDirectory, is_whole
from service.store.owners import OWNER_CLAUSE, VISIBLE_ASSETS, Owner, require_quota


@dataclass(frozen=True)
class AssetRecord:
    """Record of an asset."""

    id: str  # sha256:...
    kind: AssetKind
    bytes: int
    path: Path
    counts: dict[str, Any] = field(default_factory=dict)  # from its check: splats, views, channels and so on
    warnings: list[str] = field(default_factory=list)
    created: float = 0.0  # seconds since 1970

    @property
    def file_name(self) -> str:
        """File name for downloads, and for lifts that are made of the asset."""
        return f"{self.kind}-{self.id.removeprefix('sha256:')[:12]}{self.path.suffix}"

    @property
    def is_complete(self) -> bool:
        """True if its file is complete: someone may have changed the data directory."""
        return is_whole(self.path, self.bytes)


@dataclass(frozen=True)
class CheckedUpload:
    """A checked draft, ready to become an asset."""

    draft: Path
    kind: UploadKind
    sha256: str
    suffix: str
    counts: dict[str, Any]
    warnings: list[str]


# Several owners of the same bytes share one file and one row; each owner has it since its own upload.
VISIBLE = (
    "SELECT assets.*, created FROM (SELECT asset, min(created) AS created"
    f" FROM asset_owners WHERE {OWNER_CLAUSE} GROUP BY asset) JOIN assets ON asset = id"
)
ONE_ASSET = VISIBLE.replace(f"{OWNER_CLAUSE} GROUP", f"{VISIBLE_ASSETS} AND asset = :asset GROUP")


SHOWN_CHARACTERS = 256 << 10  # of counts; longer lists of names or words are given in pages
ALL = sys.maxsize


def _long(kind: UploadKind) -> str:
    """Part of `counts` that may hold a hundred thousand names, and has a table of its own."""
    return "words" if kind is AssetKind.TABLE else "names"


class AssetStore:
    """Assets in the database, with their bytes in blobs/. Assets of other owners count as absent."""

    def __init__(self, database: Database, files: DataDirectory) -> None:
        self._database = database
        self._files = files

    def add(self, owner: Owner, upload: CheckedUpload) -> tuple[AssetRecord, bool]:
        """Store a checked upload.

        Returns:
            The asset, and True if its owner did not have it before. That another owner had it stays private: the
            bytes are written in either case.

        Raises:
            OverQuota: it would be more than the owner may store.
        """
        asset = f"sha256:{upload.sha256}"
        with self._files.blobs_changing, self._database.write(is_counted=True) as connection:
            row = connection.execute(
                "SELECT 1 FROM asset_owners WHERE asset = ? AND owner = ?", (asset, owner.key)
            ).fetchone()
            if row is None:
                require_quota(connection, owner, upload.draft.stat().st_size)
                self._publish(connection, asset, upload)
                add_owner(connection, asset, owner.key)
            elif not self.get(owner, asset).is_complete:
                self._publish(connection, asset, upload)
        return self.get(owner, asset, limit=SHOWN_CHARACTERS), row is None

    def _publish(self, connection: sqlite3.Connection, asset: str, upload: CheckedUpload) -> None:
        """Store the bytes and the row; if both are there, equal bytes replace the old ones."""
        row = connection.execute("SELECT file FROM assets WHERE id = ?", (asset,)).fetchone()
        path = self._files.blob(upload.sha256, upload.suffix) if row is None else self._files.root / row["file"]
        size, long = upload.draft.stat().st_size, _long(upload.kind)
        self._files.publish(upload.draft, path)
        row = {
            "id": asset,
            "kind": upload.kind,
            "bytes": size,
            "file": self._files.relative(path),
            "counts": json.dumps({name: value for name, value in upload.counts.items() if name != long}),
            "counts_bytes": len(json.dumps(upload.counts)),
            "warnings": json.dumps(upload.warnings),
        }
        insert(connection, "assets", row, on_conflict="IGNORE")
        connection.executemany(
            "INSERT OR IGNORE INTO asset_names (asset, place, name) VALUES (?, ?, ?)",
            ((asset, place, name) for place, name in enumerate(upload.counts.get(long, ()))),
        )

    def require_quota(self, owner: Owner, coming: int = 1) -> None:
        """Require that the owner may store more, before bytes are sent.

        Raises:
            OverQuota: it may not.
        """
        with self._database.read() as connection:
            require_quota(connection, owner, coming)

    def find(self, owner: Owner, asset: str, *, limit: int = 0) -> AssetRecord | None:
        """Return the asset of that id, None if there is none; its counts have up to `limit` characters of names."""
        with self._database.read() as connection:
            row = connection.execute(ONE_ASSET, owner.terms(asset=asset)).fetchone()
            if row is None:
                return None
            record = self._record(row)
            if record.kind is not AssetKind.SPLATS and row["counts_bytes"] <= limit:
                record.counts[_long(record.kind)] = _names(connection, asset, 0, -1)
            return record

    def names(self, owner: Owner, asset: str, first: int, limit: int) -> list[str]:
        """Return names, or words, of an asset from that number on."""
        self.get(owner, asset)
        with self._database.read() as connection:
            return _names(connection, asset, first, limit)

    def get(self, owner: Owner, asset: str, kind: AssetKind | None = None, *, limit: int = 0) -> AssetRecord:
        """Return the asset of that id, as `find` does.

        Raises:
            NotFound: there is none, or it is of another kind.
        """
        record = self.find(owner, asset, limit=limit)
        name = f"{kind or 'asset'}"
        if record is None:
            raise NotFound(name, expected="the id of an asset that is here", got=asset, hint="PUT /assets/... first")
        if kind is not None and record.kind is not kind:
            raise NotFound(name, expected=f"an asset of kind {kind}", got=f"{asset}, which is of kind {record.kind}")
        return record

    def page(self, owner: Owner, limit: int, cursor: str | None = None) -> Page[AssetRecord]:
        """Return so many assets after a cursor, newest first, without their names and words."""
        with self._database.read() as connection:
            return page_of(connection, VISIBLE, owner.terms(), limit, cursor, self._record)

    def all(self, owner: Owner) -> list[AssetRecord]:
        """Return every asset, newest first, without its names and words."""
        return self.page(owner, sys.maxsize - 1).records

    def delete(self, owner: Owner, asset: str) -> None:
        """Remove an asset from its owner, or from all owners for an admin. The bytes go with the last owner.

        Raises:
            NotFound: there is none.
            InUse: a job or a lift of theirs refers to it.
        """
        with self._files.blobs_changing:
            record, terms = self.get(owner, asset), owner.terms(asset=asset)

            def forget(connection: sqlite3.Connection) -> list[Path]:
                users = connection.execute(
                    f"SELECT id FROM jobs WHERE {OWNER_CLAUSE} AND (splats = :asset OR cameras = :asset OR EXISTS"
                    " (SELECT 1 FROM job_features WHERE job = id AND asset = :asset) OR EXISTS"
                    " (SELECT 1 FROM job_labels WHERE job = id AND asset = :asset) OR EXISTS"
                    " (SELECT 1 FROM lifts WHERE lifts.id = jobs.id AND photos = :asset)) LIMIT 4",
                    terms,
                ).fetchall()
                if users:
                    raise InUse(
                        "asset", expected="an asset that no job and no lift refers to", got=asset,
                        hint=f"jobs that refer to it: {', '.join(row['id'] for row in users)}",
                    )  # fmt: skip
                connection.execute(f"DELETE FROM asset_owners WHERE asset = :asset AND {OWNER_CLAUSE}", terms)
                last = connection.execute(
                    "DELETE FROM assets WHERE id = :asset"
                    " AND NOT EXISTS (SELECT 1 FROM asset_owners WHERE asset = :asset) RETURNING id",
                    terms,
                ).fetchall()
                return [record.path] if last else []

            self._database.write_freeing(forget)

    def _record(self, row: sqlite3.Row) -> AssetRecord:
        return record_of(
            AssetRecord,
            row,
            kind=AssetKind(row["kind"]),
            path=self._files.root / row["file"],
            counts=json.loads(row["counts"]),
            warnings=json.loads(row["warnings"]),
        )


def kernel_of(splats: AssetRecord, settings: Mapping[str, Any]) -> str:
    """Return the kernel with which a lift of those settings interprets the splats."""
    kernel = settings.get("kernel", "auto")
    return splats.counts.get("kernel", "3dgs") if kernel == "auto" else kernel


def _names(connection: sqlite3.Connection, asset: str, first: int, limit: int) -> list[str]:
    rows = connection.execute(
        "SELECT name FROM asset_names WHERE asset = ? AND place >= ? ORDER BY place LIMIT ?", (asset, first, limit)
    )
    return [name for (name,) in rows]


def add_owner(connection: sqlite3.Connection, asset: str, owner: str) -> None:
    """Add an owner to an asset, within a write transaction."""
    insert(connection, "asset_owners", {"asset": asset, "owner": owner, "created": time.time()}, on_conflict="IGNORE")
