"""Owners of records, their rights and their quotas."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from service.errors import InvalidRequest, KeyLimitReached, OverQuota

# For WHERE clauses over a table with a column `owner`; `Owner.terms` binds its names.
OWNER_CLAUSE = "(:sees_all OR owner = :owner)"
# The same for reads of jobs and of owners of assets: includes shared lifts (`service.auth` limits the routes).
SHARED_LIFTS = "SELECT lift FROM key_lifts WHERE key = :owner"
SHARED_ASSETS = (
    f"SELECT splats FROM jobs WHERE id IN ({SHARED_LIFTS})"
    f" UNION SELECT cameras FROM jobs WHERE id IN ({SHARED_LIFTS})"
    f" UNION SELECT asset FROM job_features WHERE job IN ({SHARED_LIFTS})"
    f" UNION SELECT photos FROM lifts WHERE id IN ({SHARED_LIFTS})"
    f" UNION SELECT json_extract(parameters, '$.table') FROM jobs WHERE id IN ({SHARED_LIFTS})"
)
VISIBLE_JOBS = f"(:sees_all OR owner = :owner OR jobs.id IN ({SHARED_LIFTS}))"
VISIBLE_ASSETS = f"(:sees_all OR owner = :owner OR asset IN ({SHARED_ASSETS}))"
# Keys that are no longer valid; `:now` in seconds since 1970. NULL means no end.
_INVALID_KEYS = "SELECT id FROM keys WHERE revoked IS NOT NULL OR expires <= :now"
INVALID_KEYS = f"{_INVALID_KEYS} OR maker IN ({_INVALID_KEYS})"
QUEUE_RETRY_SECONDS = 30  # a lift takes seconds to minutes, and one must end before the queue is shorter


class Scope(StrEnum):
    """Kind of request that a key allows."""

    READ = "read"  # read assets, jobs, results, queries, pictures
    WRITE = "write"  # upload, order, cancel, delete
    SHARED = "shared"  # read and query the lifts shared with the key
    METRICS = "metrics"  # read /metrics, which sums the work of all owners, and nothing else
    ADMIN = "admin"  # all of these, on the records of all owners


def parse_scopes(names: Iterable[str]) -> frozenset[Scope]:
    """Return scopes by their names.

    Raises:
        InvalidRequest: there is none, or one is unknown.
    """
    names = [name.strip() for name in names if name.strip()]
    wrong = next((name for name in names if name not in set(Scope)), None if names else "none")
    if wrong is not None:
        raise InvalidRequest("scopes", expected=f"one or more of {', '.join(Scope)}", got=wrong[:80])
    return frozenset(map(Scope, names))


@dataclass(frozen=True)
class Owner:
    """Owner of records, with quotas. Records of other owners count as absent."""

    key: str  # the id of a key: new records belong to it
    sees_all: bool
    max_bytes: int | None = None  # of assets and results together; None = no limit
    max_queued: int | None = None  # jobs in line

    def terms(self, **values: Any) -> dict[str, Any]:
        """Return values to bind to OWNER_CLAUSE, and ``values``."""
        return {"sees_all": self.sees_all, "owner": self.key, **values}


# The service itself, and every caller while there are no keys; its records belong to admins once there are keys.
SERVICE = Owner("", sees_all=True)
NO_OWNER = Owner("-", sees_all=False)  # the id of no key: it owns nothing


def stored_bytes(connection: sqlite3.Connection, owner: Owner) -> int:
    """Return the bytes of an owner's assets, results and selections; shared bytes count for each owner."""
    assets = "SELECT total(bytes) FROM assets JOIN asset_owners ON asset = id WHERE owner = :owner"
    lifts = "SELECT total(lifts.bytes) FROM lifts JOIN jobs USING (id) WHERE owner = :owner"
    tradeoffs = "SELECT total(tradeoffs.bytes) FROM tradeoffs JOIN jobs USING (id) WHERE owner = :owner"
    selections = (
        "SELECT total(length(splats) + length(edit)) FROM selection_steps"
        " JOIN selections ON selections.id = selection"
        " JOIN (SELECT id AS job, owner FROM jobs) ON job = lift WHERE owner = :owner"
    )
    total = f"SELECT ({assets}) + ({lifts}) + ({tradeoffs}) + ({selections})"
    return int(connection.execute(total, {"owner": owner.key}).fetchone()[0])


def require_quota(connection: sqlite3.Connection, owner: Owner, coming: int) -> None:
    """Require that an owner may store so many more bytes, within the transaction that stores them or before it.

    Raises:
        OverQuota: it would be more than the owner may store.
    """
    if owner.max_bytes is None:
        return
    stored = stored_bytes(connection, owner)
    if stored + coming > owner.max_bytes:
        raise OverQuota(
            "key", expected=f"at most {owner.max_bytes} bytes of assets and results",
            got=f"{stored} and {coming} more",
            hint="delete assets, or jobs with their results, or ask the operator for more",
        )  # fmt: skip


def require_turn(connection: sqlite3.Connection, kind: str, owner: Owner) -> None:
    """Require that an owner may queue another job of that kind.

    Raises:
        KeyLimitReached: as many are in line as may be.
    """
    if owner.max_queued is None:
        return
    row = connection.execute("SELECT count(*) FROM jobs WHERE state = 'queued' AND owner = ?", (owner.key,))
    if (queued := row.fetchone()[0]) >= owner.max_queued:
        raise KeyLimitReached(
            kind, expected=f"fewer than {owner.max_queued} jobs of this key in line", got=f"{queued}",
            hint="try again later", retry_after=QUEUE_RETRY_SECONDS,
        )  # fmt: skip
