"""/query and /render: where words are in a scene, and pictures of it."""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import Field

from liftcore import __version__
from service import wire
from service.content import tagged, unchanged
from service.parts import Here, Parts
from service.settings import encoder_file, encoder_version
from service.store.lifts import LiftRecord

router = APIRouter(tags=["queries"])

PNG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}
}
NPY: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/x-npy": {"schema": {"type": "string", "format": "binary"}}}}
}

LiftParameter = Annotated[
    str | None, Query(pattern=wire.JOB_ID, description="the lift; may be left out when there is exactly one")
]
Number = Annotated[float, Field(ge=-1e6, le=1e6)]  # which NaN is not
View = Annotated[str, Query(min_length=1, max_length=500, description="the name of a camera")]


class Phrase:
    """The parameters that all queries share."""

    def __init__(
        self,
        text: Annotated[str, Query(min_length=1, max_length=1000, description="what to look for")],
        lift: LiftParameter = None,
        negatives: Annotated[
            list[str] | None, Query(max_length=32, description="what it is not; may be given several times")
        ] = None,
        threshold: Annotated[
            Literal["auto", "valley", "paper", "otsu"] | Number,
            Query(description="how to find it, or the score from which a splat counts as found"),
        ] = "auto",
        encoder: Annotated[
            str | None, Query(max_length=200, description="a text space that the operator set up, or default")
        ] = None,
    ) -> None:
        self.text = text
        self.lift = lift
        self.negatives = negatives or []
        self.threshold = threshold
        self.encoder = encoder

    def link(self, path: str, **more: str) -> str:
        """The URL of another look at the same query."""
        pairs: list[tuple[str, str]] = [("text", self.text), ("threshold", str(self.threshold))]
        pairs += [("negatives", negative) for negative in self.negatives]
        pairs += [("encoder", self.encoder)] if self.encoder is not None else []
        return f"{path}?{urlencode(pairs + list(more.items()))}"


PhraseParameters = Annotated[Phrase, Depends()]


@router.get("/query", response_model=wire.QueryAnswer)
def query(
    phrase: PhraseParameters,
    here: Here,
    view: Annotated[str | None, Query(min_length=1, max_length=500, description="for the links")] = None,
    top: Annotated[int, Query(ge=0, le=1000, description="how many of the best splats to list")] = 10,
) -> wire.QueryAnswer:
    """Where a phrase is: scores in numbers, the best splats, a box, and links to pictures."""
    lift = find_lift(phrase.lift, here)
    request = _request("query", phrase, lift, here) | {"view": view, "top": top}
    found = here.queries.call(request).header
    shown = view or next(iter(lift.metadata["views"]), None)
    links = {"lift": f"/lifts/{lift.id}", "scores": phrase.link("/query/scores", lift=lift.id)}
    if shown is not None:
        links["mask"] = phrase.link("/query/mask", lift=lift.id, view=shown)
        links["attention"] = phrase.link("/query/attention", lift=lift.id, view=shown)
        links["render"] = f"/render?{urlencode({'lift': lift.id, 'view': shown})}"
    return wire.QueryAnswer(
        text=phrase.text,
        lift=lift.id,
        view=shown,
        text_space=lift.metadata["text_space"],
        links=links,
        **found,
    )


@router.get("/query/scores", responses=NPY, response_class=Response)
def scores(phrase: PhraseParameters, request: Request, here: Here) -> Response:
    """The score of every splat: .npy, float32 [P]."""
    lift = find_lift(phrase.lift, here)
    return _entity(request, here, _request("scores", phrase, lift, here), lift, "application/x-npy")


@router.get("/query/mask", responses=PNG, response_class=Response)
def mask(phrase: PhraseParameters, view: View, request: Request, here: Here) -> Response:
    """Where the phrase is in a view: a PNG, white where it is."""
    lift = find_lift(phrase.lift, here)
    asked = _request("mask", phrase, lift, here) | {"view": view}
    return _entity(request, here, asked, lift, "image/png")


@router.get("/query/attention", responses=PNG, response_class=Response)
def attention(phrase: PhraseParameters, view: View, request: Request, here: Here) -> Response:
    """How well each pixel of a view answers to the phrase: a PNG."""
    lift = find_lift(phrase.lift, here)
    asked = _request("attention", phrase, lift, here) | {"view": view}
    return _entity(request, here, asked, lift, "image/png")


@router.get("/render", responses=PNG, response_class=Response)
def render(
    view: View,
    request: Request,
    here: Here,
    lift: LiftParameter = None,
    what: Annotated[
        Literal["rgb", "pca", "cluster"],
        Query(description="the splats' colours, three principal components of features, or clusters"),
    ] = "rgb",
) -> Response:
    """The splats from a view, in their colours or in those of their features or clusters: a PNG."""
    found = find_lift(lift, here)
    asked = _scene_request("render", found, here) | {"view": view, "what": what}
    return _entity(request, here, asked, found, "image/png")


def find_lift(lift: str | None, here: Parts) -> LiftRecord:
    """The lift that is meant; left out, the only one."""
    return here.store.lifts.only() if lift is None else here.store.lifts.get(lift)


def _request(operation: str, phrase: Phrase, lift: LiftRecord, here: Parts) -> dict[str, Any]:
    spec = here.settings.encoder_spec(lift.metadata["text_space"], phrase.encoder)
    asked = _scene_request(operation, lift, here)
    return asked | {
        "encoder": spec,
        "encoder_version": encoder_version(spec),
        "text": phrase.text,
        "negatives": phrase.negatives,
        "threshold": phrase.threshold,
        "names": asked["names"] | _encoder_names(spec),
    }


def _scene_request(operation: str, lift: LiftRecord, here: Parts) -> dict[str, Any]:
    job = here.store.jobs.get(lift.id)
    splats, cameras = here.store.assets.get(job.splats), here.store.assets.get(job.cameras)
    return {
        "operation": operation,
        "lift": str(lift.path),
        "splats": str(splats.path),
        "cameras": str(cameras.path),
        "names": {
            str(lift.path): f"lift {lift.id}",
            str(splats.path): f"splats {splats.id}",
            str(cameras.path): f"cameras {cameras.id}",
        },
    }


def _encoder_names(spec: str) -> dict[str, str]:
    file = encoder_file(spec)
    return {} if file is None else {str(file): "the encoder's file"}


def _entity(request: Request, here: Parts, asked: dict[str, Any], lift: LiftRecord, media_type: str) -> Response:
    etag = entity_tag(asked, lift)
    return unchanged(request, etag) or tagged(here.queries.call(asked).body, media_type, etag)


def entity_tag(asked: dict[str, Any], lift: LiftRecord) -> str:
    """The tag of an answer, from all that decides it: so 304 costs no query."""
    decides = {name: value for name, value in asked.items() if name != "names"}
    decides["lift"] = lift.sha256
    decides["version"] = __version__
    return f'"{hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()}"'
