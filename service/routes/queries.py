"""/query and /render: where words and examples are in a scene, what is there of many words, and pictures of it."""

from __future__ import annotations

from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Request, Response
from fastapi import Query as Parameter

from liftcore import Query
from service.queries.questions import (
    AskedForWords,
    AskedToRender,
    AskedToSegment,
    AskedWhat,
    LiftQuestion,
    ObjectsAnswer,
    QueryAnswer,
    Question,
    SegmentAnswer,
    WhatAnswer,
    Words,
    WordsAnswer,
)
from service.queries.requests import (
    Ask,
    find_lift,
    made,
    query_request,
    scene_request,
    seen_from,
    tagged_answer,
    with_encoder,
)
from service.requests import JsonRoute, Parameters, both
from service.settings import encoder_label
from service.state import AppState, Deps
from service.store.lifts import LiftRecord

router = APIRouter(tags=["queries"], route_class=JsonRoute)


def bytes_of(media_type: str) -> dict[int | str, dict[str, Any]]:
    """What OpenAPI tells of an answer that is a file."""
    return {200: {"content": {media_type: {"schema": {"type": "string", "format": "binary"}}}}}


PNG, NPY, PLY = bytes_of("image/png"), bytes_of("application/x-npy"), bytes_of("application/octet-stream")
TERMS = (*LiftQuestion.model_fields, *Query.deciding())
ASKED, WHERE = Parameters(Question, TERMS), Parameters(Question, (*TERMS, "view", "top"))
IN_VIEW = Parameters(Question, (*TERMS, "view"), needs=("view",))
PICTURE = Parameters(AskedToRender, ("lift", "view", "what"), needs=("view",))


@both(router, "/query", WHERE, response_model=QueryAnswer)
def query(asked: Question, deps: Deps, ask: Ask) -> dict[str, Any]:
    """Where it is: scores in numbers, the best splats, a box, and links to objects, splats and pictures.

    In a body examples may be vectors; POST the same body to the links of those.
    """
    lift = find_lift(asked.lift, deps)
    request = query_request("query", asked, lift, deps) | {"view": asked.view, "top": asked.top}
    found = ask(request).header
    view = asked.view or lift.first_view
    return {
        "lift": lift.id,
        "view": view,
        "text_space": lift.metadata["text_space"],
        "encoder": None if request["encoder"] is None else encoder_label(request["encoder"]),
        "links": _answer_links(asked, lift, view, found=found["count"] > 0),
        **found,
    }


@router.get("/query/words", response_model=WordsAnswer)
def askable(asked: Annotated[AskedForWords, Parameter()], deps: Deps, ask: Ask) -> WordsAnswer:
    """What can be asked: words that a text which is being typed may become, and words for what is here."""
    lift = find_lift(asked.lift, deps)
    wanted = with_encoder(scene_request("askable", lift, deps), asked, lift, deps)
    return WordsAnswer(lift=lift.id, **ask(wanted | {"text": asked.text, "count": asked.limit}).header)


@both(router, "/query/objects", ASKED, response_model=ObjectsAnswer)
def objects(asked: Question, deps: Deps, ask: Ask) -> dict[str, Any]:
    """The things that were found, splats that touch one another: where each lies, and how large it is."""
    lift = find_lift(asked.lift, deps)
    return {"lift": lift.id, **ask(query_request("objects", asked, lift, deps)).header}


@both(router, "/query/scores", ASKED, responses=NPY, response_class=Response)
def scores(asked: Question, request: Request, deps: Deps, ask: Ask) -> Response:
    """The score of every splat: .npy, float32 [P]."""
    return _entity("scores", asked, request, deps, ask)


@both(router, "/query/selection", ASKED, responses=NPY, response_class=Response)
def selection(asked: Question, request: Request, deps: Deps, ask: Ask) -> Response:
    """Which splats were selected: .npy, bool [P]. By `auto` they are not just those at or above the threshold."""
    return _entity("selection", asked, request, deps, ask)


@both(router, "/query/mask", IN_VIEW, responses=PNG, response_class=Response)
def mask(asked: Question, request: Request, deps: Deps, ask: Ask) -> Response:
    """Where it is in a view, or from a camera of your own in a body: a PNG, white where it is."""
    return _entity("mask", asked, request, deps, ask, seen_from(asked))


@both(router, "/query/attention", IN_VIEW, responses=PNG, response_class=Response)
def attention(asked: Question, request: Request, deps: Deps, ask: Ask) -> Response:
    """How well each pixel of a view, or of a camera of your own in a body, answers to it: a PNG."""
    return _entity("attention", asked, request, deps, ask, seen_from(asked))


SPLATS_OF = "the splats that were found and no others, or all splats in the colours of their scores"
SplatsOf = Annotated[Literal["object", "scores"], Parameter(description=SPLATS_OF)]


@both(router, "/query/splats", ASKED, responses=PLY, response_class=Response)
def splats(asked: Question, request: Request, deps: Deps, ask: Ask, what: SplatsOf = "object") -> Response:
    """What was found, or the scene in the colours of its scores, as splats: a PLY of the dialect that was lifted."""
    return _entity("splats", asked, request, deps, ask, {"what": what})


@both(router, "/render", PICTURE, responses=PNG, response_class=Response)
def render(asked: AskedToRender, request: Request, deps: Deps, ask: Ask) -> Response:
    """The splats from a view, in their colours or in those of their features or clusters, or their depth: a PNG.

    Depths are those of the splats' centres along the camera's axis, weighted as the colours are. They are grey, near
    bright. The PNG's texts `depth-near` and `depth-far` tell the depths of its levels 255 and 1 (1st and 99th
    percentile), in scene units, with even steps between; what lies beyond has these levels too. 0 is where no splat
    is. In a body a camera of your own may stand in place of the view.
    """
    lift = find_lift(asked.lift, deps)
    wanted = scene_request("render", lift, deps) | seen_from(asked) | {"what": asked.what}
    return tagged_answer(request, deps, wanted, lift, ask)


def _entity(
    operation: str,
    asked: Question,
    request: Request,
    deps: AppState,
    ask: Ask,
    more: dict[str, Any] | None = None,
) -> Response:
    """What a GET names, with its tag, or what a POST asks for."""
    lift = find_lift(asked.lift, deps)
    return tagged_answer(request, deps, query_request(operation, asked, lift, deps) | (more or {}), lift, ask)


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


def shown(example: str | tuple[float, ...]) -> str:
    """An example as an answer names it."""
    return example if isinstance(example, str) else f"a vector of {len(example)} channels"


def _link(path: str, asked: Question, **more: str) -> str:
    """A route with the fields that are not as they are without being asked for, and always the threshold."""
    if not all(isinstance(example, str) for example in (*asked.like, *asked.unlike)):
        return path
    pairs: list[tuple[str, str]] = []
    for name in (*Query.deciding(), "encoder", "table"):
        value = getattr(asked, name)
        if name == "threshold" or value != Question.model_fields[name].default:
            pairs += [(name, str(one)) for one in (value if isinstance(value, list) else [value])]
    return f"{path}{'&' if '?' in path else '?'}{urlencode(pairs + list(more.items()))}"


@router.post("/query/segment", response_model=SegmentAnswer)
def segment(asked: AskedToSegment, deps: Deps, ask: Ask) -> Response:
    """Which of many words are there, and where: to every splat the word that it is most like, or none."""
    lift = find_lift(asked.lift, deps)
    wanted = _word_request("segment", asked, lift, deps)
    head = {"lift": lift.id, "encoder": encoder_label(wanted["encoder"])}
    return made(deps, wanted | {"head": head}, lift, ask, {})


@router.post("/query/segment/labels", responses=NPY, response_class=Response)
def labels(asked: AskedToSegment, deps: Deps, ask: Ask) -> Response:
    """The value of every splat's word, 0 for none: .npy, int32 [P]."""
    lift = find_lift(asked.lift, deps)
    return made(deps, _word_request("word_labels", asked, lift, deps), lift, ask, {})


@router.post("/query/segment/map", responses=PNG, response_class=Response)
def word_map(asked: AskedToSegment, deps: Deps, ask: Ask) -> Response:
    """The values of a view's pixels in colours, with a palette: a PNG whose text `legend` has the words by value."""
    lift = find_lift(asked.lift, deps)
    return made(deps, _word_request("word_map", asked, lift, deps) | seen_from(asked), lift, ask, {})


@router.post("/query/segment/picture", responses=PNG, response_class=Response)
def picture(asked: AskedToSegment, deps: Deps, ask: Ask) -> Response:
    """A view tinted with the colours of its words, beside a drawn legend: a PNG."""
    lift = find_lift(asked.lift, deps)
    return made(deps, _word_request("word_picture", asked, lift, deps) | seen_from(asked), lift, ask, {})


@router.post("/query/what", response_model=WhatAnswer)
def what(asked: AskedWhat, deps: Deps, ask: Ask) -> WhatAnswer:
    """What is this? The words that a pixel, a splat, a region or a vector is most like."""
    lift = find_lift(asked.lift, deps)
    wanted = _word_request("what", asked, lift, deps) | {"example": asked.example, "top": asked.top}
    return WhatAnswer(
        lift=lift.id, encoder=encoder_label(wanted["encoder"]), example=shown(asked.example), **ask(wanted).header
    )


def _word_request(operation: str, asked: Words, lift: LiftRecord, deps: AppState) -> dict[str, Any]:
    request = with_encoder(scene_request(operation, lift, deps), asked, lift, deps)
    packs = [deps.store.assets.get(deps.owner, asset) for asset in lift.features]
    names = request["names"] | {str(pack.path): f"features {pack.id}" for pack in packs}
    return request | {"words": asked.words, "features": [str(pack.path) for pack in packs], "names": names}
