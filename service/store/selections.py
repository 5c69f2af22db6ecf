"""Selections of splats with their history, and labels of a lift's objects, both edited by users."""

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
from service.store.owners import VISIBLE_JOBS, Owner, require_quota

MAX_SELECTIONS = 200  # selections of a lift
HISTORY = 100  # steps that a selection can go back
MAX_BYTES, BYTES_A_SPLAT = (
    64 << 20,
    64,
)  # of all steps of a lift's selections, compressed, and in addition for each splat
NO_USE = "delete one that is of no use any more"
MAX_LABELS = 10_000  # of a lift, with a name or hidden

COLUMNS = (
    "selections.*, (SELECT min(number) FROM selection_steps WHERE selection = selections.id) AS first,"
    " (SELECT max(number) FROM selection_steps WHERE selection = selections.id) AS last, steps.count, steps.box"
)
VISIBLE = (
    f"SELECT {COLUMNS} FROM selections JOIN jobs ON jobs.id = lift"
    " JOIN selection_steps AS steps ON selection = selections.id AND number = step"
    f" WHERE lift = :lift AND {VISIBLE_JOBS}"
)


@dataclass(frozen=True)
class SplatSet:
    """Splats of a selection after an edit, and the edit."""

    edit: dict[str, Any]
    count: int
    box: dict[str, Any] | None
    bits: bytes  # a bit for each splat, the lowest bit of a byte first


@dataclass(frozen=True)
class SelectionRecord:
    """Record of a selection."""

    id: str
    lift: str
    name: str
    version: int  # increases with each change
    step: int  # the current step of its history
    first: int  # the oldest step in the history
    last: int
    count: int  # splats
    box: dict[str, Any] | None
    created: float
    changed: float


class SelectionStore:
    """Selections in the database; each belongs to its lift's owner. Selections of other owners count as absent."""

    def __init__(self, database: Database, files: DataDirectory) -> None:
        self._database = database
        self._files = files

    def create(self, owner: Owner, lift: str, name: str, splats: SplatSet) -> SelectionRecord:
        """Store a new selection of a lift that the owner may see.

        Raises:
            NotFound: the lift was deleted meanwhile.
            OverLimit: the lift has as many as it may.
            OverQuota, NoSpace: there is no room for it.
        """
        selection, now = secrets.token_hex(8), time.time()
        with _lift_there(lift), self._database.write(is_counted=True) as connection:
            number = connection.execute("SELECT count(*) FROM selections WHERE lift = ?", (lift,)).fetchone()[0]
            if number >= MAX_SELECTIONS:
                raise OverLimit("selection", expected=f"at most {MAX_SELECTIONS} of a lift", got="more", hint=NO_USE)
            row = {"id": selection, "lift": lift, "name": name, "version": 1, "step": 0}
            insert(connection, "selections", row | {"created": now, "changed": now})
            self._keep(connection, owner, selection, 0, splats)
        return self.get(owner, lift, selection)

    def extend(
        self, owner: Owner, lift: str, selection: str, splats: SplatSet, versions: frozenset[int]
    ) -> SelectionRecord:
        """Add a step to the history; the steps that were undone are deleted, and the oldest ones over the limit.

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
        """Set the ``name``, or go to another ``step`` of the history.

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
        """Delete a selection and its history.

        Raises:
            NotFound: there is no such selection.
            VersionMismatch: it has another version than these.
        """
        with self._database.write(is_counted=True) as connection:
            _expected(connection, owner, lift, selection, versions)
            connection.execute("DELETE FROM selections WHERE id = ?", (selection,))

    def get(self, owner: Owner, lift: str, selection: str, versions: frozenset[int] | None = None) -> SelectionRecord:
        """Return the selection of that id.

        Raises:
            NotFound: the lift has none.
            VersionMismatch: it has another version than these.
        """
        with self._database.read() as connection:
            return _expected(connection, owner, lift, selection, versions)

    def all(self, owner: Owner, lift: str) -> list[SelectionRecord]:
        """Return the selections of a lift, newest first."""
        with self._database.read() as connection:
            rows = connection.execute(
                f"{VISIBLE} ORDER BY selections.created DESC, selections.id", owner.terms(lift=lift)
            )
            return [_record(row) for row in rows]

    def history(self, selection: SelectionRecord) -> list[dict[str, Any]]:
        """Return the ``number``, ``edit`` and ``count`` of each step, also of those that were undone."""
        with self._database.read() as connection:
            rows = connection.execute(
                "SELECT number, edit, count FROM selection_steps WHERE selection = ? ORDER BY number", (selection.id,)
            ).fetchall()
        return [{**dict(row), "edit": json.loads(row["edit"])} for row in rows]

    def bits(self, selection: SelectionRecord) -> bytes:
        """Return the splats at the current step; NotFound if it is gone."""
        with self._database.read() as connection:
            row = connection.execute(
                "SELECT splats FROM selection_steps WHERE selection = ? AND number = ?",
                (selection.id, selection.step),
            ).fetchone()
        if row is None:
            raise _none(selection.id)
        return zlib.decompress(row["splats"])

    def object_labels(self, owner: Owner, lift: str) -> dict[int, tuple[str | None, bool]]:
        """Return the labels of the lift's objects: their names, and whether they are hidden."""
        select = (
            "SELECT thing, name, hidden FROM things JOIN jobs ON jobs.id = lift"
            f" WHERE lift = :lift AND {VISIBLE_JOBS}"
        )
        with self._database.read() as connection:
            rows = connection.execute(select, owner.terms(lift=lift)).fetchall()
        return {row["thing"]: (row["name"], bool(row["hidden"])) for row in rows}

    def change_object_label(self, lift: str, object_id: int, changes: dict[str, Any]) -> None:
        """Set the ``name`` of an object (None: its own), or ``hidden``; the owner must be able to see the lift.

        Raises:
            NotFound: the lift was deleted meanwhile.
            OverLimit: too many others of the lift have been changed.
        """
        with _lift_there(lift), self._database.write(is_counted=True) as connection:
            select = "SELECT count(*) FROM things WHERE lift = ? AND thing != ?"
            number = connection.execute(select, (lift, object_id)).fetchone()[0]
            if number >= MAX_LABELS:
                raise OverLimit("object", expected=f"at most {MAX_LABELS} changed objects of a lift", got="more")
            insert(connection, "things", {"lift": lift, "thing": object_id, "hidden": 0}, on_conflict="IGNORE")
            for column in changes.keys() & {"name", "hidden"}:
                connection.execute(
                    f"UPDATE things SET {column} = ? WHERE lift = ? AND thing = ?", (changes[column], lift, object_id)
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
        limit = MAX_BYTES + BYTES_A_SPLAT * 8 * len(splats.bits)
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
    """Raise NotFound for rows that refer to no lift."""
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
