"""/query and /render: where words and examples are in a scene, and pictures of it."""

from __future__ import annotations

import asyncio
import hashlib
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Query, Request, Response

from liftcore import __version__
from service import limits, models
from service.content import BINARY, TAGGED, Draft, kept, unchanged
from service.encoders import encoder_file, encoder_label, encoder_spec, encoder_version
from service.errors import InvalidRequest
from service.queries.client import PIPE_BYTES, Asker, Frame
from service.requests import BodyBytes, described_body, json_body
from service.state import AppState, Deps
from service.store.assets import kernel_of
from service.store.lifts import LiftRecord

router = APIRouter(tags=["queries"])

Question = models.Asked | models.AskedInBody
QUERY_BODY, RENDER_BODY = json_body(models.AskedInBody), json_body(models.AskedToRender)
BODY = described_body(models.AskedInBody)
ROW_BYTES, SCORE_BYTES = 32, 4  # of a splat in the .splat format, and in an array
NUMBER_BYTES = 24  # of a number in JSON, at most
NO_ENCODER: dict[str, Any] = {"encoder": None, "encoder_version": None}  # of a question without words
REGION = "region:"  # what needs the lift's feature packs begins with it
MEDIA_TYPES = {"scores": "application/x-npy", "mask": "image/png", "attention": "image/png", "render": "image/png"}
MEDIA_TYPES["selection"] = MEDIA_TYPES["layer"] = MEDIA_TYPES["word_labels"] = MEDIA_TYPES[
    "scores"
]  # these are arrays
MEDIA_TYPES["word_map"] = MEDIA_TYPES["word_picture"] = MEDIA_TYPES["region_mask"] = MEDIA_TYPES["mask"]
MEDIA_TYPES["catalogue"] = MEDIA_TYPES["segment"] = "application/json"
MEDIA_TYPES["splats"] = MEDIA_TYPES["scene"] = BINARY


def bytes_of(media_type: str) -> dict[int | str, dict[str, Any]]:
    """What OpenAPI tells of an answer that is a file."""
    return {200: {"content": {media_type: {"schema": {"type": "string", "format": "binary"}}}}}


PNG, NPY, PLY = bytes_of("image/png"), bytes_of("application/x-npy"), bytes_of("application/octet-stream")

LiftParameter = Annotated[
    str | None, Query(pattern=models.JOB_ID, description="the lift; may be left out when there is exactly one")
]
View = Annotated[str, Query(min_length=1, max_length=limits.VIEW_CHARACTERS, description="the name of a camera")]


# The body is read before this listens, as both listen to the client.
async def _asking(request: Request, deps: Deps, body: BodyBytes) -> AsyncIterator[Callable[[dict[str, Any]], Frame]]:
    """Ask the query process for this caller, who may leave: a query that waits then is not answered."""
    asker = Asker(deps.caller.key or "")

    async def listen() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass
        deps.queries.leave(asker)

    listening = asyncio.create_task(listen())
    try:
        yield lambda wanted: deps.queries.call(wanted, asker)
    finally:
        listening.cancel()


Ask = Annotated[Callable[[dict[str, Any]], Frame], Depends(_asking, scope="function")]


@router.get("/query", response_model=models.QueryAnswer)
def query(asked: Annotated[models.AskedWhere, Query()], deps: Deps, ask: Ask) -> models.QueryAnswer:
    """Where it is: scores in numbers, the best splats, a box, and links to objects, splats and pictures."""
    return _answer(asked, deps, ask)


@router.post("/query", response_model=models.QueryAnswer, openapi_extra=BODY)
def query_by_body(deps: Deps, ask: Ask, asked: models.AskedInBody = QUERY_BODY) -> models.QueryAnswer:
    """The same for a query in a body, where examples may be vectors. POST the same body to the links of those."""
    return _answer(asked, deps, ask)


@router.get("/query/objects", response_model=models.ObjectsAnswer)
def objects(asked: Annotated[models.Asked, Query()], deps: Deps, ask: Ask) -> models.ObjectsAnswer:
    """The things that were found, splats that touch one another: where each lies, and how large it is."""
    return _objects(asked, deps, ask)


@router.post("/query/objects", response_model=models.ObjectsAnswer, openapi_extra=BODY)
def objects_by_body(deps: Deps, ask: Ask, asked: models.AskedInBody = QUERY_BODY) -> models.ObjectsAnswer:
    """The things that were found, for a query in a body."""
    return _objects(asked, deps, ask)


@router.get("/query/scores", responses=NPY | TAGGED, response_class=Response)
def scores(asked: Annotated[models.Asked, Query()], request: Request, deps: Deps, ask: Ask) -> Response:
    """The score of every splat: .npy, float32 [P]."""
    return _entity("scores", asked, request, deps, ask)


@router.get("/query/selection", responses=NPY | TAGGED, response_class=Response)
def selection(asked: Annotated[models.Asked, Query()], request: Request, deps: Deps, ask: Ask) -> Response:
    """Which splats were selected: .npy, bool [P]. By `auto` they are not just those at or above the threshold."""
    return _entity("selection", asked, request, deps, ask)


@router.get("/query/mask", responses=PNG | TAGGED, response_class=Response)
def mask(asked: Annotated[models.AskedInView, Query()], request: Request, deps: Deps, ask: Ask) -> Response:
    """Where it is in a view: a PNG, white where it is."""
    return _entity("mask", asked, request, deps, ask, view=asked.view)


@router.get("/query/attention", responses=PNG | TAGGED, response_class=Response)
def attention(asked: Annotated[models.AskedInView, Query()], request: Request, deps: Deps, ask: Ask) -> Response:
    """How well each pixel of a view answers to it: a PNG."""
    return _entity("attention", asked, request, deps, ask, view=asked.view)


@router.get("/query/splats", responses=PLY | TAGGED, response_class=Response)
def splats(asked: Annotated[models.AskedForSplats, Query()], request: Request, deps: Deps, ask: Ask) -> Response:
    """What was found, or the scene in the colours of its scores, as splats: a PLY of the dialect that was lifted."""
    return _entity("splats", asked, request, deps, ask, what=asked.what)


@router.post("/query/scores", responses=NPY, response_class=Response, openapi_extra=BODY)
def scores_by_body(deps: Deps, ask: Ask, asked: models.AskedInBody = QUERY_BODY) -> Response:
    """The score of every splat, for a query in a body."""
    return _content("scores", asked, deps, ask)


@router.post("/query/selection", responses=NPY, response_class=Response, openapi_extra=BODY)
def selection_by_body(deps: Deps, ask: Ask, asked: models.AskedInBody = QUERY_BODY) -> Response:
    """Which splats were selected, for a query in a body."""
    return _content("selection", asked, deps, ask)


@router.post("/query/mask", responses=PNG, response_class=Response, openapi_extra=BODY)
def mask_by_body(deps: Deps, ask: Ask, asked: models.AskedInBody = QUERY_BODY) -> Response:
    """Where it is in a view, for a query in a body with a view or a camera of your own."""
    return _content("mask", asked, deps, ask, **seen_from(asked))


@router.post("/query/attention", responses=PNG, response_class=Response, openapi_extra=BODY)
def attention_by_body(deps: Deps, ask: Ask, asked: models.AskedInBody = QUERY_BODY) -> Response:
    """How well each pixel of a view answers to it, for a query in a body with a view or a camera of your own."""
    return _content("attention", asked, deps, ask, **seen_from(asked))


@router.post("/query/splats", responses=PLY, response_class=Response, openapi_extra=BODY)
def splats_by_body(
    deps: Deps,
    ask: Ask,
    asked: models.AskedInBody = QUERY_BODY,
    what: Annotated[models.SplatsOf, Query(description=models.SPLATS_OF)] = "object",
) -> Response:
    """What was found, or the scene in the colours of its scores, as splats, for a query in a body."""
    return _content("splats", asked, deps, ask, what=what)


@router.get("/render", responses=PNG | TAGGED, response_class=Response)
def render(
    view: View,
    request: Request,
    deps: Deps,
    ask: Ask,
    lift: LiftParameter = None,
    what: Annotated[models.Rendered, Query(description=models.RENDERED)] = "rgb",
) -> Response:
    """The splats from a view, in their colours or in those of their features or clusters, or their depth: a PNG.

    Depths are those of the splats' centres along the camera's axis, weighted as the colours are. They are grey, near
    bright. The PNG's texts `depth-near` and `depth-far` tell the depths of its levels 255 and 1 (1st and 99th
    percentile), in scene units, with even steps between; what lies beyond has these levels too. 0 is where no splat
    is.
    """
    found = find_lift(lift, deps)
    wanted = scene_request("render", found, deps) | {"view": view, "what": what}
    return tagged_answer(request, deps, wanted, found, ask)


@router.post("/render", responses=PNG, response_class=Response, openapi_extra=described_body(models.AskedToRender))
def render_by_body(deps: Deps, ask: Ask, asked: models.AskedToRender = RENDER_BODY) -> Response:
    """The same picture, from a view or from a camera of your own."""
    lift = find_lift(asked.lift, deps)
    wanted = scene_request("render", lift, deps) | seen_from(asked) | {"what": asked.what}
    return made(deps, wanted, lift, ask, {})


def _answer(asked: models.AskedWhere | models.AskedInBody, deps: AppState, ask: Ask) -> models.QueryAnswer:
    lift = find_lift(asked.lift, deps)
    request = query_request("query", asked, lift, deps) | {"view": asked.view, "top": asked.top}
    found = ask(request).header
    view = asked.view or lift.first_view
    return models.QueryAnswer(
        text=asked.text,
        like=[shown(example) for example in asked.like],
        lift=lift.id,
        view=view,
        text_space=lift.metadata["text_space"],
        encoder=None if request["encoder"] is None else encoder_label(request["encoder"]),
        links=_answer_links(asked, lift, view, found=found["count"] > 0),
        **found,
    )


def _objects(asked: Question, deps: AppState, ask: Ask) -> models.ObjectsAnswer:
    lift = find_lift(asked.lift, deps)
    return models.ObjectsAnswer(lift=lift.id, **ask(query_request("objects", asked, lift, deps)).header)


def seen_from(asked: models.AskedInBody | models.AskedToRender | models.AskedToSegment) -> dict[str, Any]:
    """The camera of a picture: a view of the lift, or one of the client's own.

    Raises:
        InvalidRequest: neither is there, or both are.
    """
    if (asked.view is None) == (asked.camera is None):
        expected, got = "a view's name or a camera", "nothing" if asked.view is None else "both"
        raise InvalidRequest("view", expected=expected, got=got, hint="in the body of the request")
    return {"view": asked.view} if asked.camera is None else {"camera": asked.camera.model_dump()}


def _entity(operation: str, asked: Question, request: Request, deps: AppState, ask: Ask, **more: str) -> Response:
    """What a GET names, with its tag."""
    lift = find_lift(asked.lift, deps)
    return tagged_answer(request, deps, query_request(operation, asked, lift, deps) | more, lift, ask)


def _content(operation: str, asked: Question, deps: AppState, ask: Ask, **more: Any) -> Response:
    """What a POST asks for, which has no address and so no tag."""
    lift = find_lift(asked.lift, deps)
    return made(deps, query_request(operation, asked, lift, deps) | more, lift, ask, {})


def tagged_answer(request: Request, deps: AppState, wanted: dict[str, Any], lift: LiftRecord, ask: Ask) -> Response:
    """304 when the client has it already, and nothing is asked; else it. The tag is made of all that decides it."""
    decides = {name: value for name, value in wanted.items() if name != "names"}
    decides |= {"lift": lift.sha256, "version": __version__}
    etag = f'"{hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()}"'
    same = unchanged(request, etag, found=False)  # nobody has looked whether the view is there
    if same is not None:
        return same
    answer = made(deps, wanted, lift, ask, kept(etag))
    return (None if isinstance(answer, Draft) else unchanged(request, etag)) or answer


def made(deps: AppState, wanted: dict[str, Any], lift: LiftRecord, ask: Ask, headers: dict[str, str]) -> Response:
    """The answer itself. What is large the query process writes to a draft, so that no client, however slowly it
    reads, keeps it in memory.
    """
    files, name, size = deps.store.files, None, 0
    match wanted["operation"]:
        case "splats":
            name, size = f"{wanted['what']}-{lift.id}.ply", deps.store.assets.get(deps.owner, lift.splats).bytes
        case "scene":
            name, size = f"scene-{lift.id}.splat", ROW_BYTES * lift.count
        case "scores" | "selection" | "layer" | "word_labels" if SCORE_BYTES * lift.count > PIPE_BYTES:
            size = SCORE_BYTES * lift.count
        case "catalogue" if wanted["means"]:
            size = NUMBER_BYTES * lift.channels * wanted["count"]
    if size:
        files.require_room(size)
    media_type = MEDIA_TYPES[wanted["operation"]]
    with files.draft("" if name is None else Path(name).suffix) as draft:
        body = ask(wanted | {"draft": str(draft)}).body
        if draft.exists():
            return Draft(draft, media_type, filename=name, headers=headers)
    return Response(body, media_type=media_type, headers=headers)


def find_lift(lift: str | None, deps: AppState) -> LiftRecord:
    """The lift that is meant; left out, the only one."""
    return deps.store.lifts.only(deps.owner) if lift is None else deps.store.lifts.get(deps.owner, lift)


def scene_request(operation: str, lift: LiftRecord, deps: AppState) -> dict[str, Any]:
    """What the query process must know of a lift's files; ``names`` says what the client calls them."""
    job = deps.store.jobs.get(deps.owner, lift.id)
    splats, cameras = (deps.store.assets.get(deps.owner, asset) for asset in (job.splats, job.cameras))
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
    request: dict[str, Any] = scene_request(operation, lift, deps)
    request = with_encoder(request, asked, lift, deps) if asked.text or asked.negatives else {**request, **NO_ENCODER}
    if any(isinstance(example, str) and example.startswith(REGION) for example in (*asked.like, *asked.unlike)):
        request = with_packs(request, lift, deps, "like")
    terms = ("text", "negatives", "like", "unlike", "threshold", "instances", "keep", "absent", "weigh")
    return request | {"query": {name: getattr(asked, name) for name in terms}}


def with_packs(request: dict[str, Any], lift: LiftRecord, deps: AppState, argument: str) -> dict[str, Any]:
    """The request with the lift's feature packs, which have its regions.

    Raises:
        InvalidRequest: they are not all here.
    """
    if len(lift.features) < len(lift.metadata["features"]):
        hint = "PUT /assets/features each of its packs before POST /lifts, or ask by splat:J or VIEW:x,y"
        got = "one that was brought without some of them"
        raise InvalidRequest(argument, expected="a lift whose feature packs are here", got=got, hint=hint)
    packs = [deps.store.assets.get(deps.owner, asset) for asset in lift.features]
    names = request["names"] | {str(pack.path): f"features {pack.id}" for pack in packs}
    return request | {"features": [str(pack.path) for pack in packs], "names": names}


def with_encoder(
    request: dict[str, Any],
    asked: models.LiftQuestion | models.AskedForSceneObjects,
    lift: LiftRecord,
    deps: AppState,
) -> dict[str, Any]:
    """The request with the encoder of its words: an uploaded table, or one that the operator set up.

    Raises:
        InvalidRequest: there is none of the lift's space, or of two names.
        NotFound: there is no such table.
    """
    names = dict(request["names"])
    if asked.table is None:
        spec = encoder_spec(deps.settings, lift.metadata["text_space"], asked.encoder)
        file = encoder_file(spec)
        names |= {} if file is None else {str(file): "the encoder's file"}
    elif asked.encoder is not None:
        raise InvalidRequest("table", expected="table or encoder", got="both", hint="leave one of them out")
    else:
        table = deps.store.assets.get(deps.owner, asked.table)
        if table.kind is not models.AssetKind.TABLE:
            raise InvalidRequest("table", expected="an uploaded text table", got=f"{table.kind} {table.id}")
        spec = f"table:{table.path}"
        names |= {str(table.path): f"table {table.id}", f"text table {table.path.name}": f"table {table.id}"}
    return request | {"encoder": spec, "encoder_version": encoder_version(spec), "names": names}


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


def shown(example: str | list[float]) -> str:
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
    pairs += [("absent", asked.absent)] if asked.absent != "drop" else []
    pairs += [("weigh", asked.weigh)] if asked.weigh != "evidence" else []
    pairs += [(name, value) for name in ("encoder", "table") if (value := getattr(asked, name)) is not None]
    return f"{path}{'&' if '?' in path else '?'}{urlencode(pairs + list(more.items()))}"
