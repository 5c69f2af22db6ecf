"""/lifts: results."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from service import wire
from service.content import FILE, StoredFile, file_answer
from service.parts import Here
from service.store.lifts import LiftRecord

router = APIRouter(prefix="/lifts", tags=["lifts"])


@router.get("", response_model=wire.Lifts)
def list_lifts(here: Here) -> wire.Lifts:
    """All lifts, newest first."""
    return wire.Lifts(lifts=[shape(lift) for lift in here.store.lifts.all()])


@router.get("/{lift}", response_model=wire.LiftResult)
def get_lift(lift: str, here: Here) -> wire.LiftResult:
    """One lift: its settings, certificate and timings."""
    return shape(here.store.lifts.get(lift))


@router.get("/{lift}/features", response_class=Response, responses=FILE)
def get_features(lift: str, request: Request, here: Here) -> Response:
    """The lift file (safetensors), or a range of it."""
    found = here.store.lifts.get(lift)
    return file_answer(request, StoredFile(found.path, found.bytes, found.sha256, f"lift-{found.id}.safetensors"))


def shape(lift: LiftRecord) -> wire.LiftResult:
    """A lift as the wire has it; paths of this machine stay here."""
    metadata = lift.metadata
    return wire.LiftResult(
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
