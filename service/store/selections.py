"""Sets of splats that somebody corrects by hand, each with its history; and what people call the things of a lift."""

from __future__ import annotations

import json
import secrets
import sqlite3
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from liftcore.errors import NotFound
from service.errors import InvalidRequest, OverLimit, VersionMismatch
from service.store.database import Database, insert, parsed, record_of
from service.store.files import DataDirectory
from service.store.owners import SHOWN_JOBS, Owner, require_quota

MOST = 200  # selections of a lift
HISTORY = 100  # steps that a selection can go back
MOST_BYTES, BYTES_A_SPLAT = 64 << 20, 64  # of all steps of a lift's selections, compressed: so much, and a splat more
NO_USE = "delete one that is of no use any more"
MOST_THINGS = 10_000  # of a lift, that have a name or are hidden

SHOWN = (
    "selections.*, (SELECT min(number) FROM selection_steps WHERE selection = selections.id) AS first,"
    " (SELECT max(number) FROM selection_steps WHERE selection = selections.id) AS last, steps.count, steps.box"
)
VISIBLE = (
    f"SELECT {SHOWN} FROM selections JOIN jobs ON jobs.id = lift"
    " JOIN selection_steps AS steps ON selection = selections.id AND number = step"
    f" WHERE lift = :lift AND {SHOWN_JOBS}"
)


@dataclass(frozen=True)
class SplatSet:
    """Splats, and what made them of those before."""

    edit: dict[str, Any]
    count: int
    box: dict[str, Any] | None
    bits: bytes  # a bit a splat, the first the lowest of its byte


@dataclass(frozen=True)
class SelectionRecord:
    """A selection as the store knows it."""

    id: str
    lift: str
    name: str
    version: int  # grows with each change
    step: int  # where in its history it is
    first: int  # the steps that there are
    last: int
    count: int  # splats
    box: dict[str, Any] | None
    created: float
    changed: float


class SelectionStore:
    """Selections in the database: they belong to whom their lift does. What an owner does not see is absent."""

    def __init__(self, database: Database, files: DataDirectory) -> None:
        self._database = database
        self._files = files

    def create(self, owner: Owner, lift: str, name: str, splats: SplatSet) -> SelectionRecord:
        """Keep a new selection; the lift is one that the owner sees.

        Raises:
            NotFound: the lift was deleted meanwhile.
            OverLimit: the lift has as many as it may.
            OverQuota, NoSpace: there is no room for it.
        """
        selection, now = secrets.token_hex(8), time.time()
        with _lift_there(lift), self._database.write(is_counted=True) as connection:
            number = connection.execute("SELECT count(*) FROM selections WHERE lift = ?", (lift,)).fetchone()[0]
            if number >= MOST:
                raise OverLimit("selection", expected=f"at most {MOST} of a lift", got="more", hint=NO_USE)
            row = {"id": selection, "lift": lift, "name": name, "version": 1, "step": 0}
            insert(connection, "selections", row | {"created": now, "changed": now})
            self._keep(connection, owner, selection, 0, splats)
        return self.get(owner, lift, selection)

    def extend(
        self, owner: Owner, lift: str, selection: str, splats: SplatSet, versions: frozenset[int]
    ) -> SelectionRecord:
        """Take a step from the version that it had; steps that were undone are forgotten, and the oldest.

        Raises:
            NotFound: there is no such selection.
            VersionMismatch: it has another version than these.
            OverQuota, NoSpace: there is no room for it.
        """
        with self._database.write(is_counted=True) as connection:
            record = _expected(connection, owner, lift, selection, versions)
            step = record.step + 1
            terms = (selection, record.step, step - HISTORY)
            connection.execute(
                "DELETE FROM selection_steps WHERE selection = ? AND (number > ? OR number < ?)", terms
            )
            self._keep(connection, owner, selection, step, splats)
            self._update(connection, selection, step=step)
        return self.get(owner, lift, selection)

    def change(
        self, owner: Owner, lift: str, selection: str, changes: dict[str, Any], versions: frozenset[int] | None
    ) -> SelectionRecord:
        """Give it another ``name``, or go to another ``step`` of its history.

        Raises:
            NotFound: there is no such selection.
            VersionMismatch: it has another version than these.
            InvalidRequest: there is no such step.
        """
        with self._database.write(is_counted=True) as connection:
            record = _expected(connection, owner, lift, selection, versions)
            step = changes.get("step", record.step)
            if not record.first <= step <= record.last:
                expected = f"a step from {record.first} to {record.last}"
                raise InvalidRequest("step", expected=expected, got=str(step))
            if changes:
                self._update(connection, selection, **changes)
        return self.get(owner, lift, selection)

    def delete(self, owner: Owner, lift: str, selection: str, versions: frozenset[int] | None) -> None:
        """Forget it and its history.

        Raises:
            NotFound: there is no such selection.
            VersionMismatch: it has another version than these.
        """
        with self._database.write(is_counted=True) as connection:
            _expected(connection, owner, lift, selection, versions)
            connection.execute("DELETE FROM selections WHERE id = ?", (selection,))

    def get(self, owner: Owner, lift: str, selection: str, versions: frozenset[int] | None = None) -> SelectionRecord:
        """The selection of that id.

        Raises:
            NotFound: the lift has none.
            VersionMismatch: it has another version than these.
        """
        with self._database.read() as connection:
            return _expected(connection, owner, lift, selection, versions)

    def all(self, owner: Owner, lift: str) -> list[SelectionRecord]:
        """Those of a lift, newest first."""
        with self._database.read() as connection:
            rows = connection.execute(
                f"{VISIBLE} ORDER BY selections.created DESC, selections.id", owner.terms(lift=lift)
            )
            return [_record(row) for row in rows]

    def history(self, selection: SelectionRecord) -> list[dict[str, Any]]:
        """The ``number``, ``edit`` and ``count`` of each of its steps, also of those that were undone."""
        with self._database.read() as connection:
            rows = connection.execute(
                "SELECT number, edit, count FROM selection_steps WHERE selection = ? ORDER BY number", (selection.id,)
            ).fetchall()
        return [{**dict(row), "edit": json.loads(row["edit"])} for row in rows]

    def bits(self, selection: SelectionRecord) -> bytes:
        """Its splats at its step; NotFound where that is gone."""
        with self._database.read() as connection:
            row = connection.execute(
                "SELECT splats FROM selection_steps WHERE selection = ? AND number = ?",
                (selection.id, selection.step),
            ).fetchone()
        if row is None:
            raise _none(selection.id)
        return zlib.decompress(row["splats"])

    def things(self, owner: Owner, lift: str) -> dict[int, tuple[str | None, bool]]:
        """Of the lift's objects that somebody named or hid: their names, and whether they are hidden."""
        select = (
            f"SELECT thing, name, hidden FROM things JOIN jobs ON jobs.id = lift WHERE lift = :lift AND {SHOWN_JOBS}"
        )
        with self._database.read() as connection:
            rows = connection.execute(select, owner.terms(lift=lift)).fetchall()
        return {row["thing"]: (row["name"], bool(row["hidden"])) for row in rows}

    def change_thing(self, lift: str, thing: int, changes: dict[str, Any]) -> None:
        """Give an object of a lift, which the owner sees, another ``name``, None for its own, or have it ``hidden``.

        Raises:
            NotFound: the lift was deleted meanwhile.
            OverLimit: too many others of the lift have been changed.
        """
        with _lift_there(lift), self._database.write(is_counted=True) as connection:
            select = "SELECT count(*) FROM things WHERE lift = ? AND thing != ?"
            number = connection.execute(select, (lift, thing)).fetchone()[0]
            if number >= MOST_THINGS:
                raise OverLimit("thing", expected=f"at most {MOST_THINGS} changed objects of a lift", got="more")
            insert(connection, "things", {"lift": lift, "thing": thing, "hidden": 0}, on_conflict="IGNORE")
            for column in changes.keys() & {"name", "hidden"}:
                connection.execute(
                    f"UPDATE things SET {column} = ? WHERE lift = ? AND thing = ?", (changes[column], lift, thing)
                )

    def _keep(
        self, connection: sqlite3.Connection, owner: Owner, selection: str, number: int, splats: SplatSet
    ) -> None:
        packed = zlib.compress(splats.bits)
        edit, box = json.dumps(splats.edit), None if splats.box is None else json.dumps(splats.box)
        coming = len(packed) + len(edit)
        select = "SELECT total(length(splats) + length(edit)) FROM selection_steps JOIN selections ON id = selection"
        lift = "(SELECT lift FROM selections WHERE id = ?)"
        (stored,) = connection.execute(f"{select} WHERE lift = {lift}", (selection,)).fetchone()
        limit = MOST_BYTES + BYTES_A_SPLAT * 8 * len(splats.bits)
        if stored + coming > limit:
            expected = f"at most {limit} bytes of all selections of a lift"
            raise OverLimit("selection", expected=expected, got="more", hint=NO_USE)
        self._files.require_room(coming)
        require_quota(connection, owner, coming)
        row = {"selection": selection, "number": number, "edit": edit, "count": splats.count}
        insert(connection, "selection_steps", row | {"box": box, "splats": packed})

    def _update(self, connection: sqlite3.Connection, selection: str, **changes: Any) -> None:
        values = {name: changes[name] for name in ("name", "step") if name in changes}
        columns = "".join(f"{name} = :{name}, " for name in values)
        connection.execute(
            f"UPDATE selections SET {columns}version = version + 1, changed = :changed WHERE id = :id",
            values | {"changed": time.time(), "id": selection},
        )


@contextmanager
def _lift_there(lift: str) -> Iterator[None]:
    """Say of rows that reference no lift that it is not there."""
    try:
        yield
    except sqlite3.IntegrityError as error:
        if error.sqlite_errorcode != sqlite3.SQLITE_CONSTRAINT_FOREIGNKEY:
            raise
        raise NotFound("lift", expected="the id of a lift", got=lift, hint="it was deleted meanwhile") from None


def _expected(
    connection: sqlite3.Connection, owner: Owner, lift: str, selection: str, versions: frozenset[int] | None
) -> SelectionRecord:
    """Return the selection of that id; raise NotFound, or VersionMismatch if its version is none of ``versions``."""
    terms = owner.terms(lift=lift, selection=selection)
    row = connection.execute(f"{VISIBLE} AND selections.id = :selection", terms).fetchone()
    if row is None:
        raise _none(selection)
    record = _record(row)
    if versions is not None and record.version not in versions:
        raise VersionMismatch(
            "selection", expected="the version that was seen", got="a newer one", hint="GET it again"
        )
    return record


def _record(row: sqlite3.Row) -> SelectionRecord:
    return record_of(SelectionRecord, row, box=parsed(row["box"]))


def _none(selection: str) -> NotFound:
    hint = "GET /lifts/{lift}/selections lists them"
    return NotFound("selection", expected="the id of a selection of the lift", got=selection[:80], hint=hint)
