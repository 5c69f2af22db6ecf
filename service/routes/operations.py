"""How the service is: /healthz, /readyz, /version, /metrics; and what people and programs read of it: the page, the
routes described, and their description."""

from __future__ import annotations

import base64
import hashlib
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import anyio
from fastapi import APIRouter, Request, Response
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.responses import HTMLResponse, JSONResponse

from service import models
from service.auth import with_keys
from service.requests import with_bodies
from service.state import CHECKS, Deps

WEB = Path(__file__).parents[1] / "web"
SWAGGER = Path(str(files("fastapi_offline"))) / "static"  # shipped, as a robot's network may lead nowhere
NO_PICTURE = "data:,"  # the page asks another host for one unless it is told
METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"
METRICS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The Prometheus text format",
        "content": {METRICS_TYPE: {"schema": {"type": "string"}}},
    }
}

router = APIRouter(tags=["operations"])


# These are async, and wait for no thread of the common pool: a sync route would queue behind every slow one.
@router.get("/healthz", response_model=models.Health)
async def healthz() -> models.Health:
    """Whether the HTTP process answers."""
    return models.Health(status="ok")


@router.get("/readyz", response_model=models.Ready)
async def readyz(deps: Deps) -> models.Ready:
    """Whether the service can work: writes to its database, has disk to work with, and all its parts live. Else 503,
    with the checks that failed; also while the service stops."""
    await deps.readiness.require()
    return models.Ready(status="ready", checks=list(CHECKS))


@router.get("/version", response_model=models.Version)
async def version(deps: Deps) -> models.Version:
    """What runs here."""
    return deps.version


@router.get("/metrics", response_class=Response, responses=METRICS)
async def metrics(deps: Deps) -> Response:
    """Counters and gauges for Prometheus."""
    text = await anyio.to_thread.run_sync(deps.metrics.text, limiter=deps.scrapes)
    return Response(text, headers={"Content-Type": METRICS_TYPE})


@router.get("/", response_class=HTMLResponse, include_in_schema=False)
def page() -> HTMLResponse:
    """The page, in one piece: it needs no other route, so no key, before it can ask for one."""
    names = ("index.html", "page.css", "page.js")
    whole, style, script = ((WEB / name).read_text(encoding="utf-8") for name in names)
    return _guarded(whole.replace("/* page.css */\n", style).replace("/* page.js */\n", script))


@router.get("/openapi.json", include_in_schema=False)
def document(request: Request, deps: Deps) -> JSONResponse:
    """The routes as OpenAPI has them, as things are now: with keys or without."""
    found = with_bodies(request.app.openapi(), models.LiftRequest, models.TradeoffRequest, models.AskedInBody)
    required = deps.store.keys.under(deps.settings.keys).required()
    return JSONResponse(with_keys(found) if required else found)


@router.get("/docs", response_class=HTMLResponse, include_in_schema=False)
def docs() -> HTMLResponse:
    """The routes described for people: Swagger UI. Its addresses are relative: it works behind a proxy's prefix."""
    page = get_swagger_ui_html(
        openapi_url="openapi.json",
        title="splatlift: routes",
        swagger_js_url="docs/swagger-ui-bundle.js",
        swagger_css_url="docs/swagger-ui.css",
        swagger_favicon_url=NO_PICTURE,
    )
    return _guarded(bytes(page.body).decode(), styles="'self' 'unsafe-inline'")  # it styles as it goes


@router.get("/docs/swagger-ui-bundle.js", include_in_schema=False)
def script() -> Response:
    """What draws that page."""
    return Response((SWAGGER / "swagger-ui-bundle.js").read_bytes(), media_type="text/javascript")


@router.get("/docs/swagger-ui.css", include_in_schema=False)
def style() -> Response:
    """How it looks."""
    return Response((SWAGGER / "swagger-ui.css").read_bytes(), media_type="text/css")


def _guarded(page: str, styles: str = "") -> HTMLResponse:
    """A page that runs its own scripts and no others, whatever comes to be in it."""
    policy = {
        "default-src": "'none'",
        "script-src": f"'self' {_digests(page, 'script')}",
        "style-src": styles or _digests(page, "style"),
        "img-src": "'self' blob: data:",
        "connect-src": "'self'",
        "form-action": "'self'",
        "base-uri": "'none'",
        "frame-ancestors": "'none'",
    }
    headers = {"Content-Security-Policy": "; ".join(f"{name} {value}" for name, value in policy.items())}
    return HTMLResponse(page, headers=headers)


def _digests(page: str, tag: str) -> str:
    inline = re.findall(f"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
    made = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in inline)
    return " ".join(f"'sha256-{digest}'" for digest in made)
