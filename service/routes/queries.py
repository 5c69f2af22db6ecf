"""/query and /render: where words and examples are in a scene, and pictures of it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request, Response

from liftcore import __version__
from service import models
from service.content import TAGGED, Draft, tagged, unchanged
from service.encoders import encoder_file, encoder_label, encoder_spec, encoder_version
from service.errors import InvalidRequest
from service.requests import described_body, json_body
from service.state import AppState, Deps
from service.store.assets import kernel_of
from service.store.lifts import LiftRecord

router = APIRouter(tags=["queries"])

Question = models.Asked | models.AskedInBody
QUERY_BODY = json_body(models.AskedInBody)
BODY = described_body(models.AskedInBody)
REGION = "region:"  # what needs the lift's feature packs begins with it
MEDIA_TYPES = {"scores": "application/x-npy", "mask": "image/png", "attention": "image/png", "render": "image/png"}
MEDIA_TYPES["layer"] = MEDIA_TYPES["scores"]  # both are arrays


def bytes_of(media_type: str) -> dict[int | str, dict[str, Any]]:
    """What OpenAPI tells of an answer that is a file."""
    return {200: {"content": {media_type: {"schema": {"type": "string", "format": "binary"}}}}}


PNG, NPY, PLY = bytes_of("image/png"), bytes_of("application/x-npy"), bytes_of("application/octet-stream")

LiftParameter = Annotated[
    str | None, Query(pattern=models.JOB_ID, description="the lift; may be left out when there is exactly one")
]
View = Annotated[str, Query(min_length=1, max_length=models.VIEW_CHARACTERS, description="the name of a camera")]


@router.get("/query", response_model=models.QueryAnswer)
def query(asked: Annotated[models.AskedWhere, Query()], deps: Deps) -> models.QueryAnswer:
    """Where it is: scores in numbers, the best splats, a box, and links to objects, splats and pictures."""
    return _answer(asked, deps)


@router.post("/query", response_model=models.QueryAnswer, openapi_extra=BODY)
def query_by_body(deps: Deps, asked: models.AskedInBody = QUERY_BODY) -> models.QueryAnswer:
    """The same for a query in a body, where examples may be vectors. POST the same body to the links of those."""
    return _answer(asked, deps)


@router.get("/query/objects", response_model=models.ObjectsAnswer)
def objects(asked: Annotated[models.Asked, Query()], deps: Deps) -> models.ObjectsAnswer:
    """The things that were found, splats that touch one another: where each lies, and how large it is."""
    return _objects(asked, deps)


@router.post("/query/objects", response_model=models.ObjectsAnswer, openapi_extra=BODY)
def objects_by_body(deps: Deps, asked: models.AskedInBody = QUERY_BODY) -> models.ObjectsAnswer:
    """The things that were found, for a query in a body."""
    return _objects(asked, deps)


@router.get("/query/scores", responses=NPY | TAGGED, response_class=Response)
def scores(asked: Annotated[models.Asked, Query()], request: Request, deps: Deps) -> Response:
    """The score of every splat: .npy, float32 [P]."""
    lift = _find_lift(asked.lift, deps)
    return entity(request, deps, query_request("scores", asked, lift, deps), lift)


@router.get("/query/mask", responses=PNG | TAGGED, response_class=Response)
def mask(asked: Annotated[models.AskedInView, Query()], request: Request, deps: Deps) -> Response:
    """Where it is in a view: a PNG, white where it is."""
    lift = _find_lift(asked.lift, deps)
    return entity(request, deps, query_request("mask", asked, lift, deps) | {"view": asked.view}, lift)


@router.get("/query/attention", responses=PNG | TAGGED, response_class=Response)
def attention(asked: Annotated[models.AskedInView, Query()], request: Request, deps: Deps) -> Response:
    """How well each pixel of a view answers to it: a PNG."""
    lift = _find_lift(asked.lift, deps)
    return entity(request, deps, query_request("attention", asked, lift, deps) | {"view": asked.view}, lift)


@router.get("/query/splats", responses=PLY | TAGGED, response_class=Response)
def splats(asked: Annotated[models.AskedForSplats, Query()], request: Request, deps: Deps) -> Response:
    """What was found, or the scene in the colours of its scores, as splats: a PLY of the dialect that was lifted."""
    lift = _find_lift(asked.lift, deps)
    wanted = query_request("splats", asked, lift, deps) | {"what": asked.what}
    etag = entity_tag(wanted, lift)
    return unchanged(request, etag, found=False) or _splat_file(deps, wanted, lift, etag)


@router.post("/query/scores", responses=NPY, response_class=Response, openapi_extra=BODY)
def scores_by_body(deps: Deps, asked: models.AskedInBody = QUERY_BODY) -> Response:
    """The score of every splat, for a query in a body."""
    return _content(deps, query_request("scores", asked, _find_lift(asked.lift, deps), deps))


@router.post("/query/mask", responses=PNG, response_class=Response, openapi_extra=BODY)
def mask_by_body(deps: Deps, asked: models.AskedInBody = QUERY_BODY) -> Response:
    """Where it is in a view, for a query in a body with a view."""
    lift = _find_lift(asked.lift, deps)
    return _content(deps, query_request("mask", asked, lift, deps) | {"view": _view(asked)})


@router.post("/query/attention", responses=PNG, response_class=Response, openapi_extra=BODY)
def attention_by_body(deps: Deps, asked: models.AskedInBody = QUERY_BODY) -> Response:
    """How well each pixel of a view answers to it, for a query in a body with a view."""
    lift = _find_lift(asked.lift, deps)
    return _content(deps, query_request("attention", asked, lift, deps) | {"view": _view(asked)})


@router.post("/query/splats", responses=PLY, response_class=Response, openapi_extra=BODY)
def splats_by_body(
    deps: Deps,
    asked: models.AskedInBody = QUERY_BODY,
    what: Annotated[models.SplatsOf, Query(description=models.SPLATS_OF)] = "object",
) -> Response:
    """What was found, or the scene in the colours of its scores, as splats, for a query in a body."""
    lift = _find_lift(asked.lift, deps)
    return _splat_file(deps, query_request("splats", asked, lift, deps) | {"what": what}, lift)


@router.get("/render", responses=PNG | TAGGED, response_class=Response)
def render(
    view: View,
    request: Request,
    deps: Deps,
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
    found = _find_lift(lift, deps)
    return entity(request, deps, scene_request("render", found, deps) | {"view": view, "what": what}, found)


def _answer(asked: models.AskedWhere | models.AskedInBody, deps: AppState) -> models.QueryAnswer:
    lift = _find_lift(asked.lift, deps)
    request = query_request("query", asked, lift, deps) | {"view": asked.view, "top": asked.top}
    found = deps.queries.call(request).header
    view = asked.view or next(iter(lift.metadata["views"]), None)
    return models.QueryAnswer(
        text=asked.text,
        like=[_shown(example) for example in asked.like],
        lift=lift.id,
        view=view,
        text_space=lift.metadata["text_space"],
        encoder=None if request["encoder"] is None else encoder_label(request["encoder"]),
        links=_answer_links(asked, lift, view, found=found["count"] > 0),
        **found,
    )


def _objects(asked: models.Asked | models.AskedInBody, deps: AppState) -> models.ObjectsAnswer:
    lift = _find_lift(asked.lift, deps)
    found = deps.queries.call(query_request("objects", asked, lift, deps)).header
    return models.ObjectsAnswer(lift=lift.id, **found)


def _view(asked: models.AskedInBody) -> str:
    if asked.view is None:
        raise InvalidRequest(
            "view", expected="the name of a camera", got="nothing", hint="in the body of the request"
        )
    return asked.view


def entity(request: Request, deps: AppState, asked: dict[str, Any], lift: LiftRecord) -> Response:
    etag = entity_tag(asked, lift)
    same = unchanged(request, etag, found=False)  # the tag is made before anybody looks for the view
    if same is not None:
        return same
    content = deps.queries.call(asked).body
    return unchanged(request, etag) or tagged(content, MEDIA_TYPES[asked["operation"]], etag)


def _splat_file(deps: AppState, asked: dict[str, Any], lift: LiftRecord, etag: str | None = None) -> Response:
    size = deps.store.assets.get(deps.owner, lift.splats).bytes
    return drafted(deps, asked, size, f"{asked['what']}-{lift.id}.ply", etag)


def drafted(deps: AppState, asked: dict[str, Any], size: int, name: str, etag: str | None) -> Response:
    """A file of at most ``size`` bytes: the query process writes a draft, as it is more than a pipe should carry."""
    files = deps.store.files
    files.require_room(size)
    with files.draft(Path(name).suffix) as draft:
        deps.queries.call(asked | {"draft": str(draft)})
        return Draft(draft, filename=name, etag=etag)


def _content(deps: AppState, asked: dict[str, Any]) -> Response:
    return Response(deps.queries.call(asked).body, media_type=MEDIA_TYPES[asked["operation"]])


def _find_lift(lift: str | None, deps: AppState) -> LiftRecord:
    """The lift that is meant; left out, the only one."""
    return deps.store.lifts.only(deps.owner) if lift is None else deps.store.lifts.get(deps.owner, lift)


def scene_request(operation: str, lift: LiftRecord, deps: AppState) -> dict[str, Any]:
    """What the query process must know of a lift's files; ``names`` says what the client calls them."""
    job = deps.store.jobs.get(deps.owner, lift.id)
    splats, cameras = deps.store.assets.get(deps.owner, job.splats), deps.store.assets.get(deps.owner, job.cameras)
    return {
        "operation": operation,
        "lift": str(lift.path),
        "splats": str(splats.path),
        "cameras": str(cameras.path),
        "kernel": kernel_of(splats, lift.metadata["settings"]),
        "names": {
            str(lift.path): f"lift {lift.id}",
            str(splats.path): f"splats {splats.id}",
            str(cameras.path): f"cameras {cameras.id}",
        },
    }


def query_request(operation: str, asked: Question, lift: LiftRecord, deps: AppState) -> dict[str, Any]:
    """The same with a query; texts bring their encoder, and examples of regions the lift's feature packs."""
    request = scene_request(operation, lift, deps)
    spec = None
    if asked.text or asked.negatives:
        spec = encoder_spec(deps.settings, lift.metadata["text_space"], asked.encoder)
        file = encoder_file(spec)
        request["names"] |= {} if file is None else {str(file): "the encoder's file"}
    if any(isinstance(example, str) and example.startswith(REGION) for example in (*asked.like, *asked.unlike)):
        packs = [
            deps.store.assets.get(deps.owner, asset) for asset in deps.store.jobs.get(deps.owner, lift.id).features
        ]
        request["features"] = [str(pack.path) for pack in packs]
        request["names"] |= {str(pack.path): f"features {pack.id}" for pack in packs}
    terms = ("text", "negatives", "like", "unlike", "threshold", "instances", "keep")
    return request | {
        "encoder": spec,
        "encoder_version": None if spec is None else encoder_version(spec),
        "query": {name: getattr(asked, name) for name in terms},
    }


def entity_tag(asked: dict[str, Any], lift: LiftRecord) -> str:
    """The tag of an answer, from all that decides it: so 304 costs no query."""
    decides = {name: value for name, value in asked.items() if name != "names"}
    decides["lift"] = lift.sha256
    decides["version"] = __version__
    return f'"{hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()}"'


def _answer_links(asked: Question, lift: LiftRecord, view: str | None, *, found: bool) -> dict[str, str]:
    """The URLs of other looks at the same query; vectors do not fit in one, and are sent there again.

    Where nothing was ``found`` there are no objects.
    """
    links = {"lift": f"/lifts/{lift.id}", "scores": _link("/query/scores", asked, lift=lift.id)}
    if found:
        links["objects"] = _link("/query/objects", asked, lift=lift.id)
        links["object"] = _link("/query/splats?what=object", asked, lift=lift.id)
    links["coloured"] = _link("/query/splats?what=scores", asked, lift=lift.id)
    if view is not None:
        links["mask"] = _link("/query/mask", asked, lift=lift.id, view=view)
        links["attention"] = _link("/query/attention", asked, lift=lift.id, view=view)
        links["render"] = f"/render?{urlencode({'lift': lift.id, 'view': view})}"
    return links


def _shown(example: str | list[float]) -> str:
    """An example as an answer names it."""
    return example if isinstance(example, str) else f"a vector of {len(example)} channels"


def _link(path: str, asked: Question, **more: str) -> str:
    pairs: list[tuple[str, str]] = []
    for name in ("text", "like", "negatives", "unlike"):
        values = getattr(asked, name)
        if not all(isinstance(value, str) for value in values):
            return path
        pairs += [(name, value) for value in values]
    pairs.append(("threshold", str(asked.threshold)))
    pairs += [("instances", str(asked.instances))] if asked.instances is not None else []
    pairs += [("keep", asked.keep)] if asked.keep != "all" else []
    pairs += [("encoder", asked.encoder)] if asked.encoder is not None else []
    return f"{path}{'&' if '?' in path else '?'}{urlencode(pairs + list(more.items()))}"
