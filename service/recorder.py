"""The outermost layer: gives each request its id, and tells the log and the counters how it went."""

from __future__ import annotations

import logging
import time

from fastapi import FastAPI
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import request_id
from service.keys.gate import CALLER, Caller
from service.metrics import Metrics, Served

PATH_CHARACTERS = 200  # of a path in the log

log = logging.getLogger("service.access")


class RecordedApp(FastAPI):
    """Records its requests outside of all else, so that answers to unforeseen errors are recorded too.

    ``state.metrics`` must be there before the first request.
    """

    def build_middleware_stack(self) -> ASGIApp:
        """The usual layers within the recorder."""
        return Recorder(super().build_middleware_stack(), self.state.metrics)


class Recorder:
    """ASGI middleware: the id of the request in every answer, a line in the access log, and the counters."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and watch."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        chosen = request_id.chosen(scope["headers"])
        exchange = _Exchange(chosen, receive, send)
        with request_id.working_for(chosen):
            try:
                await self._app(scope, exchange.receive, exchange.send)
            except Exception:
                # The framework raises again what `service.problems` has answered and logged.
                if not exchange.complete:
                    raise
            finally:
                self._note(scope, exchange)

    def _note(self, scope: Scope, exchange: _Exchange) -> None:
        route = getattr(scope.get("route"), "path", None)
        seconds = time.monotonic() - exchange.begun
        self._metrics.served(Served(scope["method"], route, exchange.status, seconds, exchange.received))
        fields = {
            "method": scope["method"],
            "route": route,
            "path": scope["path"][:PATH_CHARACTERS],  # never the query: people put secrets there
            "status": exchange.status,
            "seconds": round(seconds, 6),
            "received": exchange.received,
            "sent": exchange.sent,
        }
        caller: Caller | None = scope.get("state", {}).get(CALLER)
        if caller is not None and caller.key is not None:
            fields["key"] = caller.key
        if not exchange.complete:
            fields["broken_off"] = True
        log.info("%s %s %d", scope["method"], route or "(no route)", exchange.status, extra={"fields": fields})


class _Exchange:
    """A request and its answer, counted as they pass."""

    def __init__(self, request: str, receive: Receive, send: Send) -> None:
        self._id = request.encode("ascii")
        self._receive = receive
        self._send = send
        self.begun = time.monotonic()
        self.status = 0
        self.received = 0
        self.sent = 0
        self.complete = False

    async def receive(self) -> Message:
        message = await self._receive()
        self.received += len(message.get("body", b""))
        return message

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
            message = {**message, "headers": [*message.get("headers", ()), (request_id.HEADER, self._id)]}
        await self._send(message)
        if message["type"] == "http.response.body":
            self.sent += len(message.get("body", b""))
            self.complete = not message.get("more_body", False)
