"""/tradeoff and /tradeoffs: speed against accuracy on a scene, measured."""

from __future__ import annotations

from typing import Any

import anyio
from fastapi import APIRouter, Request, Response

from liftcore.errors import InvalidSettings
from liftcore.settings import LiftSettings
from service import models
from service.content import TAGGED, tagged, unchanged
from service.errors import InvalidRequest
from service.observe import current_id
from service.requests import described_body, json_body
from service.routes.jobs import REPEATED, Key, take
from service.routes.queries import PNG
from service.state import AppState, Deps
from service.store.jobs import JobOrder, fingerprint
from service.store.lifts import TradeoffRecord

MARKDOWN_TYPE = "text/markdown; charset=utf-8"
MARKDOWN: dict[int | str, dict[str, Any]] = {200: {"content": {MARKDOWN_TYPE: {"schema": {"type": "string"}}}}}

router = APIRouter(tags=["trade-offs"])


TRADEOFF_BODY = json_body(models.TradeoffRequest)


@router.post(
    "/tradeoff", response_model=models.Job, status_code=202, responses=REPEATED,
    openapi_extra=described_body(models.TradeoffRequest),
)  # fmt: skip
async def submit(deps: Deps, order: models.TradeoffRequest = TRADEOFF_BODY, key: Key = None) -> Response:
    """Compare the dial and the presets on a scene within a budget. The job is on the disk before this answers."""
    return await anyio.to_thread.run_sync(_submit, order, deps, key, limiter=deps.ordering)


def _submit(order: models.TradeoffRequest, deps: AppState, key: str | None) -> Response:
    for name in models.COMPARED:
        if name in order.settings:
            raise InvalidSettings(name, expected="settings that are the same in all runs", got="one that is compared")
    LiftSettings.of_json(order.settings)
    if order.budget_s > deps.settings.tradeoff_seconds:
        most = f"at most {deps.settings.tradeoff_seconds:g} s, as the operator allows"
        raise InvalidRequest("budget_s", expected=most, got=f"{order.budget_s:g}")
    sent = order.model_dump(mode="json", exclude_none=True)  # an order without labels reads as before there were any
    wanted = JobOrder(
        splats=order.splats,
        cameras=order.cameras,
        features=tuple(order.features),
        settings=order.settings,
        key=key,
        fingerprint=None if key is None else fingerprint(sent),  # with a budget: of no lift
        request_id=current_id(),
        kind=models.JobKind.TRADEOFF,
        parameters={name: sent[name] for name in ("budget_s", "labels") if name in sent},
    )
    return take(wanted, deps)


@router.get("/tradeoffs/{tradeoff}", response_model=models.Tradeoff)
def get_tradeoff(tradeoff: str, deps: Deps) -> models.Tradeoff:
    """What was found: the runs, and which to take."""
    return shape(deps.store.tradeoffs.get(deps.owner, tradeoff))


@router.get("/tradeoffs/{tradeoff}/chart", response_class=Response, responses=PNG | TAGGED)
def get_chart(tradeoff: str, request: Request, deps: Deps) -> Response:
    """Accuracy over time, and how near the dial stays to the exact lift, as a picture."""
    found = deps.store.tradeoffs.get(deps.owner, tradeoff)
    etag = f'"{found.sha256}"'
    return unchanged(request, etag) or tagged(found.chart, "image/png", etag)


@router.get("/tradeoffs/{tradeoff}/table", response_class=Response, responses=MARKDOWN)
def get_table(tradeoff: str, deps: Deps) -> Response:
    """The runs as a table, with what it says and how it was made."""
    return Response(deps.store.tradeoffs.get(deps.owner, tradeoff).page, headers={"Content-Type": MARKDOWN_TYPE})


def shape(tradeoff: TradeoffRecord) -> models.Tradeoff:
    """A trade-off as clients get it."""
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
    return models.Tradeoff.model_validate(tradeoff.document | ours)
