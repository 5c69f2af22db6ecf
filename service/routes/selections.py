"""/lifts/{lift}/selections: sets of splats that are corrected by hand; and names of the lift's objects."""

from __future__ import annotations

import base64
import re
import zlib
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Query, Response
from fastapi.responses import JSONResponse

from liftcore.errors import NotFound
from service import models
from service.content import cache_headers
from service.errors import Conflict, InvalidRequest, VersionMismatch
from service.requests import JsonRoute
from service.routes.lifts import ObjectId
from service.routes.queries import NO_ENCODER, Ask, bits_of, query_request, scene_request
from service.state import AppState, Deps
from service.store.lifts import LiftRecord
from service.store.selections import SelectionRecord, SplatSet

SELECTION_PATH = "/lifts/{lift}/selections/{selection}"
SelectionId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$", description="the id of a selection of the lift")]
IfMatch = Annotated[
    str | None,
    Header(alias="If-Match", max_length=1000, description="the ETag of the version that is to be changed; else 412"),
]

router = APIRouter(tags=["selections"], route_class=JsonRoute)


@router.get("/lifts/{lift}/selections", response_model=models.Selections)
def list_selections(lift: str, deps: Deps) -> models.Selections:
    """List the selections of a lift, newest first."""
    record = deps.store.lifts.get(deps.owner, lift)
    selections = deps.store.selections.all(deps.owner, record.id)
    return models.Selections(selections=[_summary(selection) for selection in selections])


@router.post("/lifts/{lift}/selections", response_model=models.SelectionDetail, status_code=201)
def create_selection(lift: str, parameters: models.NewSelection, deps: Deps, ask: Ask) -> Response:
    """Begin a selection, with the splats of an edit or with none. Questions name it as `sets=selection:ID`."""
    record = deps.store.lifts.get(deps.owner, lift)
    splats = _apply_edit(parameters.edit, record, deps, ask, bytes(-(-record.count // 8)))
    selection = deps.store.selections.create(deps.owner, record.id, parameters.name, splats)
    return _answer(selection, deps, 201, {"Location": f"/lifts/{record.id}/selections/{selection.id}"})


@router.get(SELECTION_PATH, response_model=models.SelectionDetail)
def get_selection(
    lift: str,
    selection: SelectionId,
    deps: Deps,
    bits: Annotated[bool, Query(description="with its splats, a bit for each of the lift's")] = False,
) -> Response:
    """Return one selection: its content, and the steps of its history."""
    record = deps.store.lifts.get(deps.owner, lift)
    return _answer(deps.store.selections.get(deps.owner, record.id, selection), deps, bits=bits)


@router.post(SELECTION_PATH + "/edits", response_model=models.SelectionDetail)
def edit_selection(
    lift: str, selection: SelectionId, parameters: models.EditRequest, deps: Deps, ask: Ask, match: IfMatch = None
) -> Response:
    """Add, take away, grow, shrink or set: a step of its history, which PATCH goes back."""
    record = deps.store.lifts.get(deps.owner, lift)
    before = deps.store.selections.get(deps.owner, record.id, selection, _versions(match))
    splats = _apply_edit(parameters, record, deps, ask, deps.store.selections.bits(before))
    try:  # the change is of the version that was read: one stored meanwhile is not overwritten
        after = deps.store.selections.extend(deps.owner, record.id, selection, splats, frozenset({before.version}))
    except VersionMismatch as error:
        if _versions(match) is not None:
            raise
        hint = "send the edit again"
        raise Conflict("selection", expected=error.expected, got="one that another edit changed", hint=hint) from None
    return _answer(after, deps)


@router.patch(SELECTION_PATH, response_model=models.SelectionDetail)
def change_selection(
    lift: str, selection: SelectionId, change: models.SelectionChange, deps: Deps, match: IfMatch = None
) -> Response:
    """Give it another name, or go to another step of its history: undo and redo."""
    record = deps.store.lifts.get(deps.owner, lift)
    changes = change.model_dump(exclude_unset=True, exclude_none=True)
    after = deps.store.selections.change(deps.owner, record.id, selection, changes, _versions(match))
    return _answer(after, deps)


@router.delete(SELECTION_PATH, status_code=204)
def delete_selection(lift: str, selection: SelectionId, deps: Deps, match: IfMatch = None) -> Response:
    """Forget a selection and its history."""
    record = deps.store.lifts.get(deps.owner, lift)
    deps.store.selections.delete(deps.owner, record.id, selection, _versions(match))
    return Response(status_code=204)


@router.patch("/lifts/{lift}/objects/{object}", response_model=models.ObjectLabel)
def change_object_label(
    lift: str, object_id: ObjectId, change: models.ObjectLabelChange, deps: Deps, ask: Ask
) -> models.ObjectLabel:
    """Give an object of a lift a name of your own, or hide it from lists; fields that are left out stay."""
    record = deps.store.lifts.get(deps.owner, lift)
    count = ask(scene_request("count_objects", record, deps)).header["count"]
    if object_id >= count:
        raise NotFound("object", expected=f"one of the lift's {count} objects", got=str(object_id))
    deps.store.selections.change_object_label(record.id, object_id, change.model_dump(exclude_unset=True))
    name, is_hidden = deps.store.selections.object_labels(deps.owner, record.id).get(object_id, (None, False))
    return models.ObjectLabel(id=object_id, name=name, hidden=is_hidden)


def _apply_edit(
    parameters: models.EditRequest | None, lift: LiftRecord, deps: AppState, ask: Ask, before: bytes
) -> SplatSet:
    """Apply an edit to a selection in the query process; without an edit, return it as it is."""
    if parameters is None:
        return SplatSet({"operation": "set"}, 0, None, before)
    if parameters.query is None:
        request = scene_request("edit", lift, deps) | NO_ENCODER
    else:
        if parameters.query.lift not in (None, lift.id):
            raise InvalidRequest(
                "edit.query.lift", expected="the lift of the selection", got=str(parameters.query.lift)
            )
        request = query_request("edit", parameters.query, lift, deps)
    edit = parameters.model_dump(mode="json", exclude={"query"}, exclude_none=True)
    if parameters.query is not None:
        edit["query"] = request["query"]
    answer = ask(request | {"edit": edit, "before": bits_of(before)})
    header = answer.header
    return SplatSet(header["edit"], header["count"], header["box"], zlib.decompress(answer.body))


def _versions(match: str | None) -> frozenset[int] | None:
    """Return the versions of an If-Match; None for any."""
    if match is None or match.strip() == "*":
        return None
    return frozenset(int(digits) for digits in re.findall(r'"(\d{1,15})"', match))


def _answer(
    selection: SelectionRecord,
    deps: AppState,
    status: int = 200,
    headers: dict[str, str] | None = None,
    *,
    bits: bool = False,
) -> Response:
    fields: dict[str, Any] = {"history": deps.store.selections.history(selection)}
    fields["bits"] = base64.b64encode(deps.store.selections.bits(selection)).decode() if bits else None
    document = models.SelectionDetail(**_summary(selection).model_dump(), **fields)
    content = document.model_dump(mode="json")
    return JSONResponse(content, status, headers=cache_headers(f'"{selection.version}"') | (headers or {}))


def _summary(selection: SelectionRecord) -> models.ListedSelection:
    path, parameters = (
        f"/lifts/{selection.lift}/selections/{selection.id}",
        f"lift={selection.lift}&sets=selection:{selection.id}",
    )
    links = {"self": path, "edits": f"{path}/edits", "query": f"/query?{parameters}"}
    links |= {"splats": f"/query/splats?{parameters}", "selection": f"/query/selection?{parameters}"}
    fields: dict[str, Any] = vars(selection) | {"links": links}
    return models.ListedSelection(**{name: fields[name] for name in models.ListedSelection.model_fields})
