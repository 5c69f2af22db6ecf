"""/tradeoff and /tradeoffs: speed against accuracy on a scene, measured."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request, Response

from liftcore.errors import InvalidSettings
from liftcore.settings import LiftSettings
from service import request_id, wire
from service.content import TAGGED, tagged, unchanged
from service.errors import InvalidRequest
from service.parts import Here
from service.routes.jobs import REPEATED, Key, take
from service.routes.queries import PNG
from service.store.jobs import JobOrder, fingerprint
from service.store.tradeoffs import TradeoffRecord

MARKDOWN_TYPE = "text/markdown; charset=utf-8"
MARKDOWN: dict[int | str, dict[str, Any]] = {200: {"content": {MARKDOWN_TYPE: {"schema": {"type": "string"}}}}}

router = APIRouter(tags=["trade-offs"])


@router.post("/tradeoff", response_model=wire.Job, status_code=202, responses=REPEATED)
def submit(order: wire.TradeoffRequest, here: Here, key: Key = None) -> Response:
    """Compare the dial and the presets on a scene within a budget. The job is on the disk before this answers."""
    for name in wire.COMPARED:
        if name in order.settings:
            raise InvalidSettings(name, expected="settings that are the same in all runs", got="one that is compared")
    LiftSettings.of_json(order.settings)
    if order.budget_s > here.settings.tradeoff_seconds:
        most = f"at most {here.settings.tradeoff_seconds:g} s, as the operator allows"
        raise InvalidRequest("budget_s", expected=most, got=f"{order.budget_s:g}")
    sent = order.model_dump(mode="json", exclude_none=True)  # an order without labels reads as before there were any
    wanted = JobOrder(
        splats=order.splats,
        cameras=order.cameras,
        features=tuple(order.features),
        settings=order.settings,
        key=key,
        fingerprint=None if key is None else fingerprint(sent),  # with a budget: of no lift
        request_id=request_id.current(),
        kind=wire.JobKind.TRADEOFF,
        parameters={name: sent[name] for name in ("budget_s", "labels") if name in sent},
    )
    return take(wanted, here)


@router.get("/tradeoffs/{tradeoff}", response_model=wire.Tradeoff)
def get_tradeoff(tradeoff: str, here: Here) -> wire.Tradeoff:
    """What was found: the runs, and which to take."""
    return shape(here.store.tradeoffs.get(tradeoff))


@router.get("/tradeoffs/{tradeoff}/chart", response_class=Response, responses=PNG | TAGGED)
def get_chart(tradeoff: str, request: Request, here: Here) -> Response:
    """Accuracy over time, and how near the dial stays to the exact lift, as a picture."""
    found = here.store.tradeoffs.get(tradeoff)
    etag = f'"{found.sha256}"'
    return unchanged(request, etag) or tagged(found.chart, "image/png", etag)


@router.get("/tradeoffs/{tradeoff}/table", response_class=Response, responses=MARKDOWN)
def get_table(tradeoff: str, here: Here) -> Response:
    """The runs as a table, with what it says and how it was made."""
    return Response(here.store.tradeoffs.get(tradeoff).page, headers={"Content-Type": MARKDOWN_TYPE})


def shape(tradeoff: TradeoffRecord) -> wire.Tradeoff:
    """A trade-off as the wire has it."""
    own = f"/tradeoffs/{tradeoff.id}"
    ours = {
        "id": tradeoff.id,
        "splats": tradeoff.splats,
        "cameras": tradeoff.cameras,
        "features": list(tradeoff.features),
        "labels": tradeoff.labels,
        "created": tradeoff.created,
        "links": {"self": own, "job": f"/jobs/{tradeoff.id}", "chart": f"{own}/chart", "table": f"{own}/table"},
    }
    return wire.Tradeoff.model_validate(tradeoff.document | ours)
