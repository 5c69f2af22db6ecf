"""/lifts/{lift}/shares: keys that others read one lift with; and /key, what the key of a request may do."""

from __future__ import annotations

import time
from typing import Annotated

from fastapi import APIRouter, Path, Response
from fastapi.responses import JSONResponse

from service import models
from service.errors import InvalidRequest, OverLimit
from service.requests import JsonRoute
from service.state import Deps
from service.store.keys import KeyRecord, Quota
from service.store.owners import Scope

MOST_SHARES = 100  # of a lift that are valid
ShareId = Annotated[str, Path(pattern=r"^[0-9a-f]{12}$", description="the id of a share of the lift")]

router = APIRouter(tags=["keys"], route_class=JsonRoute)


@router.get("/key", response_model=models.OwnKey)
def get_key(deps: Deps) -> models.OwnKey:
    """What the key of this request may do, and whose it is."""
    key = deps.caller.record
    if key is None:
        return models.OwnKey(name=None, scopes=[Scope.ADMIN], lifts=[], expires=None)
    return models.OwnKey(name=key.name, scopes=sorted(key.scopes), lifts=list(key.lifts), expires=key.expires)


@router.get("/lifts/{lift}/shares", response_model=models.Shares)
def list_shares(lift: str, deps: Deps) -> models.Shares:
    """The keys that the lift was given to and that are valid, newest first, without their secrets."""
    found = deps.store.lifts.get(deps.owner, lift)
    return models.Shares(shares=[_shape(key, found.id) for key in deps.store.keys.of_lift(found.id)])


@router.post("/lifts/{lift}/shares", response_model=models.NewShare, status_code=201)
def create_share(lift: str, asked: models.AskedShare, deps: Deps) -> Response:
    """Make a key that looks at this lift and asks it. It is shown this once, and in a link of the page."""
    found = deps.store.lifts.get(deps.owner, lift)
    if deps.caller.key is None:
        raise InvalidRequest(
            "Authorization", expected="a service that wants keys", got="one that is open to its machine",
            hint="the operator makes a first key with splatlift keys create",
        )  # fmt: skip
    if len(deps.store.keys.of_lift(found.id)) >= MOST_SHARES:
        raise OverLimit("share", expected=f"at most {MOST_SHARES} of a lift", got="more", hint="delete some first")
    key, secret = deps.store.keys.create(
        asked.name, frozenset({Scope.SHARED}), Quota(), expires=time.time() + asked.expires_s,
        lifts=[found.id], maker=deps.caller.key,
    )  # fmt: skip
    share = _shape(key, found.id)
    # After the #, which browsers send nobody: neither the log of a proxy nor another site comes to know it.
    links = share.links | {"page": f"/?lift={found.id}#key={secret}"}
    made = models.NewShare(**share.model_dump(exclude={"links"}), links=links, key=secret)
    headers = {"Location": share.links["self"], "Cache-Control": "no-store"}
    return JSONResponse(made.model_dump(mode="json"), 201, headers=headers)


@router.delete("/lifts/{lift}/shares/{share}", status_code=204)
def delete_share(lift: str, share: ShareId, deps: Deps) -> Response:
    """Take the lift away from a key, from the next request on; a key that then has none ends."""
    deps.store.keys.take_away(share, deps.store.lifts.get(deps.owner, lift).id)
    return Response(status_code=204)


def _shape(key: KeyRecord, lift: str) -> models.Share:
    links = {"self": f"/lifts/{lift}/shares/{key.id}", "lift": f"/lifts/{lift}"}
    return models.Share(id=key.id, name=key.name, created=key.created, expires=key.expires, links=links)
