"""/lifts/{lift}/splats, /colours and /views: what a viewer draws of a lift."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response

from service import models
from service.content import TAGGED, Limit, unchanged
from service.routes.queries import NPY, PLY, drafted, entity, entity_tag, scene_request
from service.state import Deps

ROW_BYTES = 32  # of a splat in the .splat format
VIEWS = 1000  # a page of them, unless another number is asked for

router = APIRouter(prefix="/lifts/{lift}", tags=["lifts"])
ViewsCursor = Annotated[int, Query(ge=0, le=10**9, description="the `next` of the page before")]
Layer = Annotated[
    Literal["pca", "cluster", "evidence", "agreement"],
    Query(description="principal components of features, clusters, or evidence or agreement through a colour map"),
]


@router.get("/splats", responses=PLY | TAGGED, response_class=Response)
def splats(lift: str, request: Request, deps: Deps) -> Response:
    """The scene for a web viewer: `.splat`, 32 bytes a splat, rows as in the lift.

    2DGS discs are thin Gaussians there, and DBS kernels the Gaussians of nearest size.
    """
    found = deps.store.lifts.get(deps.owner, lift)
    wanted = scene_request("scene", found, deps)
    etag = entity_tag(wanted, found)
    same = unchanged(request, etag, found=False)
    if same is not None:
        return same
    return drafted(deps, wanted, ROW_BYTES * found.count, f"scene-{found.id}.splat", etag)


@router.get("/colours", responses=NPY | TAGGED, response_class=Response)
def colours(lift: str, request: Request, deps: Deps, what: Layer = "pca") -> Response:
    """A colour for every splat: .npy, uint8 [P, 3], sRGB. Splats without a feature are grey."""
    found = deps.store.lifts.get(deps.owner, lift)
    return entity(request, deps, scene_request("layer", found, deps) | {"what": what}, found)


@router.get("/views", response_model=models.Views)
def views(lift: str, deps: Deps, limit: Limit = VIEWS, cursor: ViewsCursor = 0) -> models.Views:
    """The cameras of the scene with their poses, in pages; also those that were not lifted."""
    found, most = deps.store.lifts.get(deps.owner, lift), limit or VIEWS
    wanted = scene_request("views", found, deps) | {"first": cursor, "count": most}
    answer, lifted = deps.queries.call(wanted).header, set(found.metadata["views"])
    told = [models.View(lifted=view["name"] in lifted, **view) for view in answer["views"]]
    return models.Views(views=told, next=cursor + most if answer["more"] else None)
