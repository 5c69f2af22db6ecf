"""/lifts/{lift}/selections: sets of splats that are corrected by hand; and names of the lift's objects."""

from __future__ import annotations

import re
import zlib
from typing import Annotated, Any

from fastapi import APIRouter, Header, Response
from fastapi import Path as PathParameter

from liftcore.errors import NotFound
from service import models, selections
from service.errors import InvalidRequest
from service.models import Lift, Selection
from service.routes import Caller, Deps, Parts, cache_headers
from service.routes.queries import NO_ENCODER, bits_text, query_request, scene_request
from service.selections import SplatSet
from service.store import Owner

PATH = "/lifts/{lift}/selections/{selection}"
SelectionId = Annotated[
    str, PathParameter(pattern=r"^[0-9a-f]{16}$", description="the id of a selection of the lift")
]
ObjectId = Annotated[
    int, PathParameter(alias="object", ge=0, le=10**9, description="the id of an object of the lift")
]
IfMatch = Annotated[
    str | None,
    Header(alias="If-Match", max_length=1000, description="the ETag of the version that is to be changed; else 412"),
]

router = APIRouter(tags=["selections"])


@router.get("/lifts/{lift}/selections")
def list_selections(lift: str, deps: Deps, owner: Caller) -> models.Selections:
    """List the selections of a lift, newest first."""
    record = deps.store.lift(owner, lift)
    return models.Selections(selections=selections.list_selections(deps.store, record.id))


@router.post("/lifts/{lift}/selections", status_code=201)
def create_selection(
    lift: str, parameters: models.NewSelection, response: Response, deps: Deps, owner: Caller
) -> Selection:
    """Begin a selection, with the splats of an edit or with none. Questions name it as `sets=selection:ID`."""
    record = deps.store.lift(owner, lift)
    splats = _edit(parameters.edit, record, deps, owner, bytes(-(-record.count // 8)))
    selection = selections.create_selection(deps.store, owner, record.id, parameters.name, splats)
    response.headers["Location"] = f"/lifts/{record.id}/selections/{selection.id}"
    return _answer(selection, response)


@router.get(PATH)
def get_selection(lift: str, selection: SelectionId, response: Response, deps: Deps, owner: Caller) -> Selection:
    """Get one selection. Its splats are those of its question, `links.selection`."""
    return _answer(selections.get_selection(deps.store, deps.store.lift(owner, lift).id, selection), response)


@router.post(f"{PATH}/edits")
def edit_selection(
    lift: str, selection: SelectionId, edit: models.EditRequest, response: Response, deps: Deps, owner: Caller,
    match: IfMatch = None,
) -> Selection:  # fmt: skip
    """Add, take away, grow, shrink or set: a step of its history, which PATCH goes back."""
    record = deps.store.lift(owner, lift)
    before = selections.get_selection(deps.store, record.id, selection, _versions(match))
    splats = _edit(edit, record, deps, owner, selections.bits_of_selection(deps.store, before))
    # The change is of the version that was read: one stored meanwhile is not overwritten.
    return _answer(selections.extend_selection(deps.store, before, splats), response)


@router.patch(PATH)
def change_selection(
    lift: str, selection: SelectionId, change: models.SelectionChange, response: Response, deps: Deps, owner: Caller,
    match: IfMatch = None,
) -> Selection:  # fmt: skip
    """Give it another name, or go to another step of its history: undo and redo."""
    changes, record = change.model_dump(exclude_unset=True, exclude_none=True), deps.store.lift(owner, lift)
    after = selections.change_selection(deps.store, record.id, selection, changes, _versions(match))
    return _answer(after, response)


@router.delete(PATH, status_code=204)
def delete_selection(lift: str, selection: SelectionId, deps: Deps, owner: Caller, match: IfMatch = None) -> None:
    """Delete a selection and its history."""
    selections.delete_selection(deps.store, deps.store.lift(owner, lift).id, selection, _versions(match))


@router.patch("/lifts/{lift}/objects/{object}")
def change_object_label(
    lift: str, object_id: ObjectId, change: models.ObjectLabelChange, deps: Deps, owner: Caller
) -> models.ObjectLabel:
    """Give an object of a lift a name of your own, or hide it from lists and pictures; other fields stay."""
    record = deps.store.lift(owner, lift)
    count = deps.queries.call(scene_request("count_objects", record, deps))["count"]
    if object_id >= count:
        raise NotFound("object", expected=f"one of the lift's {count} objects", got=str(object_id))
    changes = change.model_dump(exclude_unset=True)
    return selections.change_object_label(deps.store, owner, record.id, object_id, changes)


def _edit(edit: models.EditRequest | None, lift: Lift, deps: Parts, owner: Owner, before: bytes) -> SplatSet:
    """Apply an edit to a selection in the query process; without an edit, return it as it is."""
    if edit is None:
        return SplatSet(0, None, zlib.compress(before))
    if edit.query is None:
        order = scene_request("edit", lift, deps) | NO_ENCODER
    elif edit.query.lift not in (None, lift.id):
        raise InvalidRequest("query.lift", expected="the lift of the selection", got=str(edit.query.lift))
    else:
        order = query_request("edit", edit.query, lift, deps, owner)
    document: dict[str, Any] = edit.model_dump(mode="json", exclude={"query"}, exclude_none=True)
    document |= {"query": order["query"]} if "query" in order else {}
    value = deps.queries.call(order | {"edit": document, "before": bits_text(before)})
    return SplatSet(value["count"], value["box"], zlib.compress(bytes.fromhex(value["bits"])))


def _versions(match: str | None) -> frozenset[int] | None:
    """Return the versions of an If-Match; None for any."""
    if match is None or match.strip() == "*":
        return None
    return frozenset(int(digits) for digits in re.findall(r'"(\d{1,15})"', match))


def _answer(selection: Selection, response: Response) -> Selection:
    response.headers.update(cache_headers(f'"{selection.version}"'))
    return selection
