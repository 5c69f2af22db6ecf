"""Routes about the service itself (/healthz, /readyz, /version, /metrics), of the page and the API's documents."""

from __future__ import annotations

import base64
import hashlib
import re
import threading
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import anyio
import zstandard
from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.responses import HTMLResponse, JSONResponse

from service import models
from service.auth import with_keys
from service.content import BINARY
from service.state import CHECKS, Deps

EXAMPLE = Path(__file__).parents[1] / "commands" / "tabletop"
WEB = Path(__file__).parents[1] / "web" / "built"  # built by `make web`
SWAGGER = Path(str(files("fastapi_offline"))) / "static"  # shipped with the package: the machine may be offline
NO_PICTURE = "data:,"  # else the page loads one from another host
METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"
METRICS: dict[int | str, dict[str, Any]] = {
    200: {"description": "The Prometheus text format", "content": {METRICS_TYPE: {"schema": {"type": "string"}}}}
}


def _policy(scripts: str, styles: str, **sources: str) -> dict[str, str]:
    """Return the Content-Security-Policy of a page with these scripts, and no others."""
    rules = {
        "default-src": "'none'",
        "script-src": scripts,
        "style-src": styles,
        "img-src": "'self' blob: data:",
        "connect-src": "'self'",
        "form-action": "'none'",
        "base-uri": "'none'",
        "frame-ancestors": "'none'",
    } | {name.replace("_", "-"): value for name, value in sources.items()}
    return {"Content-Security-Policy": "; ".join(f"{name} {value}" for name, value in rules.items())}


# The page calls this service, and sorts and unpacks splats in WebAssembly, in workers.
PAGE_HEADERS = _policy("'self' 'wasm-unsafe-eval'", "'self'", worker_src="blob:", font_src="data:")
PAGE_HEADERS |= {"Cache-Control": "no-cache"}
IMMUTABLE = {"Cache-Control": "public, max-age=31536000, immutable"}  # their addresses contain their digest

router = APIRouter(tags=["operations"])


# Async, so that they need no thread: a sync route would queue behind every slow one.
@router.get("/healthz", response_model=models.Health)
async def healthz() -> models.Health:
    """Check that the HTTP process answers."""
    return models.Health(status="ok")


@router.get("/readyz", response_model=models.Ready)
async def readyz(deps: Deps) -> models.Ready:
    """Check that the service can work: its database is writable, the disk has space, and all parts live. Else 503,
    with the checks that failed; also while the service stops."""
    await deps.readiness.require()
    return models.Ready(status="ready", checks=list(CHECKS))


@router.get("/version", response_model=models.Version)
async def version(deps: Deps) -> models.Version:
    """Get the versions of the service and its packages."""
    return deps.version


@router.get("/metrics", response_class=Response, responses=METRICS)
async def metrics(deps: Deps) -> Response:
    """Get counters and gauges for Prometheus."""
    text = await anyio.to_thread.run_sync(deps.metrics.text, limiter=deps.scrapes)
    return Response(text, headers={"Content-Type": METRICS_TYPE})


@router.get("/", response_class=HTMLResponse, include_in_schema=False)
def page() -> HTMLResponse:
    """Get the page. It and its files need no key."""
    return HTMLResponse((WEB / "page.html").read_text(encoding="utf-8"), headers=PAGE_HEADERS)


def with_summaries(document: dict[str, Any]) -> dict[str, Any]:
    """Return an OpenAPI document in which the first sentence of each description is the summary."""
    for operations in document["paths"].values():
        for operation in operations.values():
            summary, *rest = re.split(r"\.\s+", operation["description"].rstrip("."), maxsplit=1)
            operation["summary"] = " ".join(summary.split())
            operation["description"] = f"{rest[0]}." if rest else f"{operation['summary']}."
    return document


class Documents:
    """OpenAPI documents with and without keys: made once, as that takes half a second."""

    def __init__(self, app: FastAPI) -> None:
        self._app = app
        self._turn = threading.Lock()
        self._bodies: tuple[bytes, ...] = ()

    def get(self, *, keys: bool) -> bytes:
        """Return one of the two as JSON."""
        with self._turn:
            if not self._bodies:
                document = with_summaries(self._app.openapi())
                self._bodies = tuple(bytes(JSONResponse(variant).body) for variant in (document, with_keys(document)))
        return self._bodies[keys]


@router.get("/openapi.json", include_in_schema=False)
def document(request: Request, deps: Deps) -> Response:
    """Get the OpenAPI document, with keys if the service needs them."""
    required = deps.store.keys.under(deps.settings.keys).required()
    return Response(request.app.state.documents.get(keys=required), media_type="application/json")


@router.get("/docs", response_class=HTMLResponse, include_in_schema=False)
def docs() -> HTMLResponse:
    """Get the API's documentation (Swagger UI). Its addresses are relative: it works behind a proxy's prefix."""
    page = get_swagger_ui_html(
        openapi_url="openapi.json",
        title="splatlift: routes",
        swagger_js_url="docs/swagger-ui-bundle.js",
        swagger_css_url="docs/swagger-ui.css",
        swagger_favicon_url=NO_PICTURE,
    )
    html = bytes(page.body).decode()
    inline = re.findall("<script>(.*?)</script>", html, re.DOTALL)
    digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in inline)
    scripts = " ".join(("'self'", *(f"'sha256-{digest}'" for digest in digests)))
    policy = _policy(scripts, "'self' 'unsafe-inline'", form_action="'self'")  # Swagger UI sets styles while it runs
    return HTMLResponse(html, headers=policy)


def _serve(
    path: str, content_of: Callable[[], bytes], media_type: str, headers: dict[str, str] | None = None
) -> None:
    """Register a file of the page, which is read at each request."""

    @router.get(path, include_in_schema=False)
    def content() -> Response:
        return Response(content_of(), media_type=media_type, headers=headers)


def _read_example(name: str) -> bytes:
    """Read a file of the example, with which the page orders a lift."""
    if (EXAMPLE / name).exists():
        return (EXAMPLE / name).read_bytes()
    return zstandard.ZstdDecompressor().decompress((EXAMPLE / f"{name}.zst").read_bytes())


for name in ("point_cloud.spz", "cameras.json", "features.safetensors"):
    _serve(f"/web/example/{name}", partial(_read_example, name), BINARY)
_serve("/web/page.js", (WEB / "page.js").read_bytes, "text/javascript", IMMUTABLE)
_serve("/web/page.css", (WEB / "page.css").read_bytes, "text/css", IMMUTABLE)
_serve("/web/LICENSES.txt", (WEB / "LICENSES.txt").read_bytes, "text/plain; charset=utf-8")
_serve("/docs/swagger-ui-bundle.js", (SWAGGER / "swagger-ui-bundle.js").read_bytes, "text/javascript")
_serve("/docs/swagger-ui.css", (SWAGGER / "swagger-ui.css").read_bytes, "text/css")
