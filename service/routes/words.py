"""/query/segment and /query/what: many words at once, what each splat is and what this is."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Response

from service.encoders import encoder_label
from service.queries import questions
from service.queries.requests import Ask, find_lift, made, scene_request, seen_from, with_encoder
from service.requests import JsonRoute
from service.routes.queries import NPY, PNG, shown
from service.state import AppState, Deps
from service.store.lifts import LiftRecord

router = APIRouter(prefix="/query", tags=["queries"], route_class=JsonRoute)


@router.post("/segment", response_model=questions.SegmentAnswer)
def segment(asked: questions.AskedToSegment, deps: Deps, ask: Ask) -> Response:
    """Which of many words are there, and where: to every splat the word that it is most like, or none."""
    lift = find_lift(asked.lift, deps)
    wanted = _wanted("segment", asked, lift, deps)
    head = {"lift": lift.id, "encoder": encoder_label(wanted["encoder"])}
    return made(deps, wanted | {"head": head}, lift, ask, {})


@router.post("/segment/labels", responses=NPY, response_class=Response)
def labels(asked: questions.AskedToSegment, deps: Deps, ask: Ask) -> Response:
    """The value of every splat's word, 0 for none: .npy, int32 [P]."""
    lift = find_lift(asked.lift, deps)
    return made(deps, _wanted("word_labels", asked, lift, deps), lift, ask, {})


@router.post("/segment/map", responses=PNG, response_class=Response)
def word_map(asked: questions.AskedToSegment, deps: Deps, ask: Ask) -> Response:
    """The values of a view's pixels in colours, with a palette: a PNG whose text `legend` has the words by value."""
    lift = find_lift(asked.lift, deps)
    return made(deps, _wanted("word_map", asked, lift, deps) | seen_from(asked), lift, ask, {})


@router.post("/segment/picture", responses=PNG, response_class=Response)
def picture(asked: questions.AskedToSegment, deps: Deps, ask: Ask) -> Response:
    """A view tinted with the colours of its words, beside a drawn legend: a PNG."""
    lift = find_lift(asked.lift, deps)
    return made(deps, _wanted("word_picture", asked, lift, deps) | seen_from(asked), lift, ask, {})


@router.post("/what", response_model=questions.WhatAnswer)
def what(asked: questions.AskedWhat, deps: Deps, ask: Ask) -> questions.WhatAnswer:
    """What is this? The words that a pixel, a splat, a region or a vector is most like."""
    lift = find_lift(asked.lift, deps)
    wanted = _wanted("what", asked, lift, deps) | {"example": asked.example, "top": asked.top}
    return questions.WhatAnswer(
        lift=lift.id, encoder=encoder_label(wanted["encoder"]), example=shown(asked.example), **ask(wanted).header
    )


def _wanted(operation: str, asked: questions.Words, lift: LiftRecord, deps: AppState) -> dict[str, Any]:
    request = with_encoder(scene_request(operation, lift, deps), asked, lift, deps)
    packs = [deps.store.assets.get(deps.owner, asset) for asset in lift.features]
    names = request["names"] | {str(pack.path): f"features {pack.id}" for pack in packs}
    return request | {"words": asked.words, "features": [str(pack.path) for pack in packs], "names": names}
