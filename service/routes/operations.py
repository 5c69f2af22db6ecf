"""Routes about the service itself (/healthz, /readyz, /metrics), of the page and the API's documents."""

from __future__ import annotations

import base64
import gzip
import hashlib
import mimetypes
import os
import re
from collections.abc import AsyncIterator, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

import zstandard
from fastapi import APIRouter, Request, Response
from fastapi import Path as PathParameter
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.responses import FileResponse, HTMLResponse, StreamingResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import generate_latest
from starlette.datastructures import Headers
from starlette.types import Scope

from liftcore.files import page_table
from liftcore.models import page_fields
from service.errors import Busy
from service.models import Status
from service.routes import BINARY, Deps
from service.store import admit

EXAMPLE = Path(__file__).parents[1] / "commands" / "tabletop"
WEB = Path(__file__).parents[1] / "web"
PAGE = WEB / "src" / "index.html"
SWAGGER = Path(str(files("fastapi_offline"))) / "static"  # shipped with the package: the machine may be offline
BLOCK_BYTES = 1 << 16
METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"
SWAGGER_FILES = {"swagger-ui-bundle.js": "text/javascript", "swagger-ui.css": "text/css"}
EXAMPLE_FILES = ("point_cloud.spz", "cameras.json", "features.safetensors")
IMMUTABLE = "public, max-age=31536000, immutable"  # addresses of libraries contain their version

router = APIRouter(tags=["operations"])


def policy(scripts: str, styles: str, rest: str) -> dict[str, str]:
    """Return the Content-Security-Policy of a page with these scripts, and no others."""
    text = (
        f"default-src 'none'; script-src {scripts}; style-src {styles}; img-src 'self' blob: data:;"
        f" connect-src 'self'; base-uri 'none'; frame-ancestors 'none'; {rest}"
    )
    return {"Content-Security-Policy": text, "Cache-Control": "no-cache"}


def own_scripts(html: str) -> str:
    """Return the sources of a page's scripts: this service, and the digest of each script in the page."""
    inline = re.findall(r"<script(?: type=\"importmap\")?>(.*?)</script>", html, re.DOTALL)
    digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in inline)
    return " ".join(("'self'", *(f"'sha256-{digest}'" for digest in digests)))


# The page calls this service, and sorts and unpacks splats in WebAssembly, in workers.
PAGE_HEADERS = policy(
    f"{own_scripts(PAGE.read_text())} 'wasm-unsafe-eval'", "'self'",
    "form-action 'none'; worker-src blob:; font-src 'self'",
)  # fmt: skip


class PageFiles(StaticFiles):
    """The files of the page; its libraries are stored compressed, as they were published."""

    def lookup_path(self, path: str) -> tuple[str, os.stat_result | None]:
        """Return a file, or the compressed one."""
        file = super().lookup_path(path)
        return file if file[1] else super().lookup_path(f"{path}.gz")

    def file_response(
        self, full_path: Any, stat_result: os.stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        """Return the answer with a file; browsers compare those that change with their own."""
        answer = super().file_response(full_path, stat_result, scope, status_code)
        encodings = Headers(scope=scope).get("accept-encoding", "gzip")
        if Path(full_path).suffix == ".gz" and "gzip" not in encodings:
            answer = StreamingResponse(decompress(full_path), media_type=mimetypes.guess_type(full_path)[0])
        elif Path(full_path).suffix == ".gz":
            answer.headers.update({"Content-Encoding": "gzip", "Vary": "Accept-Encoding"})  # as `Compression` adds
        is_library = WEB / "libraries" in Path(full_path).parents[1:]  # below a folder with a version
        answer.headers["Cache-Control"] = IMMUTABLE if is_library else "no-cache"
        return answer


def decompress(file: str) -> Iterator[bytes]:
    """Yield the blocks of a compressed file."""
    with gzip.open(file) as content:
        while block := content.read(BLOCK_BYTES):
            yield block


PAGE_FILES = PageFiles(directory=WEB)


@router.get("/healthz")
async def healthz() -> Status:
    """Check that the HTTP process answers."""
    return Status(status="ok")


@router.get("/readyz")
def readyz(deps: Deps) -> Status:
    """Check that the service can work: its database is writable, the disk has space, and all processes live."""
    deps.store.require_usable()
    for name, is_alive in (
        ("the runner of jobs", deps.runner.is_alive()),
        ("the query process", deps.queries.is_ready()),
        ("the process that checks uploads", deps.children.is_ready()),
    ):
        if not is_alive:
            raise Busy("server", expected="processes that live", got=f"{name} has ended; a new one starts")
    return Status(status="ready")


@router.get("/metrics", response_class=Response, responses={200: {"content": {METRICS_TYPE: {}}}})
def metrics(request: Request) -> Response:
    """Get counters and gauges for Prometheus."""
    return Response(generate_latest(request.app.state.registry), headers={"Content-Type": METRICS_TYPE})


@router.get("/", response_class=HTMLResponse, include_in_schema=False)
def page() -> FileResponse:
    """Get the page. It and its files need no key."""
    return FileResponse(PAGE, headers=PAGE_HEADERS, media_type="text/html")


@router.get("/web/kinds.json", include_in_schema=False)
def kinds() -> dict[str, Any]:
    """Get the suffixes of files that the page sends, and what others are."""
    return page_table()


@router.get("/web/question.json", include_in_schema=False)
def question_fields() -> dict[str, Any]:
    """Get the JSON schema of each field of a question."""
    return page_fields()


@router.get("/web/example/{name}", include_in_schema=False)
def example_file(name: Annotated[str, PathParameter(pattern="|".join(EXAMPLE_FILES))]) -> Response:
    """Get a file of the example, with which the page orders a lift."""
    if (EXAMPLE / name).exists():
        return FileResponse(EXAMPLE / name, media_type=BINARY)
    content = zstandard.ZstdDecompressor().decompress((EXAMPLE / f"{name}.zst").read_bytes())
    return Response(content, media_type=BINARY)


@router.get("/web/{path:path}", include_in_schema=False)
async def page_file(path: str, request: Request) -> Response:
    """Get a file of the page."""
    return await PAGE_FILES.get_response(path, request.scope)


@router.get("/openapi.json", include_in_schema=False)
def document(request: Request, deps: Deps) -> StreamingResponse:
    """Get the OpenAPI document, which asks for keys once there are any."""
    content = request.app.document(asks_for_keys=admit(deps.store, None)[0])

    async def blocks() -> AsyncIterator[bytes]:  # of which a slow client holds one
        for first in range(0, len(content), BLOCK_BYTES):
            yield content[first : first + BLOCK_BYTES]

    return StreamingResponse(blocks(), media_type="application/json")


@router.get("/docs", response_class=HTMLResponse, include_in_schema=False)
def docs() -> HTMLResponse:
    """Get the API's documentation (Swagger UI). Its addresses are relative: it works behind a proxy's prefix."""
    page = get_swagger_ui_html(
        openapi_url="openapi.json",
        title="splatlift: routes",
        swagger_js_url="docs/swagger-ui-bundle.js",
        swagger_css_url="docs/swagger-ui.css",
        swagger_favicon_url="data:,",  # else the page loads one from another host
    )
    html = bytes(page.body).decode()
    styles = "'self' 'unsafe-inline'"  # Swagger UI sets styles while it runs
    return HTMLResponse(html, headers=policy(own_scripts(html), styles, "form-action 'self'"))


@router.get("/docs/{name}", include_in_schema=False)
def docs_file(name: Annotated[str, PathParameter(pattern="|".join(SWAGGER_FILES))]) -> FileResponse:
    """Get a file of Swagger UI."""
    return FileResponse(SWAGGER / name, media_type=SWAGGER_FILES[name])
