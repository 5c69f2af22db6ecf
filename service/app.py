"""Wire the parts, the middleware and the routes together. There is no global application.

The middleware around the routes is below: it records each exchange and answers HEAD. Authorization is `service.auth`.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from http import HTTPStatus
from typing import Any

import anyio
from fastapi import FastAPI
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from liftcore import __version__
from liftcore.files import PhotoIndexes
from service import problems
from service.auth import ANONYMOUS, CALLER, AuthMiddleware
from service.content import EventStreams
from service.errors import ForeignOrigin, ServiceUnavailable
from service.observe import Metrics, access, chosen_id, versions, working_for
from service.problems import CLOSE, answer_to
from service.query_client import QueryClient, QueryLimits
from service.requests import KnownParameters
from service.routes import assets, jobs, lifts, operations, queries, selections
from service.sandbox import revive
from service.settings import ServiceSettings
from service.state import AppState, Readiness, Stopping
from service.store.store import Collector, Store
from service.supervisor import JobLimits, Supervisor

SLOTS = 4  # requests that run at the same time in their first SLOT_SECONDS
SLOT_SECONDS = 0.05  # then a request gives its slot to the next; many times what the event loop needs for one
PROBES = frozenset({"/healthz", "/readyz"})
PATH_CHARACTERS = 200  # of a path in the log
# Headers that pages of other sites may send and read, beside those that CORS always allows
CORS_HEADERS = ("Authorization", "Content-Type", "If-None-Match", "If-Range", "Range", "Last-Event-ID")
CORS_EXPOSED = ("ETag", "Content-Range", "Content-Disposition", "Retry-After", "WWW-Authenticate", "X-Request-ID")
# For browsers: no sniffing of media types, no frames, nothing loaded. HTML pages set a policy of their own.
SAFE_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",  # other sites must not embed renders and photos
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
}


def create_app(settings: ServiceSettings, store: Store, supervisor: Supervisor, query_client: QueryClient) -> FastAPI:
    """Return the application. It starts and stops the supervisor and the query process, not the store."""

    threads = anyio.CapacityLimiter
    streams, build = EventStreams(settings.max_streams, settings.key_streams), versions(settings.commit)
    stopping = Stopping(streams, supervisor, notice_seconds=settings.notice_seconds)
    metrics = Metrics(store, query_client, streams, build)
    readiness = Readiness(store, supervisor, query_client, stopping)
    supervisor.on_attempt_finished(metrics.attempted)
    query_client.on_call_finished(metrics.queried)
    collector = Collector(store, settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        app.state.deps = deps = AppState(
            settings=settings, version=build, store=store, caller=ANONYMOUS,
            supervisor=supervisor, query_client=query_client,
            streams=streams, photos=PhotoIndexes(), metrics=metrics, readiness=readiness,
            checks=threads(settings.parallel_checks),  # uploads validated at the same time
            planning=threads(1),  # plans, separate from uploads
            writing=threads(8),  # uploads: a stalled disk blocks them and no other route
            parsing=threads(2),  # JSON bodies
            ordering=threads(2),  # lift orders: each compares all names in its assets, which takes memory
            scrapes=threads(1),  # the metrics
        )  # fmt: skip
        await anyio.to_thread.run_sync(revive)  # starts the process from which upload checks are forked
        await anyio.to_thread.run_sync(query_client.start)
        await anyio.to_thread.run_sync(supervisor.start)
        collector.start()
        try:
            yield
        finally:
            deps.ending.set()
            streams.close()
            for part in (collector, supervisor, query_client):
                await anyio.to_thread.run_sync(part.stop)

    app = RecordedApp(
        title="splatlift",
        version=__version__,
        description="Lift 2D features onto trained splat scenes and query them in words.",
        lifespan=lifespan,
        responses=problems.RESPONSES,
        openapi_url=None,  # `service.routes.operations` serves it, with keys, and builds it in a thread
        redirect_slashes=False,
        generate_unique_id_function=lambda route: route.name,  # clients name their functions by it
    )
    app.state.cors_origins = settings.cors_origins
    app.state.stopping, app.state.metrics, app.state.documents = stopping, metrics, operations.Documents(app)
    app.add_middleware(AnswerHead)
    app.add_middleware(AuthMiddleware, keys=store.keys, settings=settings, stopping=lambda: stopping.has_begun)
    app.add_middleware(ConcurrencyLimit)
    problems.install(app)
    app.include_router(operations.router)  # probes and links to the page accept any parameter
    for module in (assets, jobs, lifts, queries, selections):
        app.include_router(module.router, dependencies=[KnownParameters])
    return app


def assemble(settings: ServiceSettings, store: Store) -> FastAPI:
    """Return the application with the default supervisor of jobs and query process."""
    return create_app(settings, store, Supervisor(store, job_limits(settings)), QueryClient(query_limits(settings)))


def query_limits(settings: ServiceSettings) -> QueryLimits:
    """Return the limits of queries that the settings give."""
    return QueryLimits(
        waiting=settings.query_waiting,
        seconds=settings.query_seconds,
        scenes=settings.query_scenes,
        cache_bytes=settings.query_cache_bytes,
        encoder=settings.encoder,
        of_a_key=settings.key_queries,
    )


def job_limits(settings: ServiceSettings) -> JobLimits:
    """Return the limits of jobs that the settings give."""
    cores = len(os.sched_getaffinity(0))  # the service runs on Linux only
    return JobLimits(
        parallel=settings.parallel_lifts,
        threads=settings.lift_threads or max(1, cores // settings.parallel_lifts),
        seconds=settings.lift_seconds,
        memory_bytes=settings.lift_memory_bytes,
        lease_seconds=settings.lease_seconds,
        checkpoint_seconds=settings.checkpoint_seconds,
        engine=settings.engine,
        ray_address=settings.ray_address,
    )


# Middleware around the routes


class RecordedApp(FastAPI):
    """Record requests outside all other middleware, so that answers to unexpected errors are recorded too.

    ``state.metrics`` and ``state.cors_origins`` (origins of other sites) must be set before the first request.
    """

    def build_middleware_stack(self) -> ASGIApp:
        """Return the default stack within the recorder; CORS applies to refusals too."""
        stack: ASGIApp = super().build_middleware_stack()
        if readers := self.state.cors_origins:
            stack = CrossOriginPages(
                stack, readers, ("GET", "HEAD", "POST"), CORS_HEADERS,
                allow_credentials=False, expose_headers=CORS_EXPOSED,
            )  # fmt: skip
        return Recorder(stack, self.state.metrics)


class CrossOriginPages(CORSMiddleware):
    """CORS for pages of other sites. A refused preflight is a problem document, as every error is."""

    def preflight_response(self, request_headers: Headers) -> Response:
        """Answer a CORS preflight."""
        reply = super().preflight_response(request_headers)
        if reply.status_code == HTTPStatus.OK:
            return reply
        headers = request_headers.get("Access-Control-Request-Headers")
        terms = {
            "Origin": (
                self.is_allowed_origin(request_headers["Origin"]),
                "this service's own page, or one of SPLATLIFT_CORS_ORIGINS",
            ),
            "Access-Control-Request-Method": (
                request_headers["Access-Control-Request-Method"] in self.allow_methods,
                f"one of {', '.join(self.allow_methods)}",
            ),
            "Access-Control-Request-Headers": (
                headers is None or {header.strip() for header in headers.lower().split(",")} <= {*self.allow_headers},
                f"some of {', '.join(CORS_HEADERS)}",
            ),
            "Access-Control-Request-Private-Network": (False, "none"),
        }
        name, expected = next((name, expected) for name, (fits, expected) in terms.items() if not fits)
        error = ForeignOrigin(name, expected=expected, got=request_headers.get(name, "none")[:200])
        return answer_to(error, {"Vary": "Origin"})


class Recorder:
    """Set the request id and `SAFE_HEADERS` on every answer; update the log and the counters."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and record it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, request_id = time.monotonic(), chosen_id(scope["headers"])
        status, received_bytes, sent_bytes, complete = 0, 0, 0, False

        async def receive_counted() -> Message:
            nonlocal received_bytes
            message = await receive()
            received_bytes += len(message.get("body", b""))
            return message

        async def send_marked(message: Message) -> None:
            nonlocal status, sent_bytes, complete
            if message["type"] == "http.response.start":
                status = message["status"]
                message = {**message, "headers": list(message.get("headers", ()))}
                headers = MutableHeaders(raw=message["headers"])
                for name, value in SAFE_HEADERS.items():
                    headers.setdefault(name, value)
                headers.append("X-Request-ID", request_id)
            await send(message)
            if message["type"] == "http.response.body":
                sent_bytes += len(message.get("body", b""))
                complete = not message.get("more_body", False)

        with working_for(request_id):
            try:
                await self._app(scope, receive_counted, send_marked)
            except asyncio.CancelledError:  # the server cancels open requests when its stop timeout ends
                if status:
                    raise
                error = ServiceUnavailable(
                    "server", expected="a running server", got="one that stops", hint="send it again"
                )
                await answer_to(error, CLOSE)(scope, receive_counted, send_marked)
            except Exception:
                # If complete, `service.problems` has answered and logged it, and the framework raises it again.
                if not complete:
                    raise
            finally:
                seconds, route = time.monotonic() - start, getattr(scope.get("route"), "path", None)
                self._metrics.count_request(
                    scope["method"], route, status, seconds=seconds, received_bytes=received_bytes
                )
                fields = {
                    "method": scope["method"],
                    "route": route,
                    "path": scope["path"][:PATH_CHARACTERS],  # never the query string: it may hold secrets
                    "status": status,
                    "seconds": round(seconds, 6),
                    "received": received_bytes,
                    "sent": sent_bytes,
                    "client": (scope.get("client") or (None,))[0],
                    **_describe_caller(scope),
                    **({} if complete else {"broken_off": True}),
                }
                access.info("%s %s %d", scope["method"], route or "(no route)", status, extra={"fields": fields})


def _describe_caller(scope: Scope) -> dict[str, Any]:
    """Return the log fields of the caller: its key's id, and whether it is an admin."""
    caller = scope.get("state", {}).get(CALLER)
    if caller is None or caller.key is None:
        return {}
    return {"key": caller.key} | ({"admin": True} if caller.owner.sees_all else {})


class ConcurrencyLimit:
    """Limit the requests that begin at the same time, so that the event loop stays responsive.

    Probes bypass the limit. A request that takes longer than `SLOT_SECONDS` waits for a query, a disk or its client:
    it gives its slot to the next one.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._slots = anyio.Semaphore(SLOTS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on when a slot is free."""
        if scope["type"] != "http" or scope["path"] in PROBES:
            await self._app(scope, receive, send)
            return
        await self._slots.acquire()
        is_holding = True

        def give_up() -> None:
            nonlocal is_holding
            if is_holding:
                is_holding = False
                self._slots.release()

        timer = asyncio.get_running_loop().call_later(SLOT_SECONDS, give_up)
        try:
            await self._app(scope, receive, send)
        finally:
            timer.cancel()
            give_up()


class AnswerHead:
    """Answer HEAD: run the route for GET, send the head of its answer, and cancel the rest.

    What would be read or waited for to make the body is cancelled: a file stays unread, and a stream of events ends.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; HEAD as GET."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        headers = [(name, value) for name, value in scope["headers"] if name != b"range"]  # Range is for GET
        get_scope = {**scope, "method": "GET", "headers": headers}
        with anyio.CancelScope() as rest:

            async def send_head(message: Message) -> None:
                if message["type"] == "http.response.start":
                    await send(message)
                    await send({"type": "http.response.body", "body": b"", "more_body": False})
                    rest.cancel()

            try:
                await self._app(get_scope, receive, send_head)
            finally:
                if "route" in get_scope:
                    scope["route"] = get_scope["route"]  # for the recorder
