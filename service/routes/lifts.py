"""/lifts and /tradeoffs: what jobs made, with the id of its job; who reads a lift; what a viewer draws of it."""

from __future__ import annotations

import hashlib
import time
from functools import partial
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse

from liftcore.errors import NotFound
from liftcore.files import in_camera_orientation
from service import models
from service.auth import bearer
from service.content import FILE, TAGGED, Cursor, Limit, cache_headers, file_answer, page_response, unchanged
from service.errors import InvalidRequest, OverLimit
from service.requests import JsonRoute
from service.routes.assets import RAW_BODY, Sha256, receive_upload
from service.routes.jobs import Key
from service.routes.queries import (
    NO_ENCODER,
    NPY,
    PLY,
    PNG,
    Ask,
    binary_response,
    scene_request,
    tagged_answer,
    with_encoder,
    with_packs,
)
from service.settings import encoder_label
from service.state import AppState, Deps
from service.store.keys import KeyRecord, Quota
from service.store.lifts import LiftRecord, TradeoffRecord
from service.store.owners import Scope
from service.uploads import LIFT, LiftIntake

MOST_SHARES = 100  # valid keys of one lift
MARKDOWN_TYPE = "text/markdown; charset=utf-8"
MARKDOWN: dict[int | str, dict[str, Any]] = {200: {"content": {MARKDOWN_TYPE: {"schema": {"type": "string"}}}}}

LiftCameras = Annotated[
    str | None,
    Query(
        pattern=models.ASSET_ID,
        description="an asset with the cameras of its views, in place of those that it was made with",
    ),
]

_BYTES = {"schema": {"type": "string", "format": "binary"}}
PHOTO: dict[int | str, dict[str, Any]] = {200: {"content": {"image/jpeg": _BYTES, "image/png": _BYTES}}}

View = Annotated[str, Query(min_length=1, max_length=models.VIEW_CHARACTERS, description="the name of a camera")]
ViewsCursor = Annotated[int, Query(ge=0, le=10**9, description="the `next` of the page before")]
Pixel = Annotated[int, Query(ge=0, le=10**9, description="of the photo: x from the left, y from the top")]
Level = Annotated[int, Query(ge=0, le=10**9, description="as in GET /lifts/{lift}/regions")]
ObjectId = Annotated[int, Path(alias="object", ge=0, le=10**9, description="the id of an object of the lift")]
ShareId = Annotated[str, Path(pattern=r"^[0-9a-f]{12}$", description="the id of a share of the lift")]
Layer = Annotated[
    Literal["pca", "cluster", "total_weight", "view_consistency", "confidence", "evidence", "agreement"],
    Query(
        description="principal components of features, clusters, or one of the others through a colour map; "
        "evidence and agreement are the old names of total_weight and view_consistency"
    ),
]

FILE_OR_ORDER: dict[str, Any] = {
    "required": True,
    "description": "an order as JSON, or a lift file itself",
    "content": {
        "application/json": {"schema": {"$ref": "#/components/schemas/LiftRequest"}},
        **RAW_BODY["requestBody"]["content"],
    },
}

router = APIRouter(route_class=JsonRoute)


@router.get("/lifts", response_model=models.Lifts, tags=["lifts"])
def list_lifts(deps: Deps, limit: Limit = models.PAGE, cursor: Cursor = None) -> Response:
    """List the lifts, newest first, in pages."""
    return page_response("lifts", partial(deps.store.lifts.page, deps.owner), shape_lift, limit=limit, cursor=cursor)


@router.post(
    "/lifts",
    response_model=models.LiftResult,
    status_code=201,
    responses={
        200: {
            "model": models.LiftResult | models.Job,
            "description": "The file was here already; or the job that the same Idempotency-Key made before",
        },
        202: {"model": models.Job, "description": "The job of an order"},
    },
    openapi_extra={"requestBody": FILE_OR_ORDER},
    tags=["lifts"],
)
async def create_lift(
    request: Request, deps: Deps, sha256: Sha256 = None, cameras: LiftCameras = None, key: Key = None
) -> Response:
    """Order a lift with a JSON body, as POST /lift does; or upload a lift file of the command line.

    The Content-Type decides between the two: application/json is an order, any other a file. ``Idempotency-Key``
    is of orders; ``sha256`` and ``cameras`` are of files.

    A file is checked whole. Its splats and its file of cameras must be assets (404 names the missing one), its
    feature packs only for examples by region. ``cameras`` names other cameras with the same poses, such as a zip of
    the folder that was lifted with.
    """
    lift, new = await receive_upload(partial(LiftIntake, cameras=cameras), LIFT, request, deps, sha256)
    location = {"Location": f"/lifts/{lift.id}"}
    return JSONResponse(shape_lift(lift).model_dump(mode="json"), 201 if new else 200, headers=location)


@router.patch("/lifts/{lift}", response_model=models.LiftResult, tags=["lifts"])
def change_lift(lift: str, change: models.LiftChange, deps: Deps) -> models.LiftResult:
    """Set a lift's name, the photos of its views, or its world frame; absent fields stay."""
    return shape_lift(deps.store.lifts.change(deps.owner, lift, change.model_dump(exclude_unset=True)))


@router.delete("/lifts/{lift}", status_code=204, tags=["lifts"])
def delete_lift(lift: str, deps: Deps) -> Response:
    """Delete a lift, its selections and its job; the assets stay."""
    record = deps.store.lifts.get(deps.owner, lift)
    deps.store.jobs.delete(deps.owner, record.id, given_up=(models.JobKind.LIFT,))
    return Response(status_code=204)


@router.get("/lifts/{lift}", response_model=models.LiftResult, tags=["lifts"])
def get_lift(lift: str, deps: Deps) -> models.LiftResult:
    """Get one lift: its settings, diagnostics and timings."""
    return shape_lift(deps.store.lifts.get(deps.owner, lift))


@router.get("/lifts/{lift}/features", response_class=Response, responses=FILE, tags=["lifts"])
def get_lift_features(lift: str, request: Request, deps: Deps) -> Response:
    """Download the lift file (safetensors), or a range of it, with the ``world`` that a PATCH set."""
    record = deps.store.lifts.get(deps.owner, lift)
    name, header = f"lift-{record.id}.safetensors", record.changed_header()
    return file_answer(request, record.path, record.bytes, record.sha256, name, header)


@router.get("/tradeoffs/{tradeoff}", response_model=models.Tradeoff, tags=["trade-offs"])
def get_tradeoff(tradeoff: str, deps: Deps) -> models.Tradeoff:
    """Get a trade-off: the runs, and the recommended ones."""
    return shape_tradeoff(deps.store.tradeoffs.get(deps.owner, tradeoff))


@router.get("/tradeoffs/{tradeoff}/chart", response_class=Response, responses=PNG | TAGGED, tags=["trade-offs"])
def get_tradeoff_chart(tradeoff: str, request: Request, deps: Deps) -> Response:
    """Draw accuracy over time, and how near each quality level is to the exact lift, as a picture."""
    record = deps.store.tradeoffs.get(deps.owner, tradeoff)
    etag = f'"{record.sha256}"'
    return unchanged(request, etag) or Response(record.chart, media_type="image/png", headers=cache_headers(etag))


@router.get("/tradeoffs/{tradeoff}/table", response_class=Response, responses=MARKDOWN, tags=["trade-offs"])
def get_tradeoff_table(tradeoff: str, deps: Deps) -> Response:
    """Get the runs as a table, with a summary and the protocol."""
    return Response(deps.store.tradeoffs.get(deps.owner, tradeoff).page, headers={"Content-Type": MARKDOWN_TYPE})


# Keys shared for one lift


@router.get("/key", response_model=models.OwnKey, tags=["keys"])
def get_key(deps: Deps) -> models.OwnKey:
    """Get the scopes and the owner of this request's key."""
    key = deps.caller.record
    if key is None:
        return models.OwnKey(name=None, scopes=[Scope.ADMIN], lifts=[], expires=None)
    return models.OwnKey(name=key.name, scopes=sorted(key.scopes), lifts=list(key.lifts), expires=key.expires)


@router.get("/lifts/{lift}/shares", response_model=models.Shares, tags=["keys"])
def list_shares(lift: str, deps: Deps) -> models.Shares:
    """List the valid keys shared for the lift, newest first, without their secrets."""
    record = deps.store.lifts.get(deps.owner, lift)
    return models.Shares(shares=[shape_share(key, record.id) for key in deps.store.keys.of_lift(record.id)])


@router.post("/lifts/{lift}/shares", response_model=models.NewShare, status_code=201, tags=["keys"])
def create_share(lift: str, share_request: models.ShareRequest, request: Request, deps: Deps) -> Response:
    """Create a key that can read and query this lift. The secret is shown once, and in a link of the page."""
    record = deps.store.lifts.get(deps.owner, lift)
    if deps.caller.record is None:
        raise InvalidRequest(
            "Authorization", expected="a service that wants keys", got="one that is open to its machine",
            hint="the operator makes a first key with splatlift keys create",
        )  # fmt: skip
    if len(deps.store.keys.of_lift(record.id)) >= MOST_SHARES:
        raise OverLimit("share", expected=f"at most {MOST_SHARES} of a lift", got="more", hint="delete some first")
    key, secret = deps.store.keys.create(
        share_request.name, frozenset({Scope.SHARED}), Quota(), expires=time.time() + share_request.expires_s,
        lifts=[record.id], maker=bearer(request.headers),
    )  # fmt: skip
    share = shape_share(key, record.id)
    # After the #, which browsers do not send: it reaches neither the log of a proxy nor another site.
    links = share.links | {"page": f"/?lift={record.id}#key={secret}"}
    reply = models.NewShare(**share.model_dump(exclude={"links"}), links=links, key=secret)
    headers = {"Location": share.links["self"], "Cache-Control": "no-store"}
    return JSONResponse(reply.model_dump(mode="json"), 201, headers=headers)


@router.delete("/lifts/{lift}/shares/{share}", status_code=204, tags=["keys"])
def delete_share(lift: str, share: ShareId, deps: Deps) -> Response:
    """Take the lift away from a key, from the next request on; a key without lifts is revoked."""
    deps.store.keys.take_away(share, deps.store.lifts.get(deps.owner, lift).id)
    return Response(status_code=204)


def shape_share(key: KeyRecord, lift: str) -> models.Share:
    """Return a shared key as its creator gets it, without its secret."""
    links = {"self": f"/lifts/{lift}/shares/{key.id}", "lift": f"/lifts/{lift}"}
    return models.Share(id=key.id, name=key.name, created=key.created, expires=key.expires, links=links)


# Files for viewers of a lift


@router.get("/lifts/{lift}/splats", responses=PLY | TAGGED, response_class=Response, tags=["lifts"])
def get_lift_splats(lift: str, request: Request, deps: Deps, ask: Ask) -> Response:
    """Download the scene for a web viewer: `.splat`, 32 bytes a splat, rows as in the lift.

    2DGS discs are thin Gaussians there, and DBS kernels the Gaussians of nearest size.
    """
    record = deps.store.lifts.get(deps.owner, lift)
    return tagged_answer(request, deps, scene_request("scene", record, deps), record, ask)


@router.get("/lifts/{lift}/colours", responses=NPY | TAGGED, response_class=Response, tags=["lifts"])
def get_lift_colours(lift: str, request: Request, deps: Deps, ask: Ask, what: Layer = "pca") -> Response:
    """Download a colour for every splat: .npy, uint8 [P, 3], sRGB. Splats without a feature are grey."""
    record = deps.store.lifts.get(deps.owner, lift)
    return tagged_answer(request, deps, scene_request("layer", record, deps) | {"what": what}, record, ask)


@router.get("/lifts/{lift}/photo", responses=PHOTO | TAGGED, response_class=Response, tags=["lifts"])
def get_photo(lift: str, view: View, request: Request, deps: Deps, ask: Ask) -> Response:
    """Download the photo of a view, as it was uploaded.

    Where its camera is of the stored pixels, an EXIF orientation becomes 1, so that no browser turns the photo.
    """

    def camera_size() -> tuple[int, int] | None:
        cameras = ask(scene_request("views", record, deps) | {"view": view}).header["views"]
        return (cameras[0]["width"], cameras[0]["height"]) if cameras else None

    record = deps.store.lifts.get(deps.owner, lift)
    zipped = None if record.photos is None else deps.store.assets.get(deps.owner, record.photos)
    photo = None if zipped is None else deps.photos.of(zipped.path).open(view)
    if zipped is None or photo is None:
        got, hint = f"none of {view!r}"[:200], "PUT /assets/photos, then PATCH /lifts/{lift} with its id"
        raise NotFound("view", expected="a view of which the lift has a photo", got=got, hint=hint)
    media_type, size, blocks = photo
    blocks, is_changed = in_camera_orientation(blocks, camera_size)
    etag = f'"{hashlib.sha256(f"{zipped.id} {view} {is_changed}".encode()).hexdigest()}"'
    headers = cache_headers(etag) | {"Content-Length": str(size)}
    return unchanged(request, etag) or StreamingResponse(blocks, media_type=media_type, headers=headers)


def _with_photo(deps: AppState, lift: LiftRecord, views: list[str]) -> set[str]:
    if lift.photos is None:
        return set()
    return deps.photos.of(deps.store.assets.get(deps.owner, lift.photos).path).names(views)


@router.get("/lifts/{lift}/views", response_model=models.Views, tags=["lifts"])
def list_views(lift: str, deps: Deps, ask: Ask, limit: Limit = models.PAGE, cursor: ViewsCursor = 0) -> models.Views:
    """List the cameras of the scene with their poses, in pages; also those that were not lifted."""
    record = deps.store.lifts.get(deps.owner, lift)
    answer = ask(scene_request("views", record, deps) | {"first": cursor, "count": limit}).header
    names = [view["name"] for view in answer["views"]]
    lifted, photos = deps.store.lifts.lifted(deps.owner, lift, names), _with_photo(deps, record, names)
    views = [
        models.View(lifted=view["name"] in lifted, photo=view["name"] in photos, **view) for view in answer["views"]
    ]
    return models.Views(views=views, next=cursor + limit if answer["more"] else None)


@router.get("/lifts/{lift}/regions", response_model=models.CoveringRegions, tags=["lifts"])
def list_regions(lift: str, view: View, x: Pixel, y: Pixel, deps: Deps, ask: Ask) -> models.CoveringRegions:
    """List the regions of the lift's feature packs at a pixel of a view's photo: each is an example for queries."""
    record = deps.store.lifts.get(deps.owner, lift)
    request = with_packs(scene_request("regions", record, deps), record, deps, "lift") | {
        "view": view,
        "x": x,
        "y": y,
    }
    return models.CoveringRegions(lift=record.id, view=view, **ask(request).header)


@router.get("/lifts/{lift}/regions/mask", responses=PNG | TAGGED, response_class=Response, tags=["lifts"])
def get_region_mask(
    lift: str, view: View, level: Level, region: Level, request: Request, deps: Deps, ask: Ask
) -> Response:
    """Draw the pixels of a view's photo that one region covers: a PNG, white inside."""
    record = deps.store.lifts.get(deps.owner, lift)
    worker_request = with_packs(scene_request("region_mask", record, deps), record, deps, "lift")
    worker_request |= {"view": view, "level": level, "region": region}
    return tagged_answer(request, deps, worker_request, record, ask)


@router.get("/lifts/{lift}/objects", response_model=models.SceneObjects, tags=["lifts"])
def list_objects(
    lift: str, deps: Deps, ask: Ask, options: Annotated[models.SceneObjectsRequest, Query()]
) -> Response:
    """List the objects of the scene, found by masks when it was lifted; a vocabulary names them."""
    labels = list(deps.store.selections.object_labels(deps.owner, deps.store.lifts.get(deps.owner, lift).id).items())
    fields = {"means": options.features, "object_labels": labels, "splat": options.splat}
    return _nodes("catalogue", lift, deps, ask, options, **fields)


@router.get("/lifts/{lift}/tree", response_model=models.LiftTree, tags=["lifts"])
def get_tree(lift: str, deps: Deps, ask: Ask, options: Annotated[models.TreeRequest, Query()]) -> Response:
    """Get the objects with their parts and their groups, objects first; nodes have splats as objects have.

    With `relations`, how the objects lie to each other.
    """
    return _nodes(
        "tree", lift, deps, ask, options, relations=options.relations or options.up is not None, up=options.up
    )


def _nodes(operation: str, lift: str, deps: Deps, ask: Ask, options: models.NodesRequest, **fields: Any) -> Response:
    record = deps.store.lifts.get(deps.owner, lift)
    request: dict[str, Any] = scene_request(operation, record, deps) | NO_ENCODER | {"words": None}
    if options.table is not None or options.encoder is not None:
        request = with_encoder(request, options, record, deps)
    encoder = None if request["encoder"] is None else encoder_label(request["encoder"])
    request |= {"first": options.cursor, "count": options.limit, **fields}
    return binary_response(deps, request | {"head": {"lift": record.id, "encoder": encoder}}, record, ask, {})


@router.get("/lifts/{lift}/objects/{object}/splats", responses=PLY | TAGGED, response_class=Response, tags=["lifts"])
def get_object_splats(lift: str, object_id: ObjectId, request: Request, deps: Deps, ask: Ask) -> Response:
    """Download the splats of one object: a PLY of the dialect that was lifted."""
    record = deps.store.lifts.get(deps.owner, lift)
    worker_request = scene_request("splats", record, deps) | {"what": f"object-{object_id}", "object": object_id}
    return tagged_answer(request, deps, worker_request, record, ask)


def shape_lift(lift: LiftRecord) -> models.LiftResult:
    """Return a lift as clients get it, without private paths."""
    path = f"/lifts/{lift.id}"
    links = {"self": path, "job": f"/jobs/{lift.id}", "features": f"{path}/features"}
    links |= {"views": f"{path}/views", "objects": f"{path}/objects", "tree": f"{path}/tree"}
    links |= {"query": f"/query?lift={lift.id}&text="}
    fields = {
        "views": [],
        "words": [],
        "origin": (0.0, 0.0, 0.0),
        "world": {},
        **lift.metadata,
        **vars(lift),
        "links": links,
    }
    return models.LiftResult(**{name: fields[name] for name in models.LiftResult.model_fields})


def shape_tradeoff(tradeoff: TradeoffRecord) -> models.Tradeoff:
    """Return a trade-off as clients get it."""
    path = f"/tradeoffs/{tradeoff.id}"
    links = {"self": path, "job": f"/jobs/{tradeoff.id}", "chart": f"{path}/chart", "table": f"{path}/table"}
    names = ("id", "splats", "cameras", "features", "labels", "created")
    fields = {name: getattr(tradeoff, name) for name in names}
    return models.Tradeoff.model_validate({**tradeoff.document, **fields, "links": links})
