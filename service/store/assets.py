"""Assets: uploaded files, known by the digest of their bytes."""

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
from service.store.owners import SEEN, SHOWN_ASSETS, Owner, require_quota


@dataclass(frozen=True)
class AssetRecord:
    """An asset as the store knows it."""

    id: str  # sha256:...
    kind: AssetKind
    bytes: int
    path: Path
    counts: dict[str, Any] = field(default_factory=dict)  # what its check found: splats, views, channels and so on
    warnings: list[str] = field(default_factory=list)
    created: float = 0.0  # seconds since 1970

    @property
    def file_name(self) -> str:
        """What its bytes are called where somebody saves them, and in lifts that are made of them."""
        return f"{self.kind}-{self.id.removeprefix('sha256:')[:12]}{self.path.suffix}"

    @property
    def whole(self) -> bool:
        """Whether its bytes are here, all of them: somebody may have been at the data directory."""
        return is_whole(self.path, self.bytes)


@dataclass(frozen=True)
class CheckedUpload:
    """A draft that is whole and valid, ready to become an asset."""

    draft: Path
    kind: UploadKind
    sha256: str
    suffix: str
    counts: dict[str, Any]
    warnings: list[str]


# What several owners have is one file and one row; each has it since its own upload.
VISIBLE = (
    "SELECT assets.*, created FROM (SELECT asset, min(created) AS created"
    f" FROM asset_owners WHERE {SEEN} GROUP BY asset) JOIN assets ON asset = id"
)
ONE_ASSET = VISIBLE.replace(f"{SEEN} GROUP", f"{SHOWN_ASSETS} AND asset = :asset GROUP")


SHOWN_CHARACTERS = 256 << 10  # of counts; of more the names, or words, are told apart, in pages
ALL = sys.maxsize


def _long(kind: UploadKind) -> str:
    """Of counts: what there may be a hundred thousand of, and which has a table of its own."""
    return "words" if kind is AssetKind.TABLE else "names"


class AssetStore:
    """Assets in the database, their bytes in blobs/. What an owner does not see is absent."""

    def __init__(self, database: Database, files: DataDirectory) -> None:
        self._database = database
        self._files = files

    def add(self, owner: Owner, upload: CheckedUpload) -> tuple[AssetRecord, bool]:
        """Keep a checked upload.

        Returns:
            The asset, and whether its owner did not have it before. That somebody else did, nobody learns: the bytes
            take the same way to the disk.

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
            elif not self.get(owner, asset).whole:
                self._publish(connection, asset, upload)
        return self.get(owner, asset, limit=SHOWN_CHARACTERS), row is None

    def _publish(self, connection: sqlite3.Connection, asset: str, upload: CheckedUpload) -> None:
        """The bytes and the row; both may be there, and then the bytes are replaced by equal ones."""
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
        """See that the owner may store more, before bytes are on their way.

        Raises:
            OverQuota: it may not.
        """
        with self._database.read() as connection:
            require_quota(connection, owner, coming)

    def find(self, owner: Owner, asset: str, *, limit: int = 0) -> AssetRecord | None:
        """The asset of that id, None when there is none; its counts with names, or words, if they are of at most so
        many characters."""
        with self._database.read() as connection:
            row = connection.execute(ONE_ASSET, owner.terms(asset=asset)).fetchone()
            if row is None:
                return None
            record = self._record(row)
            if record.kind is not AssetKind.SPLATS and row["counts_bytes"] <= limit:
                record.counts[_long(record.kind)] = _names(connection, asset, 0, -1)
            return record

    def names(self, owner: Owner, asset: str, first: int, limit: int) -> list[str]:
        """So many of the names, or words, that an asset holds, from the one of that number on."""
        self.get(owner, asset)
        with self._database.read() as connection:
            return _names(connection, asset, first, limit)

    def get(self, owner: Owner, asset: str, kind: AssetKind | None = None, *, limit: int = 0) -> AssetRecord:
        """The asset of that id, as `find` has it.

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
        """So many assets after a cursor, newest first, without the names and words that they hold."""
        with self._database.read() as connection:
            return page_of(connection, VISIBLE, owner.terms(), limit, cursor, self._record)

    def all(self, owner: Owner) -> list[AssetRecord]:
        """Every asset, newest first, without the names and words that it holds."""
        return self.page(owner, sys.maxsize - 1).records

    def delete(self, owner: Owner, asset: str) -> None:
        """Take an asset from its owner, or from everybody when it is an admin who asks. Its bytes go with the last.

        Raises:
            NotFound: there is none.
            InUse: a job or a lift of theirs refers to it.
        """
        with self._files.blobs_changing:
            record, terms = self.get(owner, asset), owner.terms(asset=asset)

            def forget(connection: sqlite3.Connection) -> list[Path]:
                users = connection.execute(
                    f"SELECT id FROM jobs WHERE {SEEN} AND (splats = :asset OR cameras = :asset OR EXISTS"
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
                connection.execute(f"DELETE FROM asset_owners WHERE asset = :asset AND {SEEN}", terms)
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
    """The kernel that a lift of those settings takes the splats for."""
    kernel = settings.get("kernel", "auto")
    return splats.counts.get("kernel", "3dgs") if kernel == "auto" else kernel


def _names(connection: sqlite3.Connection, asset: str, first: int, limit: int) -> list[str]:
    rows = connection.execute(
        "SELECT name FROM asset_names WHERE asset = ? AND place >= ? ORDER BY place LIMIT ?", (asset, first, limit)
    )
    return [name for (name,) in rows]


def add_owner(connection: sqlite3.Connection, asset: str, owner: str) -> None:
    """Within a write transaction: let an owner have an asset that is here."""
    insert(connection, "asset_owners", {"asset": asset, "owner": owner, "created": time.time()}, on_conflict="IGNORE")
