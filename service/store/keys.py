"""Keys: who may come in. Only their digests are here; the secrets are with those whom they were given to."""

from __future__ import annotations

import copy
import hashlib
import hmac
import secrets
import sqlite3
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from liftcore.errors import NotFound
from service.scopes import Scope, parse_scopes
from service.store.database import Database, keys_were_made, remember_keys, unusable

PREFIX = "splatlift_"  # by which people, and scanners for leaked secrets, know what it is
SECRET_BYTES = 32

Rule = Literal["required", "none"]  # what the operator says of keys; not said = required once one was made


@dataclass(frozen=True)
class Quota:
    """What one key may fill; None = as the server's settings have it."""

    max_bytes: int | None = None  # of assets and results together
    max_queued: int | None = None  # jobs in line
    max_uploads: int | None = None  # at the same time


@dataclass(frozen=True)
class KeyRecord:
    """A key as the store knows it."""

    id: str
    name: str
    scopes: frozenset[Scope]
    quota: Quota
    created: float  # seconds since 1970
    revoked: float | None


class KeyStore:
    """Keys in the database. Every look is a look at the disk's truth: what another process did counts at once.

    Args:
        database: that holds them.
        data: the data directory, which remembers that there was a key when the database does not.
    """

    _rule: Rule | None = None

    def __init__(self, database: Database, data: Path) -> None:
        self._database = database
        self._data = data

    def under(self, rule: Rule | None) -> Self:
        """The same keys under the operator's word on whether requests need one."""
        ruled = copy.copy(self)
        ruled._rule = rule
        return ruled

    def create(self, name: str, scopes: frozenset[Scope], quota: Quota) -> tuple[KeyRecord, str]:
        """Make a key.

        Returns:
            The key, and its secret, which nobody can ask for again.
        """
        secret = PREFIX + secrets.token_urlsafe(SECRET_BYTES)
        key = KeyRecord(secrets.token_hex(6), name, scopes, quota, time.time(), None)
        remember_keys(self._data)  # first: a key whose database is lost must not leave the door open
        with self._database.write(counted=True) as connection:
            connection.execute(
                "INSERT INTO keys (id, name, digest, scopes, max_bytes, max_queued, max_uploads, created)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                (
                    key.id,
                    name,
                    digest_of(secret),
                    " ".join(sorted(scopes)),
                    quota.max_bytes,
                    quota.max_queued,
                    quota.max_uploads,
                    key.created,
                ),
            )
        return key, secret

    def revoke(self, key: str) -> KeyRecord:
        """End a key for good; again does no harm. What it made stays, for admins.

        Raises:
            NotFound: there is none of that id.
        """
        with self._database.write(counted=True) as connection:
            row = connection.execute(
                "UPDATE keys SET revoked = coalesce(revoked, ?) WHERE id = ? RETURNING *", (time.time(), key)
            ).fetchone()
        if row is None:
            raise NotFound("key", expected="the id of a key", got=key, hint="keys list shows them")
        return _record(row)

    def all(self) -> list[KeyRecord]:
        """Every key, oldest first, with those that were revoked."""
        with self._database.read() as connection:
            rows = connection.execute("SELECT * FROM keys ORDER BY created, id").fetchall()
        return [_record(row) for row in rows]

    def required(self) -> bool:
        """Whether requests need a key: from the first one that was ever made, revoked, lost or not."""
        with self._database.read() as connection:
            return self._required(connection)

    def admit(self, secret: str | None) -> tuple[bool, KeyRecord | None]:
        """Whether requests need a key, and the valid key of that secret."""
        with self._database.read() as connection:
            if secret is None:
                return self._required(connection), None
            digest = digest_of(secret)
            row = connection.execute("SELECT * FROM keys WHERE digest = ? AND revoked IS NULL", (digest,)).fetchone()
            if row is None or not hmac.compare_digest(row["digest"], digest):
                return self._required(connection), None
            return self._rule != "none", _record(row)

    def _required(self, connection: sqlite3.Connection) -> bool:
        if self._rule is not None:
            return self._rule == "required"
        return _any(connection) or keys_were_made(self._data)


def digest_of(secret: str) -> str:
    """What is kept of a secret. It has 256 random bits, so a plain digest gives nothing to guess."""
    return hashlib.sha256(secret.encode()).hexdigest()


def any_key(database: Path) -> bool:
    """Whether a database that nobody has opened yet holds a key; it is left as it is.

    Raises:
        Misconfigured: the file is no database.
    """
    if not database.exists():
        return False
    connection = sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)
    try:
        known = connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'keys'").fetchone()
        return known is not None and _any(connection)
    except sqlite3.DatabaseError as error:
        raise unusable(database, error) from None
    finally:
        connection.close()


def _any(connection: sqlite3.Connection) -> bool:
    return connection.execute("SELECT EXISTS (SELECT 1 FROM keys)").fetchone()[0] == 1


def _record(row: sqlite3.Row) -> KeyRecord:
    return KeyRecord(
        id=row["id"],
        name=row["name"],
        scopes=parse_scopes(row["scopes"].split()),
        quota=Quota(row["max_bytes"], row["max_queued"], row["max_uploads"]),
        created=row["created"],
        revoked=row["revoked"],
    )
