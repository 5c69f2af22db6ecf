"""/query and /render: where words and examples are in a scene, what is there of many words, and pictures of it."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import re
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Request, Response
from fastapi import Query as Parameter

from liftcore import Query, __version__
from liftcore.text import encoder_file
from service import models
from service.content import BINARY, Draft, cache_headers, unchanged
from service.errors import InvalidRequest
from service.models import (
    ExportRequest,
    LiftQuestion,
    NearestWordsAnswer,
    NearestWordsRequest,
    ObjectsAnswer,
    QueryAnswer,
    Question,
    RenderRequest,
    SegmentAnswer,
    SegmentRequest,
    SuggestedWordsRequest,
    Words,
    WordsAnswer,
)
from service.query_client import PIPE_BYTES, Frame, Waiter
from service.requests import JsonRoute, Parameters, get_and_post
from service.settings import encoder_label, encoder_spec, encoder_version
from service.state import AppState, Deps
from service.store.assets import kernel_of
from service.store.lifts import LiftRecord

# Build requests for the query process, and turn its answers into HTTP responses with an entity tag

# Upper estimates, to check the free disk before the query process writes
EXPORT_BYTES = 16  # of a splat's labels
ROW_BYTES, SCORE_BYTES = 32, 4  # of a splat in the .splat format, and in an array
NUMBER_BYTES = 24  # of a number in JSON
NO_ENCODER: dict[str, Any] = {"encoder": None, "encoder_version": None}  # of a question without words
REGION, SELECTION = "region:", "selection:"  # prefixes of examples that need the lift's packs, or a stored selection
NPY_TYPE, PNG_TYPE, JSON_TYPE = "application/x-npy", "image/png", "application/json"
MEDIA_TYPES = {
    **dict.fromkeys(("scores", "selection", "layer", "word_labels"), NPY_TYPE),
    **dict.fromkeys(("mask", "attention", "render", "word_map", "word_picture", "region_mask"), PNG_TYPE),
    **dict.fromkeys(("catalogue", "segment", "tree"), JSON_TYPE),
    **dict.fromkeys(("splats", "scene"), BINARY),
    "export": "application/zip",
}


# FastAPI reads the body before this dependency runs. Both call request.receive(): else the body would be lost.
async def query_process(request: Request, deps: Deps) -> AsyncIterator[Callable[[dict[str, Any]], Frame]]:
    """Yield a function that sends a request to the query process; if the client disconnects, a waiting one ends."""
    waiter = Waiter(deps.caller.key or "")

    async def listen() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass
        deps.query_client.cancel(waiter)

    listening = asyncio.create_task(listen())
    try:
        yield lambda worker_request: deps.query_client.call(worker_request, waiter)
    finally:
        listening.cancel()


Ask = Annotated[Callable[[dict[str, Any]], Frame], Depends(query_process, scope="function")]


def tagged_answer(
    request: Request, deps: AppState, worker_request: dict[str, Any], lift: LiftRecord, ask: Ask
) -> Response:
    """Return the answer, or 304 if the client has it. The tag is a digest of all inputs.

    The answer to a POST has no address, and so no tag.
    """
    if request.method == "POST":
        return binary_response(deps, worker_request, lift, ask, {})
    decides = {name: value for name, value in worker_request.items() if name != "names"}
    decides |= {"lift": lift.sha256, "version": __version__}
    etag = f'"{hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()}"'
    not_modified = unchanged(request, etag, exists=False)  # whether the view exists is not known yet
    if not_modified is not None:
        return not_modified
    answer = binary_response(deps, worker_request, lift, ask, cache_headers(etag))
    return (None if isinstance(answer, Draft) else unchanged(request, etag)) or answer


def binary_response(
    deps: AppState, worker_request: dict[str, Any], lift: LiftRecord, ask: Ask, headers: dict[str, str]
) -> Response:
    """Return the answer. The query process writes a large one to a draft, so that a slow client keeps no memory."""
    files, name, size = deps.store.files, None, 0
    match worker_request["operation"]:
        case "splats":
            name, size = (
                f"{worker_request['what']}-{lift.id}.ply",
                deps.store.assets.get(deps.owner, lift.splats).bytes,
            )
        case "export":
            name = f"{worker_request['name'] or 'splats'}-{lift.id}.zip"
            size = deps.store.assets.get(deps.owner, lift.splats).bytes + EXPORT_BYTES * lift.count
        case "scene":
            name, size = f"scene-{lift.id}.splat", ROW_BYTES * lift.count
        case "scores" | "selection" | "layer" | "word_labels" if SCORE_BYTES * lift.count > PIPE_BYTES:
            size = SCORE_BYTES * lift.count
        case "catalogue" if worker_request["means"]:
            size = NUMBER_BYTES * lift.channels * worker_request["count"]
    if size:
        files.require_room(size)
    media_type = MEDIA_TYPES[worker_request["operation"]]
    with files.draft("" if name is None else Path(name).suffix) as draft:
        body = ask(worker_request | {"draft": str(draft)}).body
        if draft.exists():
            return Draft(draft, media_type, filename=name, headers=headers)
    return Response(body, media_type=media_type, headers=headers)


def find_lift(lift: str | None, deps: AppState) -> LiftRecord:
    """Return the lift of an id; the only lift if it is left out."""
    return deps.store.lifts.only(deps.owner) if lift is None else deps.store.lifts.get(deps.owner, lift)


def scene_request(operation: str, lift: LiftRecord, deps: AppState) -> dict[str, Any]:
    """Return the fields of a lift's files for the query process; ``names`` maps them to the client's names."""
    job = deps.store.jobs.get(deps.owner, lift.id)
    splats, cameras = (deps.store.assets.get(deps.owner, asset) for asset in (job.splats, job.cameras))
    return {
        "operation": operation,
        "lift": str(lift.path),
        "splats": str(splats.path),
        "cameras": str(cameras.path),
        "kernel": kernel_of(splats, lift.metadata["settings"]),
        "world": lift.metadata.get("world", {}),
        "names": {
            str(lift.path): f"lift {lift.id}",
            str(splats.path): f"splats {splats.id}",
            str(cameras.path): f"cameras {cameras.id}",
        },
    }


def query_request(operation: str, parameters: models.Question, lift: LiftRecord, deps: AppState) -> dict[str, Any]:
    """Return the worker's request of a query, with the encoder of its texts and the packs of its regions."""
    request: dict[str, Any] = scene_request(operation, lift, deps)
    selection_ids = [
        str(item).removeprefix(SELECTION)
        for item in (*parameters.sets, *parameters.like, *parameters.unlike)
        if _selects(item)
    ]
    if selection_ids:
        selections = {
            name: deps.store.selections.get(deps.owner, lift.id, name) for name in dict.fromkeys(selection_ids)
        }
        request["selections"] = {name: bits_of(deps.store.selections.bits(item)) for name, item in selections.items()}
    request = with_encoder(request, parameters, lift, deps) if parameters.texts else {**request, **NO_ENCODER}
    if any(
        isinstance(example, str) and example.startswith(REGION) for example in (*parameters.like, *parameters.unlike)
    ):
        request = with_packs(request, lift, deps, "like")
    return request | {"query": parameters.model_dump(mode="json", include=set(Query.deciding()))}


def _selects(example: object) -> bool:
    return isinstance(example, str) and example.startswith(SELECTION)


def bits_of(bits: bytes) -> str:
    """Return the packed booleans of a selection as base64 text."""
    return base64.b64encode(bits).decode()


def seen_from(parameters: models.Viewpoint) -> dict[str, Any]:
    """Return the camera of a picture: a view of the lift, or a camera of the request.

    Raises:
        InvalidRequest: neither is there, or both are.
    """
    if (parameters.view is None) == (parameters.camera is None):
        expected, got = "a view's name or a camera", "nothing" if parameters.view is None else "both"
        raise InvalidRequest("view", expected=expected, got=got, hint="in the body of the request")
    return {"view": parameters.view} if parameters.camera is None else {"camera": parameters.camera.model_dump()}


def with_packs(request: dict[str, Any], lift: LiftRecord, deps: AppState, argument: str) -> dict[str, Any]:
    """Add the lift's feature packs, which have its regions, to a request.

    Raises:
        InvalidRequest: they are not all here.
    """
    if len(lift.features) < len(lift.metadata["features"]):
        hint = "PUT /assets/features each of its packs before POST /lifts, or ask by splat:J or VIEW:x,y"
        got = "one that was brought without some of them"
        raise InvalidRequest(argument, expected="a lift whose feature packs are here", got=got, hint=hint)
    return _with_packs_here(request, lift, deps)


def _with_packs_here(request: dict[str, Any], lift: LiftRecord, deps: AppState) -> dict[str, Any]:
    packs = [deps.store.assets.get(deps.owner, asset) for asset in lift.features]
    names = request["names"] | {str(pack.path): f"features {pack.id}" for pack in packs}
    return request | {"features": [str(pack.path) for pack in packs], "names": names}


def with_encoder(
    request: dict[str, Any], parameters: models.LiftQuestion | models.NodesRequest, lift: LiftRecord, deps: AppState
) -> dict[str, Any]:
    """Return the request with the encoder of its words: an uploaded table, the lift's, or one of the operator.

    Raises:
        InvalidRequest: no encoder of the lift's text space is set up, or both a table and an encoder are named.
        NotFound: there is no such table.
    """
    names, table_id = dict(request["names"]), parameters.table
    if table_id is None and parameters.encoder in (
        None,
        lift.metadata["text_space"],
    ):  # the words that came with the lift
        table_id = deps.store.jobs.get(deps.owner, lift.id).parameters.get("table")
    if table_id is None:
        spec = encoder_spec(deps.settings, lift.metadata["text_space"], parameters.encoder)
        file = encoder_file(spec)
        if file is not None:
            names |= {str(file): "the encoder's file", f"text table {file.name}": "the text table"}
    elif parameters.table is not None and parameters.encoder is not None:
        raise InvalidRequest("table", expected="table or encoder", got="both", hint="leave one of them out")
    else:
        table = deps.store.assets.get(deps.owner, table_id)
        if table.kind is not models.AssetKind.TABLE:
            raise InvalidRequest("table", expected="an uploaded text table", got=f"{table.kind} {table.id}")
        spec = f"table:{table.path}"
        names |= {str(table.path): f"table {table.id}", f"text table {table.path.name}": f"table {table.id}"}
    return request | {"encoder": spec, "encoder_version": encoder_version(spec), "names": names}


# The routes

router = APIRouter(tags=["queries"], route_class=JsonRoute)


def bytes_of(media_type: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI description of an answer that is a file."""
    return {200: {"content": {media_type: {"schema": {"type": "string", "format": "binary"}}}}}


PNG, NPY, PLY = bytes_of(PNG_TYPE), bytes_of(NPY_TYPE), bytes_of(BINARY)
TERMS = (*LiftQuestion.model_fields, *Query.deciding())
ANSWER, ANSWER_IN_VIEW = Parameters(Question, TERMS), Parameters(Question, (*TERMS, "view", "top"))
IN_VIEW = Parameters(Question, (*TERMS, "view"), needs=("view",))
PICTURE = Parameters(RenderRequest, ("lift", "view", "channel"), needs=("view",))


@get_and_post(router, "/query", ANSWER_IN_VIEW, response_model=QueryAnswer)
def query(parameters: Question, deps: Deps, ask: Ask) -> dict[str, Any]:
    """Answer a question: the number of splats, the best splats, a box, and links to objects, splats and pictures.

    In a body examples may be vectors; POST the same body to the links of those.
    """
    lift = find_lift(parameters.lift, deps)
    request = query_request("query", parameters, lift, deps) | {"view": parameters.view, "top": parameters.top}
    answer = ask(request).header
    view = parameters.view or lift.first_view
    return {
        "lift": lift.id,
        "view": view,
        "text_space": lift.metadata["text_space"],
        "encoder": None if request["encoder"] is None else encoder_label(request["encoder"]),
        "links": _answer_links(parameters, lift, view, has_objects=answer["count"] > 0),
        **answer,
    }


@router.get("/query/words", response_model=WordsAnswer)
def query_words(parameters: Annotated[SuggestedWordsRequest, Parameter()], deps: Deps, ask: Ask) -> WordsAnswer:
    """List words: completions of a text, and words for the objects of the scene."""
    lift = find_lift(parameters.lift, deps)
    request = with_encoder(scene_request("askable", lift, deps), parameters, lift, deps)
    return WordsAnswer(lift=lift.id, **ask(request | {"text": parameters.text, "count": parameters.limit}).header)


@get_and_post(router, "/query/objects", ANSWER, response_model=ObjectsAnswer)
def query_objects(parameters: Question, deps: Deps, ask: Ask) -> dict[str, Any]:
    """List the objects of an answer, groups of splats that touch: the place and size of each."""
    lift = find_lift(parameters.lift, deps)
    return {"lift": lift.id, **ask(query_request("objects", parameters, lift, deps)).header}


@get_and_post(router, "/query/scores", ANSWER, responses=NPY, response_class=Response)
def query_scores(parameters: Question, request: Request, deps: Deps, ask: Ask) -> Response:
    """Return the score of each splat: .npy, float32 [P]."""
    return _entity("scores", parameters, request, deps, ask)


@get_and_post(router, "/query/selection", ANSWER, responses=NPY, response_class=Response)
def query_selection(parameters: Question, request: Request, deps: Deps, ask: Ask) -> Response:
    """Return the selected splats: .npy, bool [P]. With `auto` they are not just those at or above the threshold."""
    return _entity("selection", parameters, request, deps, ask)


@get_and_post(router, "/query/mask", IN_VIEW, responses=PNG, response_class=Response)
def query_mask(parameters: Question, request: Request, deps: Deps, ask: Ask) -> Response:
    """Render the mask of a view, or of a camera in a body: a PNG, white where the selection is."""
    return _entity("mask", parameters, request, deps, ask, seen_from(parameters))


@get_and_post(router, "/query/attention", IN_VIEW, responses=PNG, response_class=Response)
def query_attention(parameters: Question, request: Request, deps: Deps, ask: Ask) -> Response:
    """Render the scores of a view, or of a camera in a body, in colours: a PNG."""
    return _entity("attention", parameters, request, deps, ask, seen_from(parameters))


SPLATS_OF = "`object`: the selected splats, of all objects; `scores`: all splats in the colours of their scores"
SplatsOf = Annotated[Literal["object", "scores"], Parameter(description=SPLATS_OF)]


@get_and_post(router, "/query/splats", ANSWER, responses=PLY, response_class=Response)
def query_splats(parameters: Question, request: Request, deps: Deps, ask: Ask, what: SplatsOf = "object") -> Response:
    """Return the selected splats, or all splats in the colours of their scores: a PLY of the lifted dialect."""
    return _entity("splats", parameters, request, deps, ask, {"what": what})


@get_and_post(router, "/render", PICTURE, responses=PNG, response_class=Response)
def render(parameters: RenderRequest, request: Request, deps: Deps, ask: Ask) -> Response:
    """Render the splats from a view, in their colours or those of their features or clusters, or their depth: a PNG.

    Depths are those of the splats' centres along the camera's axis, weighted as the colours are, and grey: near is
    bright. The PNG's texts `depth-near` and `depth-far` are the depths of its levels 255 and 1 (1st and 99th
    percentile), in scene units, with even steps between; nearer and farther splats have these levels too. 0 means no
    splat. A body may have a camera in place of the view.
    """
    lift = find_lift(parameters.lift, deps)
    worker_request = scene_request("render", lift, deps) | seen_from(parameters) | {"channel": parameters.channel}
    return tagged_answer(request, deps, worker_request, lift, ask)


def _entity(
    operation: str,
    parameters: Question,
    request: Request,
    deps: AppState,
    ask: Ask,
    fields: dict[str, Any] | None = None,
) -> Response:
    """Return the answer to a GET with its tag, or the answer to a POST."""
    lift = find_lift(parameters.lift, deps)
    return tagged_answer(request, deps, query_request(operation, parameters, lift, deps) | (fields or {}), lift, ask)


def _answer_links(parameters: Question, lift: LiftRecord, view: str | None, *, has_objects: bool) -> dict[str, str]:
    """Return the URLs of other answers to the same query; vectors do not fit in a URL, so POST them again.

    Without ``has_objects`` the links to objects are left out, as the answer selected no splats.
    """
    links = {"lift": f"/lifts/{lift.id}", "scores": _link("/query/scores", parameters, lift=lift.id)}
    if has_objects:
        links["objects"] = _link("/query/objects", parameters, lift=lift.id)
        links["object"] = _link("/query/splats?what=object", parameters, lift=lift.id)
    links["coloured"] = _link("/query/splats?what=scores", parameters, lift=lift.id)
    if view is not None:
        links["mask"] = _link("/query/mask", parameters, lift=lift.id, view=view)
        links["attention"] = _link("/query/attention", parameters, lift=lift.id, view=view)
        links["render"] = f"/render?{urlencode({'lift': lift.id, 'view': view})}"
    return links


def example_text(example: str | tuple[float, ...]) -> str:
    """Return the text of an example in answers."""
    return example if isinstance(example, str) else f"a vector of {len(example)} channels"


def _link(path: str, parameters: Question, **fields: str) -> str:
    """Return a route with the fields that differ from their defaults, and always the threshold."""
    if not all(isinstance(example, str) for example in (*parameters.like, *parameters.unlike)):
        return path
    pairs: list[tuple[str, str]] = []
    for name in (*Query.deciding(), "encoder", "table"):
        value = getattr(parameters, name)
        if name == "threshold" or value != Question.model_fields[name].default:
            pairs += [(name, str(item)) for item in (value if isinstance(value, list) else [value])]
    return f"{path}{'&' if '?' in path else '?'}{urlencode(pairs + list(fields.items()))}"


@router.post("/query/segment", response_model=SegmentAnswer)
def segment(parameters: SegmentRequest, deps: Deps, ask: Ask) -> Response:
    """List the words of a vocabulary that are in the scene; each splat has its most similar word, or none."""
    lift = find_lift(parameters.lift, deps)
    request = _word_request("segment", parameters, lift, deps)
    head = {"lift": lift.id, "encoder": encoder_label(request["encoder"])}
    return binary_response(deps, request | {"head": head}, lift, ask, {})


@router.post("/query/segment/labels", responses=NPY, response_class=Response)
def segment_labels(parameters: SegmentRequest, deps: Deps, ask: Ask) -> Response:
    """Return the number of each splat's word among those of `/query/segment`, from 1, or 0: .npy, int32 [P]."""
    lift = find_lift(parameters.lift, deps)
    return binary_response(deps, _word_request("word_labels", parameters, lift, deps), lift, ask, {})


@router.post("/query/segment/map", responses=PNG, response_class=Response)
def segment_map(parameters: SegmentRequest, deps: Deps, ask: Ask) -> Response:
    """Draw the numbers of words for a view's pixels: a PNG with a palette, and words by number as text `legend`."""
    lift = find_lift(parameters.lift, deps)
    return binary_response(
        deps, _word_request("word_map", parameters, lift, deps) | seen_from(parameters), lift, ask, {}
    )


@router.post("/query/segment/picture", responses=PNG, response_class=Response)
def segment_picture(parameters: SegmentRequest, deps: Deps, ask: Ask) -> Response:
    """Draw a view tinted with the colours of its words, beside a legend: a PNG."""
    lift = find_lift(parameters.lift, deps)
    return binary_response(
        deps, _word_request("word_picture", parameters, lift, deps) | seen_from(parameters), lift, ask, {}
    )


@router.post("/query/export", responses=bytes_of("application/zip"), response_class=Response)
def export(parameters: ExportRequest, deps: Deps, ask: Ask) -> Response:
    """Export objects, words or queries as one ZIP: splats with labels, names, colours, boxes, counts, masks of views.

    It holds `labels.ply`, `labels.json`, `instances.csv`, `legend.png`, `masks/VIEW.png`, `masks.json` (COCO) and
    `truth.safetensors` (masks for a trade-off).
    """
    lift = find_lift(parameters.lift, deps)
    request: dict[str, Any] = scene_request("export", lift, deps) | NO_ENCODER | {"words": None}
    title = [parameters.of]
    if parameters.of == "questions":
        if not parameters.questions or any(question.lift not in (None, lift.id) for question in parameters.questions):
            raise InvalidRequest("questions", expected="a question or more, to the same lift", got="none, or others")
        by_name = _by_name(parameters.questions)
        parts = [
            {"name": name, "request": query_request("query", question, lift, deps)}
            for name, question in by_name.items()
        ]
        request, title = request | {"parts": parts}, list(by_name)
    elif parameters.of == "words" or parameters.encoder is not None or parameters.table is not None:
        request = _word_request("export", parameters, lift, deps)
    name = "-".join(re.findall(r"[A-Za-z0-9]+", " ".join(title)))[:80]
    labels = list(deps.store.selections.object_labels(deps.owner, lift.id).items())
    request |= {"of": parameters.of, "of_view": parameters.view, "name": name, "object_labels": labels}
    return binary_response(deps, request, lift, ask, {})


def _by_name(questions: list[models.NamedQuestion]) -> dict[str, models.NamedQuestion]:
    """Return queries by their names in files; a repeated name gets a number."""
    by_name = dict[str, models.NamedQuestion]()
    for question in questions:
        name = first = question.name or ", ".join(map(example_text, (*question.text, *question.like, *question.sets)))
        number = 1
        while name in by_name:
            number += 1
            name = f"{first} {number}"
        by_name[name] = question
    return by_name


@router.post("/query/what", response_model=NearestWordsAnswer)
def name_example(parameters: NearestWordsRequest, deps: Deps, ask: Ask) -> NearestWordsAnswer:
    """List the words nearest to a pixel, a splat, a region or a vector."""
    lift = find_lift(parameters.lift, deps)
    request = _word_request("what", parameters, lift, deps) | {"example": parameters.example, "top": parameters.top}
    return NearestWordsAnswer(
        lift=lift.id,
        encoder=encoder_label(request["encoder"]),
        example=example_text(parameters.example),
        **ask(request).header,
    )


def _word_request(operation: str, parameters: Words, lift: LiftRecord, deps: AppState) -> dict[str, Any]:
    request = with_encoder(scene_request(operation, lift, deps), parameters, lift, deps)
    return _with_packs_here(request, lift, deps) | {"words": parameters.words}
