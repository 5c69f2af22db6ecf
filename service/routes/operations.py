"""How the service is: /healthz, /readyz, /version, /metrics; and what people and programs read of it: the page, the
routes described, and their description."""

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
WEB = Path(__file__).parents[1] / "web" / "built"  # by `make web`
SWAGGER = Path(str(files("fastapi_offline"))) / "static"  # shipped, as a robot's network may lead nowhere
NO_PICTURE = "data:,"  # the page asks another host for one unless it is told
METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"
METRICS: dict[int | str, dict[str, Any]] = {
    200: {"description": "The Prometheus text format", "content": {METRICS_TYPE: {"schema": {"type": "string"}}}}
}


def _policy(scripts: str, styles: str, **sources: str) -> dict[str, str]:
    """The header of a page that runs these scripts and no others, whatever comes to be in it."""
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


# The page asks this service, and sorts and unpacks splats, which is done by WebAssembly in workers.
PAGE_HEADERS = _policy("'self' 'wasm-unsafe-eval'", "'self'", worker_src="blob:", font_src="data:")
PAGE_HEADERS |= {"Cache-Control": "no-cache"}
IMMUTABLE = {"Cache-Control": "public, max-age=31536000, immutable"}  # the page asks for them by their digest

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
    """The page. It and its files need no key, before it can ask for one."""
    return HTMLResponse((WEB / "page.html").read_text(encoding="utf-8"), headers=PAGE_HEADERS)


def with_summaries(document: dict[str, Any]) -> dict[str, Any]:
    """An OpenAPI document whose operations have the first sentence of their description as their summary."""
    for operations in document["paths"].values():
        for operation in operations.values():
            summary, *rest = re.split(r"\.\s+", operation["description"].rstrip("."), maxsplit=1)
            operation["summary"] = " ".join(summary.split())
            operation["description"] = f"{rest[0]}." if rest else f"{operation['summary']}."
    return document


class Documents:
    """The routes as OpenAPI has them, without keys and with them: made once, as that takes half a second."""

    def __init__(self, app: FastAPI) -> None:
        self._app = app
        self._turn = threading.Lock()
        self._bodies: tuple[bytes, ...] = ()

    def get(self, *, keys: bool) -> bytes:
        """The one of the two, as JSON."""
        with self._turn:
            if not self._bodies:
                document = with_summaries(self._app.openapi())
                self._bodies = tuple(bytes(JSONResponse(variant).body) for variant in (document, with_keys(document)))
        return self._bodies[keys]


@router.get("/openapi.json", include_in_schema=False)
def document(request: Request, deps: Deps) -> Response:
    """The routes as OpenAPI has them, as things are now: with keys or without."""
    required = deps.store.keys.under(deps.settings.keys).required()
    return Response(request.app.state.documents.get(keys=required), media_type="application/json")


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
    html = bytes(page.body).decode()
    inline = re.findall("<script>(.*?)</script>", html, re.DOTALL)
    digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in inline)
    scripts = " ".join(("'self'", *(f"'sha256-{digest}'" for digest in digests)))
    policy = _policy(scripts, "'self' 'unsafe-inline'", form_action="'self'")  # it styles as it goes
    return HTMLResponse(html, headers=policy)


def _serve(
    path: str, content_of: Callable[[], bytes], media_type: str, headers: dict[str, str] | None = None
) -> None:
    """Register a file that a page asks for, which is read at each request."""

    @router.get(path, include_in_schema=False)
    def content() -> Response:
        return Response(content_of(), media_type=media_type, headers=headers)


def _read_example(name: str) -> bytes:
    """Read a file of the scene that ships, of which the page orders a lift, as of files that were brought."""
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
