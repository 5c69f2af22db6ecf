"""/lifts and /tradeoffs: what jobs made. A result has the id of its job."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import JSONResponse

from liftcore.scene.origin import FILE_ORIGIN
from service import limits, models
from service.content import FILE, TAGGED, Cursor, Limit, StoredFile, file_answer, kept, listed, unchanged
from service.requests import JsonRoute
from service.routes.assets import RAW_BODY, Sha256, taken
from service.routes.queries import PNG
from service.state import Deps
from service.store.lifts import LiftRecord, TradeoffRecord
from service.uploads import LIFT
from service.uploads.intake import LiftIntake

MARKDOWN_TYPE = "text/markdown; charset=utf-8"
MARKDOWN: dict[int | str, dict[str, Any]] = {200: {"content": {MARKDOWN_TYPE: {"schema": {"type": "string"}}}}}

LiftCameras = Annotated[
    str | None,
    Query(
        pattern=models.ASSET_ID,
        description="an asset with the cameras of its views, in place of those that it was made with",
    ),
]

router = APIRouter(route_class=JsonRoute)


@router.get("/lifts", response_model=models.Lifts, tags=["lifts"])
def list_lifts(deps: Deps, limit: Limit = limits.PAGE, cursor: Cursor = None) -> Response:
    """The lifts, newest first, in pages."""
    return listed("lifts", partial(deps.store.lifts.page, deps.owner), shape_lift, limit=limit, cursor=cursor)


@router.post(
    "/lifts",
    response_model=models.LiftResult,
    status_code=201,
    responses={200: {"model": models.LiftResult, "description": "It was here already"}},
    openapi_extra=RAW_BODY,
    tags=["lifts"],
)
async def upload_lift(request: Request, deps: Deps, sha256: Sha256 = None, cameras: LiftCameras = None) -> Response:
    """Bring a lift file of the command line, which is checked whole.

    Its splats and its file of cameras must be assets (404 names the missing one), its feature packs only for examples
    by region. ``cameras`` names other cameras with the same poses, such as a zip of the folder that was lifted with.
    """
    lift, new = await taken(partial(LiftIntake, cameras=cameras), LIFT, request, deps, sha256)
    location = {"Location": f"/lifts/{lift.id}"}
    return JSONResponse(shape_lift(lift).model_dump(mode="json"), 201 if new else 200, headers=location)


@router.patch(
    "/lifts/{lift}",
    response_model=models.LiftResult,
    tags=["lifts"],
)
def change_lift(lift: str, change: models.LiftChange, deps: Deps) -> models.LiftResult:
    """Give a lift a name, or photos of its views; what is left out stays."""
    return shape_lift(deps.store.lifts.change(deps.owner, lift, change.model_dump(exclude_unset=True)))


@router.get("/lifts/{lift}", response_model=models.LiftResult, tags=["lifts"])
def get_lift(lift: str, deps: Deps) -> models.LiftResult:
    """One lift: its settings, certificate and timings."""
    return shape_lift(deps.store.lifts.get(deps.owner, lift))


@router.get("/lifts/{lift}/features", response_class=Response, responses=FILE, tags=["lifts"])
def get_features(lift: str, request: Request, deps: Deps) -> Response:
    """The lift file (safetensors), or a range of it."""
    found = deps.store.lifts.get(deps.owner, lift)
    return file_answer(request, StoredFile(found.path, found.bytes, found.sha256, f"lift-{found.id}.safetensors"))


@router.get("/tradeoffs/{tradeoff}", response_model=models.Tradeoff, tags=["trade-offs"])
def get_tradeoff(tradeoff: str, deps: Deps) -> models.Tradeoff:
    """What was found: the runs, and which to take."""
    return shape_tradeoff(deps.store.tradeoffs.get(deps.owner, tradeoff))


@router.get("/tradeoffs/{tradeoff}/chart", response_class=Response, responses=PNG | TAGGED, tags=["trade-offs"])
def get_chart(tradeoff: str, request: Request, deps: Deps) -> Response:
    """Accuracy over time, and how near the dial stays to the exact lift, as a picture."""
    found = deps.store.tradeoffs.get(deps.owner, tradeoff)
    etag = f'"{found.sha256}"'
    return unchanged(request, etag) or Response(found.chart, media_type="image/png", headers=kept(etag))


@router.get("/tradeoffs/{tradeoff}/table", response_class=Response, responses=MARKDOWN, tags=["trade-offs"])
def get_table(tradeoff: str, deps: Deps) -> Response:
    """The runs as a table, with what it says and how it was made."""
    return Response(deps.store.tradeoffs.get(deps.owner, tradeoff).page, headers={"Content-Type": MARKDOWN_TYPE})


def shape_lift(lift: LiftRecord) -> models.LiftResult:
    """A lift as clients get it; paths of this machine stay here."""
    own = f"/lifts/{lift.id}"
    links = {"self": own, "job": f"/jobs/{lift.id}", "features": f"{own}/features"}
    links |= {"views": f"{own}/views", "objects": f"{own}/objects", "query": f"/query?lift={lift.id}&text="}
    told = {"views": [], "words": [], "origin": FILE_ORIGIN, **lift.metadata, **vars(lift), "links": links}
    return models.LiftResult(**{name: told[name] for name in models.LiftResult.model_fields})


def shape_tradeoff(tradeoff: TradeoffRecord) -> models.Tradeoff:
    """A trade-off as clients get it."""
    own = f"/tradeoffs/{tradeoff.id}"
    links = {"self": own, "job": f"/jobs/{tradeoff.id}", "chart": f"{own}/chart", "table": f"{own}/table"}
    ours = ("id", "splats", "cameras", "features", "labels", "created")
    told = {name: getattr(tradeoff, name) for name in ours}
    return models.Tradeoff.model_validate({**tradeoff.document, **told, "links": links})
