"""Wire the parts, the middleware and the routes together, with the log and the metrics. No application is global."""

from __future__ import annotations

import json
import logging
import re
import secrets
import sys
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Any

import anyio
from fastapi import FastAPI
from h11 import LocalProtocolError
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import GZipMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from liftcore import __version__
from service import errors
from service.auth import Auth, with_keys
from service.errors import METHODS, PROBLEM, REQUEST_ID, answer_to
from service.models import BITS_BYTES, BODY_BYTES
from service.process import Children
from service.query_client import QueryClient
from service.routes import Parts, assets, jobs, lifts, operations, queries, selections
from service.runner import Runner
from service.settings import ServiceSettings
from service.store import Store

SANE_ID = re.compile(rb"[A-Za-z0-9._~+/=:@-]{1,128}")  # no space, quote or control character: safe in any log
SECRET = re.compile(r"(?i)\b(bearer|basic)\s+[^\s\"',;]+")
# For browsers: no sniffing of media types, no frames, nothing loaded. HTML pages set a policy of their own.
SAFE_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",  # other sites must not embed renders and photos
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
}
REFUSAL_SECONDS = 10  # that a client may take to leave after its request was refused
COMPRESSED = re.compile(r"/|/web/.*")

access = logging.getLogger("service.access")


def create_app(settings: ServiceSettings, store: Store) -> FastAPI:
    """Return the application. It starts and stops its processes, not the store."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        children = Children(settings.job_threads)
        queries = QueryClient(settings.encoder, settings.query_seconds)
        runner = Runner(store, children, settings)
        limiter = anyio.CapacityLimiter
        app.state.parts = parts = Parts(
            settings, store, children, runner, queries, checks=limiter(4), writing=limiter(8)
        )
        add_gauges(app.state.registry, parts)
        runner.start()
        try:
            yield
        finally:
            for part in (runner, queries):
                await anyio.to_thread.run_sync(part.stop)

    app = Application(
        title="splatlift",
        version=__version__,
        description="Lift 2D features onto trained splat scenes and query them in words.",
        lifespan=lifespan,
        responses=dict.fromkeys(("4XX", "5XX"), PROBLEM),
        openapi_url=None,  # `service.routes.operations` serves it
        redirect_slashes=False,
        generate_unique_id_function=lambda route: route.name,  # clients name their functions by it
    )
    app.state.registry = CollectorRegistry()
    app.add_middleware(Compression)
    app.add_middleware(Auth, store=store, settings=settings)
    app.add_middleware(Recorder, registry=app.state.registry)  # the last one is outside of the others
    errors.install(app)
    app.include_router(selections.router, max_body_size=BITS_BYTES)
    for module in (operations, assets, jobs, lifts, queries):
        app.include_router(module.router, max_body_size=BODY_BYTES)
    return app


class Application(FastAPI):
    """The application, whose OpenAPI document names the problem of errors."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._documents, self._turn = dict[bool, bytes](), threading.Lock()

    def document(self, *, asks_for_keys: bool) -> bytes:
        """Return the document as JSON. It is made once, as that takes a second of computation."""
        with self._turn:
            if asks_for_keys not in self._documents:
                document = with_keys(self.openapi()) if asks_for_keys else self.openapi()
                self._documents[asks_for_keys] = json.dumps(document).encode()
        return self._documents[asks_for_keys]

    def openapi(self) -> dict[str, Any]:
        """Return the document; the first sentence of each description is the summary."""
        if self.openapi_schema is None:
            document = super().openapi()
            schema = errors.Problem.model_json_schema(ref_template="#/components/schemas/{model}")
            document["components"]["schemas"]["Problem"] = schema
            for operations_of_path in document["paths"].values():
                for operation in operations_of_path.values():
                    operation["summary"] = re.split(r"\.\s", operation["description"])[0].rstrip(".")
            self.openapi_schema = document
        return self.openapi_schema


class Compression:
    """ASGI middleware: compress the page; pictures and arrays gain little by it."""

    def __init__(self, app: ASGIApp) -> None:
        self._app, self._compressing = app, GZipMiddleware(app, compresslevel=1)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on; a range of an answer stays as it is."""
        is_whole = scope["type"] == "http" and "range" not in Headers(scope=scope)
        is_compressed = is_whole and COMPRESSED.fullmatch(scope["path"])
        await (self._compressing if is_compressed else self._app)(scope, receive, send)


class Recorder:
    """ASGI middleware: request ids and `SAFE_HEADERS` of answers, the log, the counters, and unforeseen errors."""

    def __init__(self, app: ASGIApp, registry: CollectorRegistry) -> None:
        self._app = app
        labels = ("method", "route", "status")
        self._requests = Counter("splatlift_http_requests", "Requests.", labels, registry=registry)
        self._seconds = Histogram("splatlift_http_seconds", "Duration.", ("method", "route"), registry=registry)
        ProcessCollector(registry=registry)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and record it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, status, sent_bytes, is_replaced = time.monotonic(), 0, 0, False
        scope["headers"] = [  # an unknown unit means the whole (RFC 9110), and starlette refuses it
            (name, value)
            for name, value in scope["headers"]
            if name != b"range" or value.lower().startswith(b"bytes=")
        ]
        request_id = request_id_of(scope)

        async def send_marked(message: Message) -> None:
            nonlocal status, sent_bytes
            if message["type"] == "http.response.start":
                status = message["status"]
                message = {**message, "headers": list(message.get("headers", ()))}
                headers = MutableHeaders(raw=message["headers"])
                for name, value in SAFE_HEADERS.items():
                    headers.setdefault(name, value)
                headers.append("X-Request-ID", request_id)
            await send(message)
            sent_bytes += len(message.get("body", b""))

        async def send_problem(message: Message) -> None:
            """Send a problem in place of a refusal of the framework in plain text."""
            nonlocal is_replaced
            if message["type"] == "http.response.start" and message["status"] >= HTTPStatus.BAD_REQUEST:
                headers = Headers(raw=message["headers"])
                if headers["content-type"].startswith("text/plain"):
                    is_replaced = True
                    range_header = {"Content-Range": headers["content-range"]} if "content-range" in headers else None
                    error = HTTPException(message["status"], headers=range_header)
                    await answer_to(error, scope["path"][:200])(scope, receive, send_marked)
            if not is_replaced:
                await send_marked(message)

        token = REQUEST_ID.set(request_id)
        try:
            try:
                await self._app(scope, receive, send_problem)
            except Exception as error:
                if status:  # the answer has begun: the connection is closed
                    raise
                await answer_to(error, scope["path"][:200])(scope, receive, send_marked)
        except LocalProtocolError:
            if sent_bytes:
                raise
            with anyio.move_on_after(REFUSAL_SECONDS):  # uvicorn has refused the rest of the request
                while (await receive())["type"] != "http.disconnect":
                    pass
        finally:
            self._record(scope, status, time.monotonic() - start, sent_bytes)
            REQUEST_ID.reset(token)

    def _record(self, scope: Scope, status: int, seconds: float, sent_bytes: int) -> None:
        """Count and log a request."""
        route, key = getattr(scope.get("route"), "path", "(no route)"), scope.get("state", {}).get("key")
        method = scope["method"] if scope["method"] in METHODS else "other"  # as labels
        self._requests.labels(method, route, status).inc()
        self._seconds.labels(method, route).observe(seconds)
        fields = {
            "method": scope["method"][:20], "route": route, "path": scope["path"][:200],  # never the query string
            "status": status, "seconds": round(seconds, 6), "sent": sent_bytes,
            "client": (scope.get("client") or (None,))[0], "key": key and key.id,
        }  # fmt: skip
        access.info("%s %s %d", method, route, status, extra={"fields": fields})


def request_id_of(scope: Scope) -> str:
    """Return the X-Request-ID of a request if it is safe in any log, else a new one."""
    values = [value for name, value in scope["headers"] if name == b"x-request-id"]
    is_sane = len(values) == 1 and SANE_ID.fullmatch(values[0])
    return values[0].decode("ascii") if is_sane else secrets.token_hex(16)


def add_gauges(registry: CollectorRegistry, parts: Parts) -> None:
    """Register the metrics that are read at each scrape."""

    def count_of(state: str) -> float:
        return parts.store.counts_by_state().get(state, 0)

    jobs_by_state = Gauge("splatlift_jobs", "Jobs by state.", ("state",), registry=registry)
    for state in ("queued", "running", "succeeded", "failed", "canceled"):
        jobs_by_state.labels(state).set_function(lambda state=state: count_of(state))
    for name, text, value in (
        ("splatlift_attempts", "Attempts at jobs that ended.", lambda: parts.runner.attempts),
        ("splatlift_queries", "Calls of the query process.", lambda: parts.queries.calls),
        ("splatlift_query_process_starts", "Starts of the query process.", lambda: parts.queries.starts),
        ("splatlift_disk_free_bytes", "Free disk below the data.", parts.store.free_bytes),
        ("splatlift_children", "Child processes that work.", parts.children.count),
    ):
        Gauge(name, text, registry=registry).set_function(value)


class JsonLines(logging.Formatter):
    """Format a record as JSON: ``time``, ``level``, ``logger``, ``message``, then the record's own fields."""

    def format(self, record: logging.LogRecord) -> str:
        """Return one line, without secrets, which traces may hold."""
        fields: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": SECRET.sub(r"\1 [hidden]", record.getMessage()),
            "request_id": REQUEST_ID.get(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info:
            fields["error"] = SECRET.sub(r"\1 [hidden]", self.formatException(record.exc_info))
        return json.dumps({name: value for name, value in fields.items() if value is not None}, default=str)


@contextmanager
def logging_to_stderr() -> Iterator[None]:
    """Send the records of this process to stderr as JSON lines while the block runs."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    logging.captureWarnings(True)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)
