"""/query and /render: where words and examples are in a scene, and pictures of it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response

from service import wire
from service.content import TAGGED, draft_answer, tagged, unchanged
from service.errors import InvalidRequest
from service.parts import Here, Parts
from service.routes.question import answer_links, entity_tag, find_lift, query_request, scene_request, shown
from service.settings import encoder_label
from service.store.lifts import LiftRecord

router = APIRouter(tags=["queries"])

PNG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}
}
NPY: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/x-npy": {"schema": {"type": "string", "format": "binary"}}}}
}
PLY: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}}
}
MEDIA_TYPES = {"scores": "application/x-npy", "mask": "image/png", "attention": "image/png", "render": "image/png"}

LiftParameter = Annotated[
    str | None, Query(pattern=wire.JOB_ID, description="the lift; may be left out when there is exactly one")
]
View = Annotated[str, Query(min_length=1, max_length=wire.VIEW_CHARACTERS, description="the name of a camera")]


@router.get("/query", response_model=wire.QueryAnswer)
def query(asked: Annotated[wire.AskedWhere, Query()], here: Here) -> wire.QueryAnswer:
    """Where it is: scores in numbers, the best splats, a box, and links to objects, splats and pictures."""
    return _answer(asked, here)


@router.post("/query", response_model=wire.QueryAnswer)
def query_by_body(asked: wire.AskedInBody, here: Here) -> wire.QueryAnswer:
    """The same for a query in a body, where examples may be vectors. POST the same body to the links of those."""
    return _answer(asked, here)


@router.get("/query/objects", response_model=wire.ObjectsAnswer)
def objects(asked: Annotated[wire.Asked, Query()], here: Here) -> wire.ObjectsAnswer:
    """The things that were found, splats that touch one another: where each lies, and how large it is."""
    return _objects(asked, here)


@router.post("/query/objects", response_model=wire.ObjectsAnswer)
def objects_by_body(asked: wire.AskedInBody, here: Here) -> wire.ObjectsAnswer:
    """The things that were found, for a query in a body."""
    return _objects(asked, here)


@router.get("/query/scores", responses=NPY | TAGGED, response_class=Response)
def scores(asked: Annotated[wire.Asked, Query()], request: Request, here: Here) -> Response:
    """The score of every splat: .npy, float32 [P]."""
    lift = find_lift(asked.lift, here)
    return _entity(request, here, query_request("scores", asked, lift, here), lift)


@router.get("/query/mask", responses=PNG | TAGGED, response_class=Response)
def mask(asked: Annotated[wire.AskedInView, Query()], request: Request, here: Here) -> Response:
    """Where it is in a view: a PNG, white where it is."""
    lift = find_lift(asked.lift, here)
    return _entity(request, here, query_request("mask", asked, lift, here) | {"view": asked.view}, lift)


@router.get("/query/attention", responses=PNG | TAGGED, response_class=Response)
def attention(asked: Annotated[wire.AskedInView, Query()], request: Request, here: Here) -> Response:
    """How well each pixel of a view answers to it: a PNG."""
    lift = find_lift(asked.lift, here)
    return _entity(request, here, query_request("attention", asked, lift, here) | {"view": asked.view}, lift)


@router.get("/query/splats", responses=PLY | TAGGED, response_class=Response)
def splats(asked: Annotated[wire.AskedForSplats, Query()], request: Request, here: Here) -> Response:
    """What was found, or the scene in the colours of its scores, as splats: a PLY of the dialect that was lifted."""
    lift = find_lift(asked.lift, here)
    wanted = query_request("splats", asked, lift, here) | {"what": asked.what}
    etag = entity_tag(wanted, lift)
    return unchanged(request, etag, found=False) or _splat_file(here, wanted, lift, etag)


@router.post("/query/scores", responses=NPY, response_class=Response)
def scores_by_body(asked: wire.AskedInBody, here: Here) -> Response:
    """The score of every splat, for a query in a body."""
    return _content(here, query_request("scores", asked, find_lift(asked.lift, here), here))


@router.post("/query/mask", responses=PNG, response_class=Response)
def mask_by_body(asked: wire.AskedInBody, here: Here) -> Response:
    """Where it is in a view, for a query in a body with a view."""
    lift = find_lift(asked.lift, here)
    return _content(here, query_request("mask", asked, lift, here) | {"view": _view(asked)})


@router.post("/query/attention", responses=PNG, response_class=Response)
def attention_by_body(asked: wire.AskedInBody, here: Here) -> Response:
    """How well each pixel of a view answers to it, for a query in a body with a view."""
    lift = find_lift(asked.lift, here)
    return _content(here, query_request("attention", asked, lift, here) | {"view": _view(asked)})


@router.post("/query/splats", responses=PLY, response_class=Response)
def splats_by_body(
    asked: wire.AskedInBody, here: Here, what: Annotated[wire.SplatsOf, Query(description=wire.SPLATS_OF)] = "object"
) -> Response:
    """What was found, or the scene in the colours of its scores, as splats, for a query in a body."""
    lift = find_lift(asked.lift, here)
    return _splat_file(here, query_request("splats", asked, lift, here) | {"what": what}, lift)


@router.get("/render", responses=PNG | TAGGED, response_class=Response)
def render(
    view: View,
    request: Request,
    here: Here,
    lift: LiftParameter = None,
    what: Annotated[
        Literal["rgb", "depth", "pca", "cluster"],
        Query(description="the splats' colours, expected depth, three principal components of features, or clusters"),
    ] = "rgb",
) -> Response:
    """The splats from a view, in their colours or in those of their features or clusters, or their depth: a PNG.

    Depths are grey, near bright. The PNG's texts `depth-near` and `depth-far` tell the depths of its levels 255 and
    1, in scene units, with even steps between; what lies beyond has these levels too. 0 is where no splat is.
    """
    found = find_lift(lift, here)
    return _entity(request, here, scene_request("render", found, here) | {"view": view, "what": what}, found)


def _answer(asked: wire.AskedWhere | wire.AskedInBody, here: Parts) -> wire.QueryAnswer:
    lift = find_lift(asked.lift, here)
    request = query_request("query", asked, lift, here) | {"view": asked.view, "top": asked.top}
    found = here.queries.call(request).header
    view = asked.view or next(iter(lift.metadata["views"]), None)
    return wire.QueryAnswer(
        text=asked.text,
        like=[shown(example) for example in asked.like],
        lift=lift.id,
        view=view,
        text_space=lift.metadata["text_space"],
        encoder=None if request["encoder"] is None else encoder_label(request["encoder"]),
        links=answer_links(asked, lift, view, found=found["count"] > 0),
        **found,
    )


def _objects(asked: wire.Asked | wire.AskedInBody, here: Parts) -> wire.ObjectsAnswer:
    lift = find_lift(asked.lift, here)
    found = here.queries.call(query_request("objects", asked, lift, here)).header
    return wire.ObjectsAnswer(lift=lift.id, **found)


def _view(asked: wire.AskedInBody) -> str:
    if asked.view is None:
        raise InvalidRequest(
            "view", expected="the name of a camera", got="nothing", hint="in the body of the request"
        )
    return asked.view


def _entity(request: Request, here: Parts, asked: dict[str, Any], lift: LiftRecord) -> Response:
    etag = entity_tag(asked, lift)
    same = unchanged(request, etag, found=False)  # the tag is made before anybody looks for the view
    if same is not None:
        return same
    content = here.queries.call(asked).body
    return unchanged(request, etag) or tagged(content, MEDIA_TYPES[asked["operation"]], etag)


def _splat_file(here: Parts, asked: dict[str, Any], lift: LiftRecord, etag: str | None = None) -> Response:
    """The query process writes a draft, as a scene is more than a pipe should carry or this process should hold."""
    files = here.store.files
    files.require_room(here.store.assets.get(lift.splats).bytes)
    with files.draft(".ply") as draft:
        here.queries.call(asked | {"draft": str(draft)})
        return draft_answer(draft, filename=f"{asked['what']}-{lift.id}.ply", etag=etag)


def _content(here: Parts, asked: dict[str, Any]) -> Response:
    return Response(here.queries.call(asked).body, media_type=MEDIA_TYPES[asked["operation"]])
