"""Keys of callers. Only digests of their secrets are stored."""

from __future__ import annotations

import copy
import hashlib
import json
import secrets
import sqlite3
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, Self

from liftcore.errors import NotFound
from service.errors import InvalidRequest, Unauthorized
from service.store.database import Database, insert, keys_were_made, open_to_read, remember_keys, unusable
from service.store.jobs import stop_waiting
from service.store.owners import INVALID_KEYS, Scope, parse_scopes

PREFIX = "splatlift_"  # identifies a key, for people and for scanners of leaked secrets
SECRET_BYTES = 32

Rule = Literal["required", "none"]  # the operator's rule; unset = required once a key was made


@dataclass(frozen=True)
class Quota:
    """Limits of one key; None = those of the server's settings."""

    max_bytes: int | None = None  # of assets and results together
    max_queued: int | None = None  # jobs in line
    max_uploads: int | None = None  # at the same time


@dataclass(frozen=True)
class KeyRecord:
    """Record of a key."""

    id: str
    name: str
    scopes: frozenset[Scope]
    quota: Quota
    created: float  # seconds since 1970
    revoked: float | None = None
    expires: float | None = None
    lifts: tuple[str, ...] = ()  # of the scope `shared`: the shared lifts
    maker: str | None = None  # the id of the key that shared them; this key ends with it


# With the lifts of each key
KEYS = "SELECT keys.*, (SELECT json_group_array(lift) FROM key_lifts WHERE key = keys.id) AS lifts FROM keys"


class KeyStore:
    """Keys in the database. Every call reads the database: changes of other processes count at once.

    Args:
        database: that holds them.
        data: the data directory, which remembers that there was a key when the database does not.
    """

    _rule: Rule | None = None

    def __init__(self, database: Database, data: Path) -> None:
        self._database = database
        self._data = data

    def under(self, rule: Rule | None) -> Self:
        """Return the same keys under the operator's rule."""
        store = copy.copy(self)
        store._rule = rule
        return store

    def create(
        self,
        name: str,
        scopes: frozenset[Scope],
        quota: Quota,
        *,
        expires: float | None = None,
        lifts: Sequence[str] = (),
        maker: str | None = None,
    ) -> tuple[KeyRecord, str]:
        """Create a key, which is valid until it is revoked or expires (seconds since 1970).

        Args:
            name: for people.
            scopes, quota: what it may do, and fill.
            expires: its end; None = never.
            lifts: shared with the key, whose only scope is then `shared`.
            maker: the secret of the key that shares the lifts, with whose end it ends.

        Returns:
            The key, and its secret, which is not stored and cannot be read again.

        Raises:
            InvalidRequest: it is given lifts without that scope, or has that scope with another, or without lifts.
            NotFound: there is no such lift.
            Unauthorized: the maker's secret does not count, or no longer.
        """
        if (Scope.SHARED in scopes or lifts) and not (scopes == {Scope.SHARED} and lifts):
            got = f"{', '.join(sorted(scopes))} and {len(lifts)} lifts"
            raise InvalidRequest("scopes", expected="shared alone, with the lifts that the key is given", got=got)
        secret = _new_secret()
        remember_keys(self._data)  # first: if the database is lost, the service must still require keys
        with self._database.write(is_counted=True) as connection:
            sharer = None if maker is None else _key_of(connection, maker)
            if maker is not None and sharer is None:  # a rotation ends the keys that the old secret made
                raise Unauthorized(
                    "Authorization", expected="Bearer and a key of this service", got="one that ended a moment ago",
                    headers={"WWW-Authenticate": 'Bearer realm="splatlift", error="invalid_token"'},
                )  # fmt: skip
            key = KeyRecord(
                id=secrets.token_hex(6),
                name=name,
                scopes=scopes,
                quota=quota,
                created=time.time(),
                expires=earliest(expires, sharer and sharer.expires),
                lifts=tuple(sorted(set(lifts))),
                maker=sharer and sharer.id,
            )
            row = {
                "id": key.id,
                "name": name,
                "digest": digest_of(secret),
                "scopes": " ".join(sorted(scopes)),
                **asdict(quota),
                "created": key.created,
                "expires": key.expires,
                "maker": key.maker,
            }
            insert(connection, "keys", row)
            for lift in key.lifts:
                if connection.execute("SELECT 1 FROM lifts WHERE id = ?", (lift,)).fetchone() is None:
                    raise NotFound("lift", expected="the id of a lift", got=lift[:80], hint="GET /lifts lists them")
                connection.execute("INSERT INTO key_lifts VALUES (?, ?)", (key.id, lift))
        return key, secret

    def rotate(
        self, name: str, *, grace: float = 0.0, keep_shares: bool = False
    ) -> tuple[KeyRecord, str, list[KeyRecord]]:
        """Give a key a new secret; its assets and lifts stay its own.

        Args:
            name: its id, or its name if no other valid key has it.
            grace: seconds for which the secret before counts, too. The one before that ends now.
            keep_shares: let keys that it shared lifts with stay. Otherwise each ends with the secret that made it, as
                whoever else has that secret may have made it.

        Returns:
            The key, its new secret, and the keys that end so.

        Raises:
            NotFound: no valid key is called so.
            InvalidRequest: several are.
        """
        secret, now = _new_secret(), time.time()
        with self._database.write(is_counted=True) as connection:
            rows = connection.execute(
                f"{KEYS} WHERE (id = :named OR name = :named) AND id NOT IN ({INVALID_KEYS})",
                {"named": name, "now": now},
            ).fetchall()
            if not rows:
                raise NotFound("key", expected="the id or name of a valid key", got=name, hint="see keys list")
            if len(rows) > 1:
                ids = ", ".join(row["id"] for row in rows)
                raise InvalidRequest("key", expected="a name that one key has", got=name, hint=f"name one of {ids}")
            key, old_until = _record(rows[0]), rows[0]["old_until"]
            shares = [] if keep_shares else _shares_of(connection, key, now)
            for share in shares:  # a key that expires with the old secret, or sooner, may have been made with it
                is_older = old_until is not None and share.expires is not None and share.expires <= old_until
                end = now if is_older else earliest(share.expires, now + grace)
                connection.execute("UPDATE keys SET expires = ? WHERE id = ?", (end, share.id))
            connection.execute(
                "UPDATE keys SET old_digest = digest, old_until = ?, digest = ? WHERE id = ?",
                (now + grace, digest_of(secret), key.id),
            )
        return key, secret, shares

    def revoke(self, key: str) -> tuple[KeyRecord, list[KeyRecord]]:
        """Revoke a key, and the keys that it made to share lifts; repeating it does no harm.

        What it made stays, for admins; its jobs in line are canceled.

        Returns:
            The key, and the valid keys that end with it.

        Raises:
            NotFound: there is none of that id.
        """
        now = time.time()
        with self._database.write(is_counted=True) as connection:
            row = connection.execute(f"{KEYS} WHERE id = ?", (key,)).fetchone()
            if row is None:
                raise NotFound("key", expected="the id of a key", got=key, hint="keys list shows them")
            shares = _shares_of(connection, _record(row), now)
            connection.execute(
                "UPDATE keys SET revoked = coalesce(revoked, ?) WHERE id = ? OR maker = ?", (now, key, key)
            )
            stop_waiting(connection)
            row = connection.execute(f"{KEYS} WHERE id = ?", (key,)).fetchone()
        return _record(row), shares

    def all(self) -> list[KeyRecord]:
        """Return every key, oldest first, with revoked ones."""
        with self._database.read() as connection:
            rows = connection.execute(f"{KEYS} ORDER BY created, id").fetchall()
        return [_record(row) for row in rows]

    def of_lift(self, lift: str) -> list[KeyRecord]:
        """Return the valid keys with which a lift is shared, newest first."""
        holders, terms = "SELECT key FROM key_lifts WHERE lift = :lift", {"lift": lift, "now": time.time()}
        select = f"{KEYS} WHERE id IN ({holders}) AND id NOT IN ({INVALID_KEYS}) ORDER BY created DESC, id"
        with self._database.read() as connection:
            rows = connection.execute(select, terms).fetchall()
        return [_record(row) for row in rows]

    def take_away(self, key: str, lift: str) -> None:
        """Stop sharing a lift with a key; a key without lifts is revoked.

        Raises:
            NotFound: it was not given to that key.
        """
        with self._database.write(is_counted=True) as connection:
            if not connection.execute("DELETE FROM key_lifts WHERE key = ? AND lift = ?", (key, lift)).rowcount:
                hint = "GET /lifts/{lift}/shares lists them"
                raise NotFound("share", expected="the id of a share of the lift", got=key, hint=hint)
            connection.execute(
                "UPDATE keys SET revoked = coalesce(revoked, ?) WHERE id = ?"
                " AND id NOT IN (SELECT key FROM key_lifts)",
                (time.time(), key),
            )

    def required(self) -> bool:
        """Return True if requests need a key: from the first key on, even if it is revoked or lost."""
        with self._database.read() as connection:
            return self._required(connection)

    def admit(self, secret: str | None) -> tuple[bool, KeyRecord | None]:
        """Return whether requests need a key, and the valid key of that secret, which ends with the secret."""
        with self._database.read() as connection:
            if secret is None:
                return self._required(connection), None
            key = _key_of(connection, secret)
            return (self._required(connection) if key is None else self._rule != "none"), key

    def _required(self, connection: sqlite3.Connection) -> bool:
        if self._rule is not None:
            return self._rule == "required"
        return _any(connection) or keys_were_made(self._data)


def _key_of(connection: sqlite3.Connection, secret: str) -> KeyRecord | None:
    """Return the valid key of a secret, which ends with the secret; None if there is none."""
    digest = digest_of(secret)
    row = connection.execute(
        f"{KEYS} WHERE (digest = :digest OR (old_digest = :digest AND old_until > :now))"
        f" AND id NOT IN ({INVALID_KEYS})",
        {"digest": digest, "now": time.time()},
    ).fetchone()
    if row is None:
        return None
    key = _record(row)
    return key if row["digest"] == digest else replace(key, expires=earliest(key.expires, row["old_until"]))


def _new_secret() -> str:
    return PREFIX + secrets.token_urlsafe(SECRET_BYTES)


def digest_of(secret: str) -> str:
    """Return the digest of a secret. A secret has 256 random bits: neither digest nor timing helps to guess it."""
    return hashlib.sha256(secret.encode()).hexdigest()


def any_key(database: Path) -> bool:
    """Return True if a database that is not open holds a key; the database is not changed.

    Raises:
        Misconfigured: the file is no database.
    """
    if not database.exists():
        return False
    connection = open_to_read(database)
    try:
        table = connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'keys'").fetchone()
        return table is not None and _any(connection)
    except sqlite3.DatabaseError as error:
        raise unusable(database, error) from None
    finally:
        connection.close()


def _any(connection: sqlite3.Connection) -> bool:
    return connection.execute("SELECT EXISTS (SELECT 1 FROM keys)").fetchone()[0] == 1


def earliest(*moments: float | None) -> float | None:
    """Return the earliest of times, where None means never."""
    return min((moment for moment in moments if moment is not None), default=None)


def _shares_of(connection: sqlite3.Connection, maker: KeyRecord, now: float) -> list[KeyRecord]:
    """Return the valid keys that a key made to share lifts, oldest first."""
    select = f"{KEYS} WHERE maker = :maker AND id NOT IN ({INVALID_KEYS}) ORDER BY created, id"
    return [_record(row) for row in connection.execute(select, {"maker": maker.id, "now": now})]


def _record(row: sqlite3.Row) -> KeyRecord:
    return KeyRecord(
        id=row["id"],
        name=row["name"],
        scopes=parse_scopes(row["scopes"].split()),
        quota=Quota(row["max_bytes"], row["max_queued"], row["max_uploads"]),
        created=row["created"],
        revoked=row["revoked"],
        expires=row["expires"],
        lifts=tuple(json.loads(row["lifts"])),
        maker=row["maker"],
    )
