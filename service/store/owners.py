"""Whose things are whose, what one owner may do, and what they may fill."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from service.errors import InvalidRequest, KeyLimitReached, OverQuota

# For WHERE clauses over a table with a column `owner`; its names are bound by `Owner.terms`.
SEEN = "(:sees_all OR owner = :owner)"
# The same to look only, over jobs and over owners of assets: also what a key was given (`service.auth` is its gate).
GIVEN = "SELECT lift FROM key_lifts WHERE key = :owner"
GIVEN_ASSETS = (
    f"SELECT splats FROM jobs WHERE id IN ({GIVEN}) UNION SELECT cameras FROM jobs WHERE id IN ({GIVEN})"
    f" UNION SELECT asset FROM job_features WHERE job IN ({GIVEN})"
    f" UNION SELECT photos FROM lifts WHERE id IN ({GIVEN})"
    f" UNION SELECT json_extract(parameters, '$.table') FROM jobs WHERE id IN ({GIVEN})"
)
SHOWN_JOBS = f"(:sees_all OR owner = :owner OR jobs.id IN ({GIVEN}))"
SHOWN_ASSETS = f"(:sees_all OR owner = :owner OR asset IN ({GIVEN_ASSETS}))"
# Keys that nobody comes in with any more; `:now` in seconds since 1970. A NULL is no end.
_ENDED = "SELECT id FROM keys WHERE revoked IS NOT NULL OR expires <= :now"
ENDED_KEYS = f"{_ENDED} OR maker IN ({_ENDED})"
QUEUE_RETRY_SECONDS = 30  # a lift takes seconds to minutes, and one must end before the line is shorter


class Scope(StrEnum):
    """A kind of request that a key allows."""

    READ = "read"  # look: assets, jobs, results, queries, pictures
    WRITE = "write"  # upload, order, cancel, delete
    SHARED = "shared"  # look at and ask the lifts that the key was given
    METRICS = "metrics"  # /metrics, which tells of everybody's work together, and nothing else
    ADMIN = "admin"  # all of these, on everybody's things


def parse_scopes(names: Iterable[str]) -> frozenset[Scope]:
    """Scopes by their names.

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
    """Who looks at the store, and what they may fill of it. What another owner made is absent: it is not found."""

    key: str  # the id of a key: what is made belongs to it
    sees_all: bool
    max_bytes: int | None = None  # of assets and results together; None = no limit
    max_queued: int | None = None  # jobs in line

    def terms(self, **more: Any) -> dict[str, Any]:
        """Values for SEEN, and more."""
        return {"sees_all": self.sees_all, "owner": self.key, **more}


# The service itself, and everybody while there are no keys; what it makes belongs to admins once there are keys.
SERVICE = Owner("", sees_all=True)
NOBODY = Owner("-", sees_all=False)  # the id of no key, so nothing is theirs


def stored_bytes(connection: sqlite3.Connection, owner: Owner) -> int:
    """What an owner's assets and results, selections too, take; bytes that several have count for each of them."""
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
    """See that an owner may store so many bytes more, within the transaction that will store them or before it.

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
    """See that an owner may put another job, of that kind, in line.

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
