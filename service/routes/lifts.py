"""/lifts and /tradeoffs: what jobs made; /key and shares: who reads a lift; what a viewer draws of it."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi import Path as PathParameter
from fastapi.responses import StreamingResponse
from starlette.convertors import register_url_convertor

from liftcore.errors import NotFound
from liftcore.files import in_camera_orientation, photo_index
from service import models, results
from service.models import Lift
from service.routes import (
    BINARY,
    Caller,
    CallerKey,
    Deps,
    Limit,
    Number,
    OneOf,
    Parts,
    add_list,
    cache_headers,
    content_of,
    file_answer,
    unchanged,
)
from service.routes.assets import UPLOAD, check_upload, in_thread, receive_upload
from service.routes.queries import NO_ENCODER, NPY, PNG, labels_of, respond, scene_request, with_encoder
from service.settings import encoder_label
from service.store import SERVICE, Owner

LiftCameras = Annotated[
    str | None,
    Query(
        pattern=models.ASSET_ID,
        description="an asset with the cameras of its views, in place of those that it was made with",
    ),
]
View = Annotated[str, Query(min_length=1, max_length=models.VIEW_CHARACTERS, description="the name of a camera")]
ShareId = Annotated[str, PathParameter(pattern=r"^[0-9a-f]{12}$", description="the id of a share of the lift")]
Layer = Annotated[
    Literal["pca", "cluster", "total_weight", "confidence"],
    Query(description="of colours: principal components of features, clusters, or another through a colour map"),
]
REPEATED: dict[int | str, dict[str, Any]] = {200: {"model": Lift, "description": "It was here already"}}

router = APIRouter(tags=["lifts"])
add_list(router, "lifts", Lift, Lift.of_row)


@router.post("/lifts", status_code=201, responses=REPEATED, **UPLOAD)
async def create_lift(
    request: Request, response: Response, deps: Deps, owner: Caller, cameras: LiftCameras = None
) -> Lift:
    """Upload a lift file of the command line. It is checked whole.

    Its splats and its file of cameras must be assets (404 names the missing one). ``cameras`` names other cameras
    with the same poses, such as a zip of the folder that was lifted with.
    """
    async with receive_upload(request, deps) as (draft, digest):
        lift = await in_thread(deps, results.find_lift_file, deps.store, owner, digest)
        if lift is not None:
            response.status_code = 200
        else:
            others = None
            if cameras is not None:
                others = await in_thread(deps, deps.store.asset, owner, cameras, "cameras")
            content = await check_upload(deps, "lift", draft, others)
            lift = await in_thread(deps, results.add_lift, deps.store, owner, draft, content, cameras)
    response.headers["Location"] = f"/lifts/{lift.id}"
    return lift


@router.patch("/lifts/{lift}")
def change_lift(lift: str, change: models.LiftChange, deps: Deps, owner: Caller) -> Lift:
    """Set a lift's name, the photos of its views, or its world frame; absent fields stay."""
    return results.change_lift(deps.store, owner, lift, change.model_dump(mode="json", exclude_unset=True))


@router.get("/lifts/{lift}")
def get_lift(lift: str, deps: Deps, owner: Caller) -> Lift:
    """Get one lift: its settings, diagnostics and timings."""
    return deps.store.lift(owner, lift)


@router.get("/lifts/{lift}/features", response_class=Response, responses=content_of(BINARY))
def get_lift_features(lift: str, request: Request, deps: Deps, owner: Caller) -> Response:
    """Download the lift file (safetensors) as it was made, or a range of it."""
    record = deps.store.lift(owner, lift)
    return file_answer(request, record.file, record.bytes, record.sha256, f"lift-{record.id}.safetensors")


@router.get("/tradeoffs/{tradeoff}", tags=["trade-offs"])
def get_tradeoff(tradeoff: str, deps: Deps, owner: Caller) -> models.Tradeoff:
    """Get a trade-off: the runs, and the recommended ones."""
    return results.get_tradeoff(deps.store, owner, tradeoff)[0]


@router.get(
    "/tradeoffs/{tradeoff}/chart", response_class=Response, responses=content_of(PNG), tags=["trade-offs"]
)  # fmt: skip
def get_tradeoff_chart(tradeoff: str, request: Request, deps: Deps, owner: Caller) -> Response:
    """Draw accuracy over time, and how near each quality level is to the exact lift, as a picture."""
    chart = results.get_tradeoff(deps.store, owner, tradeoff)[1]
    etag = f'"{hashlib.sha256(chart).hexdigest()}"'
    return unchanged(request, etag) or Response(chart, media_type=PNG, headers=cache_headers(etag))


# Keys shared for one lift


@router.get("/key", tags=["keys"])
def get_key(key: CallerKey) -> models.OwnKey:
    """Get the scopes and the owner of this request's key."""
    if key is None:
        return models.OwnKey(name=None, scopes=["admin"], lifts=[], expires=None)
    return models.OwnKey(name=key.name, scopes=key.scopes.split(), lifts=key.lifts, expires=key.expires)


@router.get("/lifts/{lift}/shares", tags=["keys"])
def list_shares(lift: str, deps: Deps, owner: Caller) -> models.Shares:
    """List the valid keys shared for the lift, newest first, without their secrets."""
    return models.Shares(shares=results.list_shares(deps.store, deps.store.lift(owner, lift).id))


@router.post("/lifts/{lift}/shares", status_code=201, tags=["keys"])
def create_share(
    lift: str, share: models.ShareRequest, response: Response, deps: Deps, owner: Caller, key: CallerKey
) -> models.NewShare:
    """Create a key that can read and query this lift. The secret is shown once, and in a link of the page."""
    response.headers["Cache-Control"] = "no-store"
    return results.create_share(deps.store, key, deps.store.lift(owner, lift).id, share.name, share.expires_s)


@router.delete("/lifts/{lift}/shares/{share}", status_code=204, tags=["keys"])
def delete_share(lift: str, share: ShareId, deps: Deps, owner: Caller) -> None:
    """Take the lift away from a key, from the next request on; a key without lifts is revoked."""
    results.delete_share(deps.store, deps.store.lift(owner, lift).id, share)


# What viewers of a lift read


@router.get("/lifts/{lift}/photo", responses=content_of("image/jpeg", PNG), response_class=Response)
def get_photo(lift: str, view: View, request: Request, deps: Deps, owner: Caller) -> Response:
    """Download the photo of a view, as it was uploaded.

    Where its camera is of the stored pixels, an EXIF orientation becomes 1, so that no browser turns the photo.
    """

    def camera_size() -> tuple[int, int] | None:
        order = scene_request("views", record, deps) | {"view": view, "range": (0, 0)}
        views = deps.queries.call(order)["views"]
        return (views[0]["width"], views[0]["height"]) if views else None

    record = deps.store.lift(owner, lift)
    photos = None if record.photos is None else deps.store.asset(SERVICE, record.photos)
    photo = None if photos is None else photo_index(photos.file).open(view)
    if photos is None or photo is None:
        got, hint = f"none of {view!r}"[:200], "PUT /assets/photos, then PATCH /lifts/{lift} with its id"
        raise NotFound("view", expected="a view of which the lift has a photo", got=got, hint=hint)
    media_type, size, blocks = photo
    blocks, is_changed = in_camera_orientation(blocks, camera_size)
    etag = f'"{hashlib.sha256(f"{photos.id} {view} {is_changed}".encode()).hexdigest()}"'
    headers = cache_headers(etag) | ({} if is_changed else {"Content-Length": str(size)})
    return unchanged(request, etag) or StreamingResponse(blocks, media_type=media_type, headers=headers)


@router.get("/lifts/{lift}/views")
def list_views(lift: str, deps: Deps, owner: Caller, limit: Limit = models.PAGE, cursor: Number = 0) -> models.Views:
    """List the cameras of the scene with their poses, in pages; also those that were not lifted."""
    record = deps.store.lift(owner, lift)
    value = deps.queries.call(scene_request("views", record, deps) | {"range": (cursor, limit)})
    names = [view["name"] for view in value["views"]]
    photos: set[str] = set()
    if record.photos is not None:
        photos = photo_index(deps.store.asset(SERVICE, record.photos).file).names(names)
    views = [models.View(**view | {"photo": view["name"] in photos}) for view in value["views"]]
    return models.Views(views=views, next=value["next"])


@router.get("/lifts/{lift}/objects", response_model=models.SceneObjects)
def list_objects(
    lift: str, request: Request, deps: Deps, owner: Caller, options: Annotated[models.NodesRequest, Query()]
) -> Response:
    """List the objects of the scene, found by masks when it was lifted; a vocabulary names them."""
    return respond(request, deps, _nodes("scene_objects", deps.store.lift(owner, lift), deps, owner, options))


@router.get("/lifts/{lift}/tree", response_model=models.LiftTree)
def get_tree(
    lift: str, request: Request, deps: Deps, owner: Caller, options: Annotated[models.NodesRequest, Query()]
) -> Response:
    """Get the objects with their parts and their groups, objects first; nodes have splats as objects have."""
    return respond(request, deps, _nodes("tree", deps.store.lift(owner, lift), deps, owner, options))


def _nodes(operation: str, lift: Lift, deps: Parts, owner: Owner, options: models.NodesRequest) -> dict[str, Any]:
    order: dict[str, Any] = scene_request(operation, lift, deps) | NO_ENCODER
    if options.table is not None or options.encoder is not None:
        order = with_encoder(order, options, lift, deps, owner)
    encoder = None if order["encoder"] is None else encoder_label(order["encoder"])
    head = {"lift": lift.id, "encoder": encoder}
    order |= {"object_labels": labels_of(lift, deps), "head": head}
    return order | {"first": options.cursor, "count": options.limit}


register_url_convertor("file", OneOf("splats", "colours"))


@router.get("/lifts/{lift}/{file:file}", responses=content_of(BINARY, NPY), response_class=Response)
def get_viewer_file(
    lift: str, file: Literal["splats", "colours"], request: Request, deps: Deps, owner: Caller, layer: Layer = "pca"
) -> Response:
    """Download what a web viewer draws, with rows as in the lift.

    - `splats`: the scene, `.splat`, 32 bytes a splat. 2DGS discs are thin Gaussians there, and DBS kernels the
      Gaussians of nearest size.
    - `colours`: a colour for every splat: .npy, uint8 [P, 3], sRGB. Splats without a feature are grey.
    """
    record = deps.store.lift(owner, lift)
    if file == "splats":
        headers = request.headers
        compressed = "zstd" in headers.get("accept-encoding", "") and "range" not in headers
        order = scene_request("scene", record, deps) | {"compressed": compressed}
        answer = respond(request, deps, order, BINARY, f"scene-{record.id}.splat")
        answer.headers.update({"Vary": "Accept-Encoding"} | ({"Content-Encoding": "zstd"} if compressed else {}))
        return answer
    return respond(request, deps, scene_request("colours", record, deps) | {"layer": layer}, NPY)
