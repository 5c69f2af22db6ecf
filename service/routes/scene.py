"""/lifts/{lift}/splats, /colours, /views, /regions and /objects: what a viewer draws of a lift."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import StreamingResponse

from liftcore.errors import NotFound
from service import limits, models
from service.content import TAGGED, Limit, kept, unchanged
from service.encoders import encoder_label
from service.photos import in_camera_orientation
from service.queries import questions
from service.queries.requests import NO_ENCODER, Ask, made, scene_request, tagged_answer, with_encoder, with_packs
from service.routes.queries import NPY, PLY, PNG
from service.state import AppState, Deps
from service.store.lifts import LiftRecord

_BYTES = {"schema": {"type": "string", "format": "binary"}}
PHOTO: dict[int | str, dict[str, Any]] = {200: {"content": {"image/jpeg": _BYTES, "image/png": _BYTES}}}

router = APIRouter(prefix="/lifts/{lift}", tags=["lifts"])
View = Annotated[str, Query(min_length=1, max_length=limits.VIEW_CHARACTERS, description="the name of a camera")]
ViewsCursor = Annotated[int, Query(ge=0, le=10**9, description="the `next` of the page before")]
Pixel = Annotated[int, Query(ge=0, le=10**9, description="of the photo: x from the left, y from the top")]
Level = Annotated[int, Query(ge=0, le=10**9, description="as GET /lifts/{lift}/regions tells it")]
ObjectId = Annotated[int, Path(ge=0, le=10**9, description="the id of an object of the lift")]
Layer = Annotated[
    Literal["pca", "cluster", "evidence", "agreement", "confidence"],
    Query(description="principal components of features, clusters, or one of the others through a colour map"),
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


@router.get("/photo", responses=PHOTO | TAGGED, response_class=Response)
def photo(lift: str, view: View, request: Request, deps: Deps, ask: Ask) -> Response:
    """The photo of a view, as it was uploaded.

    Where its camera is of the stored pixels, an EXIF orientation becomes 1, so that no browser turns the photo.
    """

    def camera_size() -> tuple[int, int] | None:
        cameras = ask(scene_request("views", found, deps) | {"view": view}).header["views"]
        return (cameras[0]["width"], cameras[0]["height"]) if cameras else None

    found = deps.store.lifts.get(deps.owner, lift)
    zipped = None if found.photos is None else deps.store.assets.get(deps.owner, found.photos)
    opened = None if zipped is None else deps.photos.of(zipped.path).open(view)
    if zipped is None or opened is None:
        got, hint = f"none of {view!r}"[:200], "PUT /assets/photos, then PATCH /lifts/{lift} with its id"
        raise NotFound("view", expected="a view of which the lift has a photo", got=got, hint=hint)
    media_type, size, blocks = opened
    blocks, is_changed = in_camera_orientation(blocks, camera_size)
    etag = f'"{hashlib.sha256(f"{zipped.id} {view} {is_changed}".encode()).hexdigest()}"'
    headers = kept(etag) | {"Content-Length": str(size)}
    return unchanged(request, etag) or StreamingResponse(blocks, media_type=media_type, headers=headers)


def _with_photo(deps: AppState, lift: LiftRecord, views: list[str]) -> set[str]:
    if lift.photos is None:
        return set()
    return deps.photos.of(deps.store.assets.get(deps.owner, lift.photos).path).names(views)


@router.get("/views", response_model=models.Views)
def views(lift: str, deps: Deps, ask: Ask, limit: Limit = limits.PAGE, cursor: ViewsCursor = 0) -> models.Views:
    """The cameras of the scene with their poses, in pages; also those that were not lifted."""
    found = deps.store.lifts.get(deps.owner, lift)
    answer = ask(scene_request("views", found, deps) | {"first": cursor, "count": limit}).header
    names = [view["name"] for view in answer["views"]]
    lifted, photos = deps.store.lifts.lifted(deps.owner, lift, names), _with_photo(deps, found, names)
    told = [
        models.View(lifted=view["name"] in lifted, photo=view["name"] in photos, **view) for view in answer["views"]
    ]
    return models.Views(views=told, next=cursor + limit if answer["more"] else None)


@router.get("/regions", response_model=questions.CoveringRegions)
def regions(lift: str, view: View, x: Pixel, y: Pixel, deps: Deps, ask: Ask) -> questions.CoveringRegions:
    """The regions of the lift's feature packs that cover a pixel of a view's photo: each is an example to ask by."""
    found = deps.store.lifts.get(deps.owner, lift)
    wanted = with_packs(scene_request("regions", found, deps), found, deps, "lift") | {"view": view, "x": x, "y": y}
    return questions.CoveringRegions(lift=found.id, view=view, **ask(wanted).header)


@router.get("/regions/mask", responses=PNG | TAGGED, response_class=Response)
def region_mask(
    lift: str, view: View, level: Level, region: Level, request: Request, deps: Deps, ask: Ask
) -> Response:
    """The pixels of a view's photo that one region covers: a PNG, white where it is."""
    found = deps.store.lifts.get(deps.owner, lift)
    wanted = with_packs(scene_request("region_mask", found, deps), found, deps, "lift")
    wanted |= {"view": view, "level": level, "region": region}
    return tagged_answer(request, deps, wanted, found, ask)


@router.get("/objects", response_model=questions.SceneObjects)
def scene_objects(
    lift: str, deps: Deps, ask: Ask, asked: Annotated[questions.AskedForSceneObjects, Query()]
) -> Response:
    """The things in the scene, found by masks alone when it was lifted; a vocabulary names them."""
    found = deps.store.lifts.get(deps.owner, lift)
    wanted: dict[str, Any] = scene_request("catalogue", found, deps) | NO_ENCODER | {"words": None}
    if asked.table is not None or asked.encoder is not None:
        wanted = with_encoder(wanted, asked, found, deps)
    named = None if wanted["encoder"] is None else encoder_label(wanted["encoder"])
    wanted |= {"first": asked.cursor, "count": asked.limit, "means": asked.features}
    return made(deps, wanted | {"head": {"lift": found.id, "encoder": named}}, found, ask, {})


@router.get("/objects/{thing}/splats", responses=PLY | TAGGED, response_class=Response)
def object_splats(lift: str, thing: ObjectId, request: Request, deps: Deps, ask: Ask) -> Response:
    """The splats of one object and no others: a PLY of the dialect that was lifted."""
    found = deps.store.lifts.get(deps.owner, lift)
    wanted = scene_request("splats", found, deps) | {"what": f"object-{thing}", "object": thing}
    return tagged_answer(request, deps, wanted, found, ask)
