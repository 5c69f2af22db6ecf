"""What routes ask of the query process: requests with the files of a lift and an encoder, and answers with a tag."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, Request, Response

from liftcore import Query, __version__
from liftcore.text import encoder_file
from service import models
from service.content import BINARY, Draft, kept, unchanged
from service.errors import InvalidRequest
from service.queries import questions
from service.queries.client import PIPE_BYTES, Frame, Waiter
from service.settings import encoder_spec, encoder_version
from service.state import AppState, Deps
from service.store.assets import kernel_of
from service.store.lifts import LiftRecord

ROW_BYTES, SCORE_BYTES = 32, 4  # of a splat in the .splat format, and in an array
NUMBER_BYTES = 24  # of a number in JSON, at most
NO_ENCODER: dict[str, Any] = {"encoder": None, "encoder_version": None}  # of a question without words
REGION, SELECTION = "region:", "selection:"  # what needs the lift's packs, or a selection of it, begins so
NPY, PNG, JSON = "application/x-npy", "image/png", "application/json"
MEDIA_TYPES = {
    **dict.fromkeys(("scores", "selection", "layer", "word_labels"), NPY),
    **dict.fromkeys(("mask", "attention", "render", "word_map", "word_picture", "region_mask"), PNG),
    **dict.fromkeys(("catalogue", "segment", "tree"), JSON),
    **dict.fromkeys(("splats", "scene"), BINARY),
}


# The body is read before this listens, as both listen to the client.
async def _asking(request: Request, deps: Deps) -> AsyncIterator[Callable[[dict[str, Any]], Frame]]:
    """Ask the query process for this caller, who may leave: a query that waits then is not answered."""
    waiter = Waiter(deps.caller.key or "")

    async def listen() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass
        deps.queries.cancel(waiter)

    listening = asyncio.create_task(listen())
    try:
        yield lambda wanted: deps.queries.call(wanted, waiter)
    finally:
        listening.cancel()


Ask = Annotated[Callable[[dict[str, Any]], Frame], Depends(_asking, scope="function")]


def tagged_answer(request: Request, deps: AppState, wanted: dict[str, Any], lift: LiftRecord, ask: Ask) -> Response:
    """304 when the client has it already, and nothing is asked; else it. The tag is made of all that decides it.

    What a POST asks for has no address, and so no tag.
    """
    if request.method == "POST":
        return made(deps, wanted, lift, ask, {})
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


def query_request(operation: str, asked: questions.Question, lift: LiftRecord, deps: AppState) -> dict[str, Any]:
    """The same with a query; texts bring their encoder, and examples of regions the lift's feature packs."""
    request: dict[str, Any] = scene_request(operation, lift, deps)
    named = [str(one).removeprefix(SELECTION) for one in (*asked.sets, *asked.like, *asked.unlike) if _selects(one)]
    if named:
        found = {name: deps.store.selections.get(deps.owner, lift.id, name) for name in dict.fromkeys(named)}
        request["selections"] = {name: bits_of(deps.store.selections.bits(one)) for name, one in found.items()}
    request = with_encoder(request, asked, lift, deps) if asked.texts else {**request, **NO_ENCODER}
    if any(isinstance(example, str) and example.startswith(REGION) for example in (*asked.like, *asked.unlike)):
        request = with_packs(request, lift, deps, "like")
    return request | {"query": asked.model_dump(mode="json", include=set(Query.deciding()))}


def _selects(example: object) -> bool:
    return isinstance(example, str) and example.startswith(SELECTION)


def bits_of(bits: bytes) -> str:
    """The splats of a selection, as the query process takes them."""
    return base64.b64encode(bits).decode()


def seen_from(asked: questions.Seen) -> dict[str, Any]:
    """The camera of a picture: a view of the lift, or one of the client's own.

    Raises:
        InvalidRequest: neither is there, or both are.
    """
    if (asked.view is None) == (asked.camera is None):
        expected, got = "a view's name or a camera", "nothing" if asked.view is None else "both"
        raise InvalidRequest("view", expected=expected, got=got, hint="in the body of the request")
    return {"view": asked.view} if asked.camera is None else {"camera": asked.camera.model_dump()}


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
    asked: questions.LiftQuestion | questions.AskedForNodes,
    lift: LiftRecord,
    deps: AppState,
) -> dict[str, Any]:
    """The request with the encoder of its words: an uploaded table, the lift's, or one of the operator.

    Raises:
        InvalidRequest: there is none of the lift's space, or of two names.
        NotFound: there is no such table.
    """
    names, chosen = dict(request["names"]), asked.table
    if chosen is None and asked.encoder in (None, lift.metadata["text_space"]):  # the words that came with the lift
        chosen = deps.store.jobs.get(deps.owner, lift.id).parameters.get("table")
    if chosen is None:
        spec = encoder_spec(deps.settings, lift.metadata["text_space"], asked.encoder)
        file = encoder_file(spec)
        names |= {} if file is None else {str(file): "the encoder's file"}
    elif asked.table is not None and asked.encoder is not None:
        raise InvalidRequest("table", expected="table or encoder", got="both", hint="leave one of them out")
    else:
        table = deps.store.assets.get(deps.owner, chosen)
        if table.kind is not models.AssetKind.TABLE:
            raise InvalidRequest("table", expected="an uploaded text table", got=f"{table.kind} {table.id}")
        spec = f"table:{table.path}"
        names |= {str(table.path): f"table {table.id}", f"text table {table.path.name}": f"table {table.id}"}
    return request | {"encoder": spec, "encoder_version": encoder_version(spec), "names": names}
