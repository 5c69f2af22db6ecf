"""Lists in pages: newest first, each page from where the one before ended, whatever was added meanwhile."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from service.errors import InvalidRequest

R = TypeVar("R")
CURSOR = r"^[0-9.e+-]{1,30}~[0-9a-z:]{1,80}$"  # when the last one of a page was made, and its id


@dataclass(frozen=True)
class Page(Generic[R]):
    """Some records, and where the next page begins; None when there is none."""

    records: list[R]
    cursor: str | None


def after(cursor: str | None) -> dict[str, Any]:
    """Terms ``:created`` and ``:after`` of a query for what is older than that, or for the newest.

    Raises:
        InvalidRequest: it is no cursor.
    """
    if cursor is None:
        return {"created": float("inf"), "after": ""}
    created, _, ident = cursor.partition("~")
    try:
        if re.match(CURSOR, cursor):
            return {"created": float(created), "after": ident}
    except ValueError:
        pass
    raise InvalidRequest("cursor", expected="the next of a page", got=repr(cursor[:80]))


def page_of(rows: Sequence[sqlite3.Row], limit: int, record: Callable[[sqlite3.Row], R]) -> Page[R]:
    """A page of the first ``limit`` rows, where one more was asked for."""
    last = rows[limit - 1] if len(rows) > limit else None
    cursor = None if last is None else f"{last['created']!r}~{last['id']}"
    return Page([record(row) for row in rows[:limit]], cursor)
