"""Selections of splats with their history, and labels of a lift's objects, both edited by people."""

from __future__ import annotations

import json
import secrets
import sqlite3
import time
import zlib
from dataclasses import dataclass
from typing import Any

from liftcore.errors import NotFound
from service.errors import Conflict, InvalidRequest, VersionMismatch
from service.models import ObjectLabel, Selection
from service.store import Owner, Store

MOST_SELECTIONS, MOST_STEPS = 200, 100  # of a lift, of a selection's history
CURRENT = (
    "SELECT selections.*, count, box,"
    " (SELECT min(number) FROM steps WHERE selection = selections.id) AS first,"
    " (SELECT max(number) FROM steps WHERE selection = selections.id) AS last"
    " FROM selections JOIN steps ON selection = selections.id AND number = step WHERE lift = :lift"
)


@dataclass(frozen=True)
class SplatSet:
    """Splats of a selection after an edit."""

    count: int
    box: dict[str, Any] | None
    bits: bytes  # zlib of a bit for each splat, the lowest bit of a byte first


def list_selections(store: Store, lift: str) -> list[Selection]:
    """Return the selections of a lift, newest first. The caller must see the lift, here and below."""
    return [Selection(**row) for row in store.rows(f"{CURRENT} ORDER BY created DESC, id", lift=lift)]


def get_selection(store: Store, lift: str, selection: str, versions: frozenset[int] | None = None) -> Selection:
    """Return the selection of that id, which must have one of the versions; None for any."""
    rows = store.rows(f"{CURRENT} AND selections.id = :id", lift=lift, id=selection)
    if not rows:
        hint = "GET /lifts/{lift}/selections lists them"
        raise NotFound("selection", expected="the id of a selection of the lift", got=selection[:80], hint=hint)
    if versions is not None and rows[0]["version"] not in versions:
        expected, hint = "the version that was seen", "GET it again"
        raise VersionMismatch("selection", expected=expected, got="a newer one", hint=hint)
    return Selection(**rows[0])


def bits_of_selection(store: Store, selection: Selection) -> bytes:
    """Return the splats at the current step: a bit for each, the lowest bit of a byte first."""
    select = "SELECT bits FROM steps WHERE selection = :id AND number = :step"
    rows = store.rows(select, id=selection.id, step=selection.step)
    if not rows:
        raise Conflict("selection", expected="a step that is there", got="one that was undone", hint="send it again")
    return zlib.decompress(rows[0]["bits"])


def create_selection(store: Store, owner: Owner, lift: str, name: str, splats: SplatSet) -> Selection:
    """Store a new selection of a lift."""
    store.require_room(len(splats.bits))
    selection, now = secrets.token_hex(8), time.time()
    with store.write() as connection:
        store.lift(owner, lift)
        if len(list_selections(store, lift)) >= MOST_SELECTIONS:
            hint = "delete one that is of no use any more"
            raise Conflict("selection", expected=f"at most {MOST_SELECTIONS} of a lift", got="more", hint=hint)
        connection.execute("INSERT INTO selections VALUES (?, ?, ?, 1, 0, ?, ?)", (selection, lift, name, now, now))
        _add_step(connection, selection, 0, splats)
    return get_selection(store, lift, selection)


def extend_selection(store: Store, selection: Selection, splats: SplatSet) -> Selection:
    """Add a step to the history; the steps that were undone go, and the oldest ones over the limit."""
    store.require_room(len(splats.bits))
    with store.write() as connection:
        before = get_selection(store, selection.lift, selection.id, frozenset({selection.version}))
        step = before.step + 1
        delete = "DELETE FROM steps WHERE selection = ? AND (number > ? OR number < ?)"
        connection.execute(delete, (selection.id, before.step, step - MOST_STEPS))
        _add_step(connection, selection.id, step, splats)
        _update(connection, selection.id, step=step)
    return get_selection(store, selection.lift, selection.id)


def change_selection(
    store: Store, lift: str, selection: str, changes: dict[str, Any], versions: frozenset[int] | None
) -> Selection:
    """Set the ``name``, or go to another ``step`` of the history."""
    with store.write() as connection:
        before = get_selection(store, lift, selection, versions)
        step = changes.get("step", before.step)
        if not before.first <= step <= before.last:
            raise InvalidRequest("step", expected=f"a step from {before.first} to {before.last}", got=str(step))
        if changes:
            _update(connection, selection, **changes)
    return get_selection(store, lift, selection)


def delete_selection(store: Store, lift: str, selection: str, versions: frozenset[int] | None) -> None:
    """Delete a selection and its history; errors as of `get_selection`."""
    with store.write() as connection:
        get_selection(store, lift, selection, versions)
        connection.execute("DELETE FROM selections WHERE id = ?", (selection,))


def _add_step(connection: sqlite3.Connection, selection: str, number: int, splats: SplatSet) -> None:
    box = None if splats.box is None else json.dumps(splats.box)
    row = (selection, number, splats.count, box, splats.bits)
    connection.execute("INSERT INTO steps VALUES (?, ?, ?, ?, ?)", row)


def _update(connection: sqlite3.Connection, selection: str, **columns: Any) -> None:
    names = "".join(f"{name} = :{name}, " for name in columns)
    update = f"UPDATE selections SET {names}version = version + 1, changed = :now WHERE id = :id"
    connection.execute(update, {**columns, "now": time.time(), "id": selection})


# Labels of objects


def object_labels(store: Store, lift: str) -> list[ObjectLabel]:
    """Return the labels that people gave to objects of the lift."""
    return [ObjectLabel(**row) for row in store.rows("SELECT * FROM objects WHERE lift = :lift", lift=lift)]


def change_object_label(
    store: Store, owner: Owner, lift: str, object_id: int, changes: dict[str, Any]
) -> ObjectLabel:
    """Set the ``name`` of an object (None: its own), or ``hidden``."""
    with store.write() as connection:
        store.lift(owner, lift)
        connection.execute("INSERT OR IGNORE INTO objects (lift, id) VALUES (?, ?)", (lift, object_id))
        for column in changes.keys() & {"name", "hidden"}:
            update = f"UPDATE objects SET {column} = ? WHERE lift = ? AND id = ?"
            connection.execute(update, (changes[column], lift, object_id))
    select = "SELECT * FROM objects WHERE lift = :lift AND id = :id"
    return ObjectLabel(**store.rows(select, lift=lift, id=object_id)[0])
