"""/lifts: results."""

from __future__ import annotations

from functools import partial

from fastapi import APIRouter, Request, Response

from service import models
from service.content import FILE, Cursor, Limit, StoredFile, file_answer, listed
from service.state import Deps
from service.store.lifts import LiftRecord

router = APIRouter(prefix="/lifts", tags=["lifts"])


@router.get("", response_model=models.Lifts)
def list_lifts(deps: Deps, limit: Limit = None, cursor: Cursor = None) -> Response:
    """All lifts, newest first."""
    return listed("lifts", partial(deps.store.lifts.page, deps.owner), shape, limit=limit, cursor=cursor)


@router.get("/{lift}", response_model=models.LiftResult)
def get_lift(lift: str, deps: Deps) -> models.LiftResult:
    """One lift: its settings, certificate and timings."""
    return shape(deps.store.lifts.get(deps.owner, lift))


@router.get("/{lift}/features", response_class=Response, responses=FILE)
def get_features(lift: str, request: Request, deps: Deps) -> Response:
    """The lift file (safetensors), or a range of it."""
    found = deps.store.lifts.get(deps.owner, lift)
    return file_answer(request, StoredFile(found.path, found.bytes, found.sha256, f"lift-{found.id}.safetensors"))


def shape(lift: LiftRecord) -> models.LiftResult:
    """A lift as clients get it; paths of this machine stay deps."""
    metadata = lift.metadata
    return models.LiftResult(
        id=lift.id,
        bytes=lift.bytes,
        sha256=lift.sha256,
        splats=lift.splats,
        cameras=lift.cameras,
        features=list(lift.features),
        count=lift.count,
        channels=lift.channels,
        version=metadata["version"],
        settings=metadata["settings"],
        encoder=metadata["encoder"],
        text_space=metadata["text_space"],
        views=metadata["views"],
        certificate=metadata["certificate"],
        timings=metadata["timings"],
        created=lift.created,
        links={
            "self": f"/lifts/{lift.id}",
            "job": f"/jobs/{lift.id}",
            "features": f"/lifts/{lift.id}/features",
            "query": f"/query?lift={lift.id}&text=",
        },
    )
