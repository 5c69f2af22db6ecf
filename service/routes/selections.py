"""/lifts/{lift}/selections: sets of splats that are corrected by hand; and names of the lift's things."""

from __future__ import annotations

import base64
import re
import zlib
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Query, Response
from fastapi.responses import JSONResponse

from liftcore.errors import NotFound
from service import models
from service.content import kept
from service.errors import Changed, Conflict, InvalidRequest
from service.requests import JsonRoute
from service.routes.lifts import ObjectId
from service.routes.queries import NO_ENCODER, Ask, bits_of, query_request, scene_request
from service.state import AppState, Deps
from service.store.lifts import LiftRecord
from service.store.selections import SelectionRecord, SplatSet

ONE = "/lifts/{lift}/selections/{selection}"
SelectionId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$", description="the id of a selection of the lift")]
IfMatch = Annotated[
    str | None,
    Header(alias="If-Match", max_length=1000, description="the ETag of the version that is to be changed; else 412"),
]

router = APIRouter(tags=["selections"], route_class=JsonRoute)


@router.get("/lifts/{lift}/selections", response_model=models.Selections)
def list_selections(lift: str, deps: Deps) -> models.Selections:
    """The selections of a lift, newest first."""
    found = deps.store.lifts.get(deps.owner, lift)
    selections = deps.store.selections.all(deps.owner, found.id)
    return models.Selections(selections=[_listed(one) for one in selections])


@router.post("/lifts/{lift}/selections", response_model=models.SelectionDetail, status_code=201)
def create_selection(lift: str, asked: models.NewSelection, deps: Deps, ask: Ask) -> Response:
    """Begin a selection, with the splats of an edit or with none. Questions name it as `sets=selection:ID`."""
    found = deps.store.lifts.get(deps.owner, lift)
    splats = _edited(asked.edit, found, deps, ask, bytes(-(-found.count // 8)))
    made = deps.store.selections.create(deps.owner, found.id, asked.name, splats)
    return _answer(made, deps, 201, {"Location": f"/lifts/{found.id}/selections/{made.id}"})


@router.get(ONE, response_model=models.SelectionDetail)
def get_selection(
    lift: str,
    selection: SelectionId,
    deps: Deps,
    bits: Annotated[bool, Query(description="with its splats, a bit for each of the lift's")] = False,
) -> Response:
    """One selection: what it holds, and the steps that made it."""
    found = deps.store.lifts.get(deps.owner, lift)
    return _answer(deps.store.selections.get(deps.owner, found.id, selection), deps, bits=bits)


@router.post(ONE + "/edits", response_model=models.SelectionDetail)
def edit_selection(
    lift: str, selection: SelectionId, asked: models.AskedEdit, deps: Deps, ask: Ask, match: IfMatch = None
) -> Response:
    """Add, take away, grow, shrink or set: a step of its history, which PATCH goes back."""
    found = deps.store.lifts.get(deps.owner, lift)
    before = deps.store.selections.get(deps.owner, found.id, selection, _versions(match))
    splats = _edited(asked, found, deps, ask, deps.store.selections.bits(before))
    try:  # what was worked on is the version that was read: another that came meanwhile is not overwritten
        made = deps.store.selections.extend(deps.owner, found.id, selection, splats, frozenset({before.version}))
    except Changed as error:
        if _versions(match) is not None:
            raise
        hint = "send the edit again"
        raise Conflict("selection", expected=error.expected, got="one that another edit changed", hint=hint) from None
    return _answer(made, deps)


@router.patch(ONE, response_model=models.SelectionDetail)
def change_selection(
    lift: str, selection: SelectionId, change: models.SelectionChange, deps: Deps, match: IfMatch = None
) -> Response:
    """Give it another name, or go to another step of its history: undo and redo."""
    found = deps.store.lifts.get(deps.owner, lift)
    changes = change.model_dump(exclude_unset=True, exclude_none=True)
    made = deps.store.selections.change(deps.owner, found.id, selection, changes, _versions(match))
    return _answer(made, deps)


@router.delete(ONE, status_code=204)
def delete_selection(lift: str, selection: SelectionId, deps: Deps, match: IfMatch = None) -> Response:
    """Forget a selection and its history."""
    found = deps.store.lifts.get(deps.owner, lift)
    deps.store.selections.delete(deps.owner, found.id, selection, _versions(match))
    return Response(status_code=204)


@router.patch("/lifts/{lift}/objects/{thing}", response_model=models.Thing)
def change_thing(lift: str, thing: ObjectId, change: models.ThingChange, deps: Deps, ask: Ask) -> models.Thing:
    """Give a thing of a lift a name of your own, or hide it from lists; what is left out stays."""
    found = deps.store.lifts.get(deps.owner, lift)
    listed = ask(scene_request("count_objects", found, deps)).header["count"]
    if thing >= listed:
        raise NotFound("thing", expected=f"one of the lift's {listed} objects", got=str(thing))
    deps.store.selections.change_thing(found.id, thing, change.model_dump(exclude_unset=True))
    name, hidden = deps.store.selections.things(deps.owner, found.id).get(thing, (None, False))
    return models.Thing(id=thing, name=name, hidden=hidden)


def _edited(asked: models.AskedEdit | None, lift: LiftRecord, deps: AppState, ask: Ask, before: bytes) -> SplatSet:
    """The splats after an edit of those before, by the query process; without one those."""
    if asked is None:
        return SplatSet({"how": "set"}, 0, None, before)
    if asked.query is None:
        wanted = scene_request("edit", lift, deps) | NO_ENCODER
    else:
        if asked.query.lift not in (None, lift.id):
            raise InvalidRequest("edit.query.lift", expected="the lift of the selection", got=str(asked.query.lift))
        wanted = query_request("edit", asked.query, lift, deps)
    edit = asked.model_dump(mode="json", exclude={"query"}, exclude_none=True)
    if asked.query is not None:
        edit["query"] = wanted["query"]
    answer = ask(wanted | {"edit": edit, "before": bits_of(before)})
    told = answer.header
    return SplatSet(told["edit"], told["count"], told["box"], zlib.decompress(answer.body))


def _versions(match: str | None) -> frozenset[int] | None:
    """The versions that an If-Match names; None for any."""
    if match is None or match.strip() == "*":
        return None
    return frozenset(int(one) for one in re.findall(r'"(\d{1,15})"', match))


def _answer(
    found: SelectionRecord,
    deps: AppState,
    status: int = 200,
    headers: dict[str, str] | None = None,
    *,
    bits: bool = False,
) -> Response:
    more: dict[str, Any] = {"history": deps.store.selections.history(found)}
    more["bits"] = base64.b64encode(deps.store.selections.bits(found)).decode() if bits else None
    made = models.SelectionDetail(**_listed(found).model_dump(), **more)
    content = made.model_dump(mode="json")
    return JSONResponse(content, status, headers=kept(f'"{found.version}"') | (headers or {}))


def _listed(found: SelectionRecord) -> models.ListedSelection:
    own, asked = f"/lifts/{found.lift}/selections/{found.id}", f"lift={found.lift}&sets=selection:{found.id}"
    links = {"self": own, "edits": f"{own}/edits", "query": f"/query?{asked}"}
    links |= {"splats": f"/query/splats?{asked}", "selection": f"/query/selection?{asked}"}
    told: dict[str, Any] = vars(found) | {"links": links}
    return models.ListedSelection(**{name: told[name] for name in models.ListedSelection.model_fields})
