"""How the service is: /healthz, /readyz, /version, /metrics; and the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
from fastapi import APIRouter, Response
from fastapi.responses import HTMLResponse

from service import wire
from service.parts import Here
from service.readiness import CHECKS
from service.versions import versions

WEB = Path(__file__).parents[1] / "web"
METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"
METRICS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The Prometheus text format",
        "content": {METRICS_TYPE: {"schema": {"type": "string"}}},
    }
}

router = APIRouter(tags=["operations"])


# All of them are async, and wait for no thread of the common pool: a sync route would queue behind every slow one.
@router.get("/healthz", response_model=wire.Health)
async def healthz() -> wire.Health:
    """Whether the HTTP process answers."""
    return wire.Health(status="ok")


@router.get("/readyz", response_model=wire.Ready)
async def readyz(here: Here) -> wire.Ready:
    """Whether the service can work: writes to its database, has disk to work with, and all its parts live. Else 503,
    with the checks that failed; also while the service stops."""
    await here.readiness.require()
    return wire.Ready(status="ready", checks=list(CHECKS))


@router.get("/version", response_model=wire.Version)
async def version(here: Here) -> wire.Version:
    """What runs here."""
    return versions(here.settings.commit)


@router.get("/metrics", response_class=Response, responses=METRICS)
async def metrics(here: Here) -> Response:
    """Counters and gauges for Prometheus."""
    text = await anyio.to_thread.run_sync(here.metrics.text, limiter=here.scrapes)
    return Response(text, headers={"Content-Type": METRICS_TYPE})


@router.get("/", response_class=HTMLResponse, include_in_schema=False)
def page() -> str:
    """The page, in one piece: it needs no other route, so no key, before it can ask for one."""
    names = ("index.html", "page.css", "page.js")
    whole, style, script = ((WEB / name).read_text(encoding="utf-8") for name in names)
    return whole.replace("/* page.css */\n", style).replace("/* page.js */\n", script)
