"""Keys: who may come in. Only their digests are here; the secrets are with those whom they were given to."""

from __future__ import annotations

import copy
import hashlib
import secrets
import sqlite3
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from liftcore.errors import NotFound
from service.errors import InvalidRequest
from service.store.database import Database, insert, keys_were_made, open_to_read, remember_keys, unusable
from service.store.jobs import stop_waiting
from service.store.owners import ENDED_KEYS, Scope, parse_scopes

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
    revoked: float | None = None
    expires: float | None = None


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

    def create(
        self, name: str, scopes: frozenset[Scope], quota: Quota, *, expires: float | None = None
    ) -> tuple[KeyRecord, str]:
        """Make a key, which is valid until it is revoked or expires (seconds since 1970).

        Returns:
            The key, and its secret, which nobody can ask for again.
        """
        secret = _new_secret()
        key = KeyRecord(secrets.token_hex(6), name, scopes, quota, time.time(), expires=expires)
        row = {
            "id": key.id,
            "name": name,
            "digest": digest_of(secret),
            "scopes": " ".join(sorted(scopes)),
            "max_bytes": quota.max_bytes,
            "max_queued": quota.max_queued,
            "max_uploads": quota.max_uploads,
            "created": key.created,
            "expires": expires,
        }
        remember_keys(self._data)  # first: a key whose database is lost must not leave the door open
        with self._database.write(counted=True) as connection:
            insert(connection, "keys", row)
        return key, secret

    def rotate(self, named: str, *, grace: float = 0.0) -> tuple[KeyRecord, str]:
        """Give a key a new secret; what it made stays its own.

        Args:
            named: its id, or its name where no other valid key has it.
            grace: seconds for which the secret before counts, too. The one before that ends now.

        Returns:
            The key, and its new secret.

        Raises:
            NotFound: no valid key is called so.
            InvalidRequest: several are.
        """
        secret, now = _new_secret(), time.time()
        with self._database.write(counted=True) as connection:
            found = connection.execute(
                f"SELECT id FROM keys WHERE (id = :named OR name = :named) AND id NOT IN ({ENDED_KEYS})",
                {"named": named, "now": now},
            ).fetchall()
            if not found:
                raise NotFound("key", expected="the id or name of a valid key", got=named, hint="see keys list")
            if len(found) > 1:
                ids = ", ".join(row["id"] for row in found)
                raise InvalidRequest("key", expected="a name that one key has", got=named, hint=f"name one of {ids}")
            row = connection.execute(
                "UPDATE keys SET old_digest = digest, old_until = ?, digest = ? WHERE id = ? RETURNING *",
                (now + grace, digest_of(secret), found[0]["id"]),
            ).fetchone()
        return _record(row), secret

    def revoke(self, key: str) -> KeyRecord:
        """End a key for good; again does no harm. What it made stays, for admins; its jobs in line are canceled.

        Raises:
            NotFound: there is none of that id.
        """
        with self._database.write(counted=True) as connection:
            row = connection.execute(
                "UPDATE keys SET revoked = coalesce(revoked, ?) WHERE id = ? RETURNING *", (time.time(), key)
            ).fetchone()
            if row is None:
                raise NotFound("key", expected="the id of a key", got=key, hint="keys list shows them")
            stop_waiting(connection)
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
            row = connection.execute(
                "SELECT * FROM keys WHERE (digest = :digest OR (old_digest = :digest AND old_until > :now))"
                f" AND id NOT IN ({ENDED_KEYS})",
                {"digest": digest_of(secret), "now": time.time()},
            ).fetchone()
            if row is None:
                return self._required(connection), None
            return self._rule != "none", _record(row)

    def _required(self, connection: sqlite3.Connection) -> bool:
        if self._rule is not None:
            return self._rule == "required"
        return _any(connection) or keys_were_made(self._data)


def _new_secret() -> str:
    return PREFIX + secrets.token_urlsafe(SECRET_BYTES)


def digest_of(secret: str) -> str:
    """What is kept and compared of a secret. It has 256 random bits: neither the digest nor the time that it takes to
    compare two gives anything to guess.
    """
    return hashlib.sha256(secret.encode()).hexdigest()


def any_key(database: Path) -> bool:
    """Whether a database that nobody has opened yet holds a key; it is left as it is.

    Raises:
        Misconfigured: the file is no database.
    """
    if not database.exists():
        return False
    connection = open_to_read(database)
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
        expires=row["expires"],
    )
