"""/query and /render: where words and examples are in a scene, what is there of many words, and pictures of it."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import secrets
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

import anyio
from fastapi import APIRouter, Request, Response
from fastapi import Path as PathParameter
from fastapi import Query as Parameter
from fastapi.responses import FileResponse
from starlette.convertors import register_url_convertor
from starlette.types import Receive, Scope, Send

from liftcore import Query, __version__
from liftcore.text import encoder_file
from service import models
from service.errors import InvalidRequest
from service.models import (
    ExportRequest,
    LiftQuestion,
    NearestWordsAnswer,
    NearestWordsRequest,
    ObjectsAnswer,
    QueryAnswer,
    Question,
    QuestionParameters,
    RenderParameters,
    RenderRequest,
    SegmentAnswer,
    SegmentRequest,
    SuggestedWordsAnswer,
    SuggestedWordsRequest,
    Words,
)
from service.routes import BINARY, Caller, Deps, OneOf, Parts, cache_headers, content_of, get_and_post, unchanged
from service.selections import bits_of_selection, get_selection, object_labels
from service.settings import encoder_label, encoder_spec, encoder_version
from service.store import SERVICE, Owner

NO_ENCODER: dict[str, Any] = {"encoder": None, "encoder_version": None}  # of a question without words
SELECTION = "selection:"  # prefix of examples that need a stored selection
NPY, PNG, JSON = "application/x-npy", "image/png", "application/json"
# The outputs of a question, by name: media type, and what they are; pictures need a view, or a camera in a body
Output = Literal["objects", "scores", "selection", "mask", "attention", "object", "coloured"]
OUTPUTS: dict[Output, tuple[str, str]] = {
    "objects": (JSON, "the objects of the answer, groups of splats that touch: the place and size of each"),
    "scores": (NPY, "the score of each splat: float32 [P]"),
    "selection": (NPY, "the selected splats: bool [P]; with `auto` not just those at or above the threshold"),
    "mask": (PNG, "the mask of a view, white where the selection is"),
    "attention": (PNG, "the scores in a view, in colours"),
    "object": (BINARY, "the selected splats: a PLY"),
    "coloured": (BINARY, "all splats in the colours of their scores: a PLY"),
}
PICTURES = ("mask", "attention", "map", "picture")
WordOutput = Literal["labels", "map", "picture"]
WORD_OUTPUTS: dict[WordOutput, tuple[str, str]] = {
    "labels": (NPY, "the number of each splat's word among those of `/query/segment`, from 1, or 0: int32 [P]"),
    "map": (PNG, "these numbers for a view's pixels, with a palette, and words by number as text `legend`"),
    "picture": (PNG, "a view tinted with the colours of its words, beside a legend"),
}
# Files with labels, by format: the content (`Scene.blocks_of`), suffix, media type, and what they are
EXPORTS: dict[str, tuple[str, str, str, str]] = {
    "ply": ("labelled", ".ply", BINARY, "the splats with columns of numbers, which `names` explains"),
    "glb": ("labelled", ".glb", BINARY, "glTF with feature ids and property tables"),
    "usdz": ("labelled", ".usdz", BINARY, "OpenUSD, a prim for each object"),
    "names": ("names", ".json", JSON, "names, colours, counts and boxes of the labels"),
    "masks": ("masks", ".json", JSON, "COCO's masks of the objects in the views"),
}


def _list(outputs: dict[Any, tuple[str, str]]) -> str:
    return "\n".join(f"- `{name}`: {text}" for name, (_, text) in outputs.items())


register_url_convertor("output", OneOf(*OUTPUTS))
register_url_convertor("form", OneOf(*WORD_OUTPUTS))
router = APIRouter(tags=["queries"])


# Requests for the query process, and its answers


def respond(
    request: Request, deps: Parts, order: dict[str, Any], media_type: str = JSON, filename: str | None = None
) -> Response:
    """Send a request to the query process; return its answer: a document, or a file that the client may have already.

    The entity tag of a file is a digest of all inputs. The answer to a POST has no address, and so no tag.
    """
    headers = {"Cache-Control": "private, no-cache"}
    if request.method == "GET" and media_type != JSON:
        decides = {name: value for name, value in order.items() if name != "names"} | {"version": __version__}
        headers = cache_headers(f'"{hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()}"')
        if answer := unchanged(request, headers["ETag"], exists=False):  # whether the view exists is not known yet
            return answer
    draft = deps.store.root / "tmp" / f"{secrets.token_hex(16)}{Path(filename or '').suffix}"
    deps.store.make_folders()
    try:
        answer = deps.queries.call(order | {"draft": str(draft)})
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    if "document" in answer:
        return Response(answer["document"], headers=headers, media_type=media_type)
    return DraftResponse(draft, headers=headers, media_type=media_type, filename=filename)


class DraftResponse(FileResponse):
    """A file that is removed after its answer, also one that is refused (416) or broken off."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file, and remove it."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(os.unlink, self.path)


def scene_request(operation: str, lift: models.Lift, deps: Parts) -> dict[str, Any]:
    """Return the fields of a lift's files for the query process; ``names`` maps them to the client's names."""
    splats, cameras = (deps.store.asset(SERVICE, asset) for asset in (lift.splats, lift.cameras))
    names = {str(item.file): item.client_name for item in (splats, cameras)}
    return {
        "task": "reply",
        "kind": "query",
        "scratch": str(deps.store.root / "tmp"),
        "operation": operation,
        "lift": str(lift.file),
        "sha256": lift.sha256,
        "splats": str(splats.file),
        "cameras": str(cameras.file),
        "kernel": splats.kernel(lift.settings),
        "world": lift.world.model_dump(mode="json"),
        "names": names | {str(lift.file): f"lift {lift.id}", str(deps.store.root): "the data directory"},
    }


def query_request(operation: str, question: Question, lift: models.Lift, deps: Parts, owner: Owner) -> dict[str, Any]:
    """Return the request of a question: with the encoder of its texts, and its selections."""
    order = scene_request(operation, lift, deps)
    examples = [str(item) for item in (*question.sets, *question.like, *question.unlike)]
    order |= with_selections(examples, lift, deps)
    order = with_encoder(order, question, lift, deps, owner) if question.texts else order | NO_ENCODER
    return order | {"query": question.model_dump(mode="json", include=set(Query.deciding()))}


def with_selections(sets: list[str], lift: models.Lift, deps: Parts) -> dict[str, Any]:
    """Return the selections among sets, if there are any, as a field for the query process."""
    names = sorted({item.removeprefix(SELECTION) for item in sets if item.startswith(SELECTION)})
    selections = {
        name: bits_text(bits_of_selection(deps.store, get_selection(deps.store, lift.id, name))) for name in names
    }
    return {"selections": selections} if selections else {}


def bits_text(bits: bytes) -> str:
    """Return the packed booleans of a selection as base64 text."""
    return base64.b64encode(bits).decode()


def seen_from(view: models.Viewpoint) -> dict[str, Any]:
    """Return the camera of a picture: a view of the lift, or a camera of the request."""
    return {"view": view.view, "camera": view.camera and view.camera.model_dump()}


def with_encoder(
    order: dict[str, Any], words: LiftQuestion | models.NodesRequest, lift: models.Lift, deps: Parts, owner: Owner
) -> dict[str, Any]:
    """Return the request with the encoder of its words: an uploaded table, the lift's, or one of the operator."""
    names, table_id = dict(order["names"]), words.table
    if words.table is not None and words.encoder is not None:
        raise InvalidRequest("table", expected="table or encoder", got="both", hint="leave one of them out")
    if table_id is None and words.encoder in (None, lift.text_space):  # the words that came with the lift
        table_id = lift.parameters.get("table")
    if table_id is None:
        spec = encoder_spec(deps.settings, lift.text_space, words.encoder)
        if (file := encoder_file(spec)) is not None:
            names |= {str(file): "the encoder's file", f"text table {file.name}": "the text table"}
    else:
        table = deps.store.asset(SERVICE if words.table is None else owner, table_id)
        if table.kind != "table":
            got = f"{table.kind} {table.id}"
            raise InvalidRequest("table", expected="the id of an uploaded text table", got=got)
        spec = f"table:{table.file}"
        names |= {str(table.file): table.client_name, f"text table {table.file.name}": table.client_name}
    return order | {"encoder": spec, "encoder_version": encoder_version(spec), "names": names}


def word_request(operation: str, words: Words, lift: models.Lift, deps: Parts, owner: Owner) -> dict[str, Any]:
    """Return the request of many words."""
    order = with_encoder(scene_request(operation, lift, deps), words, lift, deps, owner)
    head = {"lift": lift.id, "encoder": encoder_label(order["encoder"])}
    return order | {"words": words.words, "head": head}


# The routes


@get_and_post(router, "/query", QuestionParameters, Question, response_model=QueryAnswer)
def query(question: Question, request: Request, deps: Deps, owner: Caller) -> Response:
    """Answer a question: the number of splats, the best splats, a box, and whether it is there.

    In a body examples may be vectors; POST the same body to the outputs of /query/{output}.
    """
    lift = deps.store.lift(owner, question.lift)
    order = query_request("query", question, lift, deps, owner) | {"view": question.view, "top": question.top}
    encoder = None if order["encoder"] is None else encoder_label(order["encoder"])
    order["head"] = {"lift": lift.id, "text_space": lift.text_space, "encoder": encoder}
    return respond(request, deps, order | {"links": _links(question, lift.id)})


def _links(question: Question, lift: str) -> dict[str, str]:
    """Return the addresses of the outputs of a question, without a view; vectors do not fit, so POST them again."""
    fields: dict[str, Any] = {}
    if all(isinstance(example, str) for example in (*question.like, *question.unlike)):
        names = (*Query.deciding(), "encoder", "table")
        fields = question.model_dump(mode="json", include=set(names), exclude_defaults=True)
        fields["threshold"] = question.threshold
    links = {"lift": f"/lifts/{lift}", "render": f"/render?lift={lift}"}
    address = urlencode(fields | {"lift": lift}, doseq=True)
    return links | {name: f"/query/{name}?{address}" for name in OUTPUTS if name != "selection"}


@router.get("/query/suggested_words", response_model=SuggestedWordsAnswer)
def suggested_words(
    words: Annotated[SuggestedWordsRequest, Parameter()], request: Request, deps: Deps, owner: Caller
) -> Response:
    """List words: completions of a text, and words for the objects of the scene."""
    lift = deps.store.lift(owner, words.lift)
    order = with_encoder(scene_request("suggested_words", lift, deps), words, lift, deps, owner)
    return respond(request, deps, order | {"text": words.text, "limit": words.limit, "head": {"lift": lift.id}})


@router.post("/query/segment", response_model=SegmentAnswer)
def segment(words: SegmentRequest, request: Request, deps: Deps, owner: Caller) -> Response:
    """List the words of a vocabulary that are in the scene; each splat has its most similar word, or none."""
    lift = deps.store.lift(owner, words.lift)
    return respond(request, deps, word_request("segment", words, lift, deps, owner))


@router.post(
    "/query/segment/{form:form}", responses=content_of(NPY, PNG), response_class=Response,
    description=f"Return splats or a view by their words, of POST /query/segment.\n\n{_list(WORD_OUTPUTS)}",
)  # fmt: skip
def segment_output(form: WordOutput, words: SegmentRequest, request: Request, deps: Deps, owner: Caller) -> Response:
    """Return splats or a view by their words."""
    lift = deps.store.lift(owner, words.lift)
    order = word_request(form, words, lift, deps, owner) | (seen_from(words) if form in PICTURES else {})
    return respond(request, deps, order, WORD_OUTPUTS[form][0])


@router.post(
    "/query/export", responses=content_of(BINARY, JSON), response_class=Response,
    description="Export objects, words or questions as a file with labels.\n\n"
    + _list({name: row[2:] for name, row in EXPORTS.items()}),
)  # fmt: skip
def export(parameters: ExportRequest, request: Request, deps: Deps, owner: Caller) -> Response:
    """Export objects, words or questions as a file with labels."""
    lift = deps.store.lift(owner, parameters.lift)
    order: dict[str, Any] = scene_request("export", lift, deps) | NO_ENCODER
    title = [parameters.of]
    if parameters.of == "questions":
        if not parameters.questions or any(question.lift not in (None, lift.id) for question in parameters.questions):
            raise InvalidRequest("questions", expected="a question or more, to the same lift", got="none, or others")
        by_name = _by_name(parameters.questions)
        parts = [
            {"name": name, "request": query_request("query", question, lift, deps, owner)}
            for name, question in by_name.items()
        ]
        order, title = order | {"parts": parts}, list(by_name)
    elif parameters.of == "words" or parameters.encoder is not None or parameters.table is not None:
        order = word_request("export", parameters, lift, deps, owner)
    name = "-".join(re.findall(r"[A-Za-z0-9]+", " ".join(title)))[:80] or "splats"
    content, suffix, media_type, _ = EXPORTS[parameters.format]
    order |= {"of": parameters.of, "of_view": parameters.view, "object_labels": labels_of(lift, deps)}
    order |= {"content": content, "suffix": suffix}
    return respond(request, deps, order, media_type, f"{name}-{lift.id}{suffix}")


def labels_of(lift: models.Lift, deps: Parts) -> dict[str, tuple[str | None, bool]]:
    """Return the labels of a lift's objects for the query process: name and whether it is hidden, by number."""
    return {str(label.id): (label.name, label.hidden) for label in object_labels(deps.store, lift.id)}


def _by_name(questions: list[models.NamedQuestion]) -> dict[str, models.NamedQuestion]:
    """Return questions by their names in files; a repeated name gets a number."""
    by_name = dict[str, models.NamedQuestion]()
    for question in questions:
        terms = map(example_text, (*question.text, *question.like, *question.sets))
        name = title = question.name or ", ".join(terms)
        number = 1
        while name in by_name:
            number += 1
            name = f"{title} {number}"
        by_name[name] = question
    return by_name


def example_text(example: str | tuple[float, ...]) -> str:
    """Return the text of an example in answers."""
    return example if isinstance(example, str) else f"a vector of {len(example)} channels"


@router.post("/query/nearest_words", response_model=NearestWordsAnswer)
def nearest_words(words: NearestWordsRequest, request: Request, deps: Deps, owner: Caller) -> Response:
    """List the words nearest to a pixel, a splat or a vector."""
    lift = deps.store.lift(owner, words.lift)
    order = word_request("nearest_words", words, lift, deps, owner) | {"example": words.example, "top": words.top}
    order["head"] |= {"example": example_text(words.example)}
    return respond(request, deps, order)


@get_and_post(
    router, "/query/{output:output}", QuestionParameters, Question, response_class=Response,
    responses=content_of(NPY, PNG, BINARY) | {200: content_of(NPY, PNG, BINARY)[200] | {"model": ObjectsAnswer}},
    description=f"Return an output of a question, or in a body of a question with vectors.\n\n{_list(OUTPUTS)}",
)  # fmt: skip
def query_output(
    output: Annotated[Output, PathParameter()], question: Question, request: Request, deps: Deps, owner: Caller
) -> Response:
    """Return an output of a question."""
    lift = deps.store.lift(owner, question.lift)
    order = query_request(output, question, lift, deps, owner) | {"head": {"lift": lift.id}}
    if output in PICTURES:
        order |= seen_from(question)
    media_type = OUTPUTS[output][0]
    return respond(request, deps, order, media_type, f"{output}-{lift.id}.ply" if media_type == BINARY else None)


@get_and_post(
    router, "/render", RenderParameters, RenderRequest, responses=content_of(PNG), response_class=Response
)  # fmt: skip
def render(question: RenderRequest, request: Request, deps: Deps, owner: Caller) -> Response:
    """Render the splats from a view, in their colours or those of their features or clusters, or their depth: a PNG.

    Depths are those of the splats' centres along the camera's axis, weighted as the colours are, and grey: near is
    bright. The PNG's texts `depth-near` and `depth-far` are the depths of its levels 255 and 1 (1st and 99th
    percentile), in scene units, with even steps between; nearer and farther splats have these levels too. 0 means no
    splat. A body may have a camera in place of the view.
    """
    lift = deps.store.lift(owner, question.lift)
    order = scene_request("render", lift, deps) | seen_from(question) | {"channel": question.channel}
    hide = question.hide and [item for item in question.hide if item]  # `hide=` of an address: none
    if hide is None:
        hide = [f"object:{label.id}" for label in object_labels(deps.store, lift.id) if label.hidden]
    order |= {"hide": hide} | with_selections(hide, lift, deps)
    return respond(request, deps, order, PNG)
