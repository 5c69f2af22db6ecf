"""/lifts/{lift}/splats, /colours and /views: what a viewer draws of a lift."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import anyio
from fastapi import APIRouter, Query, Request, Response

from service import models
from service.content import TAGGED, Limit
from service.routes.queries import NPY, PLY, Ask, scene_request, tagged_answer
from service.state import Deps

VIEWS = 1000  # a page of them, unless another number is asked for

router = APIRouter(prefix="/lifts/{lift}", tags=["lifts"])
ViewsCursor = Annotated[int, Query(ge=0, le=10**9, description="the `next` of the page before")]
Layer = Annotated[
    Literal["pca", "cluster", "evidence", "agreement"],
    Query(description="principal components of features, clusters, or evidence or agreement through a colour map"),
]


@router.get("/splats", responses=PLY | TAGGED, response_class=Response)
def splats(lift: str, request: Request, deps: Deps, ask: Ask) -> Response:
    """The scene for a web viewer: `.splat`, 32 bytes a splat, rows as in the lift.

    2DGS discs are thin Gaussians there, and DBS kernels the Gaussians of nearest size.
    """
    found = deps.store.lifts.get(deps.owner, lift)
    return tagged_answer(request, deps, scene_request("scene", found, deps), found, ask)


@router.get("/colours", responses=NPY | TAGGED, response_class=Response)
def colours(lift: str, request: Request, deps: Deps, ask: Ask, what: Layer = "pca") -> Response:
    """A colour for every splat: .npy, uint8 [P, 3], sRGB. Splats without a feature are grey."""
    found = deps.store.lifts.get(deps.owner, lift)
    return tagged_answer(request, deps, scene_request("layer", found, deps) | {"what": what}, found, ask)


@router.get("/views", response_model=models.Views)
async def views(lift: str, deps: Deps, ask: Ask, limit: Limit = VIEWS, cursor: ViewsCursor = 0) -> models.Views:
    """The cameras of the scene with their poses, in pages; also those that were not lifted."""
    most = limit or VIEWS

    def page() -> dict[str, Any]:
        found = deps.store.lifts.get(deps.owner, lift)
        return ask(scene_request("views", found, deps) | {"first": cursor, "count": most}).header

    answer = await anyio.to_thread.run_sync(page)
    names = [view["name"] for view in answer["views"]]
    lifted = await anyio.to_thread.run_sync(deps.store.lifts.lifted, deps.owner, lift, names, limiter=deps.naming)
    told = [models.View(lifted=view["name"] in lifted, **view) for view in answer["views"]]
    return models.Views(views=told, next=cursor + most if answer["more"] else None)
