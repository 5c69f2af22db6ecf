"""ASGI layers around the routes: every exchange is recorded, HEAD is GET's head. The gate is in `service.auth`."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import anyio
from fastapi import FastAPI
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.auth import CALLER
from service.errors import Busy
from service.observe import Metrics, access, chosen_id, working_for
from service.problems import CLOSE, answer_to

PLACES = 4  # of requests that are begun at the same time
TURN_SECONDS = 0.05  # many times what the event loop needs for a request
PROBES = frozenset({"/healthz", "/readyz"})
PATH_CHARACTERS = 200  # of a path in the log
# For browsers: nothing here is guessed at, framed or allowed to load anything; pages bring a policy of their own.
SAFE_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",  # renders and photos are no other site's to show
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
}


class RecordedApp(FastAPI):
    """Records its requests outside of all else, so that answers to unforeseen errors are recorded too.

    ``state.metrics`` must be there before the first request.
    """

    def build_middleware_stack(self) -> ASGIApp:
        """The usual layers within the recorder."""
        return Recorder(super().build_middleware_stack(), self.state.metrics)


class Recorder:
    """Every answer gets its request's id and `SAFE_HEADERS`; log and counters hear of it."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and watch."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun, made = time.monotonic(), chosen_id(scope["headers"])
        status, received, sent, complete = 0, 0, 0, False

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            return message

        async def marked(message: Message) -> None:
            nonlocal status, sent, complete
            if message["type"] == "http.response.start":
                status = message["status"]
                message = {**message, "headers": list(message.get("headers", ()))}
                headers = MutableHeaders(raw=message["headers"])
                for name, value in SAFE_HEADERS.items():
                    headers.setdefault(name, value)
                headers.append("X-Request-ID", made)
            await send(message)
            if message["type"] == "http.response.body":
                sent += len(message.get("body", b""))
                complete = not message.get("more_body", False)

        with working_for(made):
            try:
                await self._app(scope, counted, marked)
            except asyncio.CancelledError:  # by the server, whose stop has no more time for it
                if status:
                    raise
                why = Busy("server", expected="a running server", got="one that stops", hint="send it again")
                await answer_to(why, CLOSE)(scope, counted, marked)
            except Exception:
                if (
                    not complete
                ):  # else `service.problems` has answered and logged it, and the framework raises it again
                    raise
            finally:
                seconds, route = time.monotonic() - begun, getattr(scope.get("route"), "path", None)
                self._metrics.served(scope["method"], route, status, seconds=seconds, received=received)
                fields = {
                    "method": scope["method"],
                    "route": route,
                    "path": scope["path"][:PATH_CHARACTERS],  # never the query: people put secrets there
                    "status": status,
                    "seconds": round(seconds, 6),
                    "received": received,
                    "sent": sent,
                    "client": (scope.get("client") or (None,))[0],
                    **_who(scope),
                    **({} if complete else {"broken_off": True}),
                }
                access.info("%s %s %d", scope["method"], route or "(no route)", status, extra={"fields": fields})


def _who(scope: Scope) -> dict[str, Any]:
    """The key that asked, and whether as an admin."""
    caller = scope.get("state", {}).get(CALLER)
    if caller is None or caller.key is None:
        return {}
    return {"key": caller.key} | ({"admin": True} if caller.owner.sees_all else {})


class Turns:
    """Few requests are begun at a time, and the others wait for nothing but a place: so however many come at once,
    the event loop is soon done with what it has begun, and probes, which pass the line, are answered at once.

    What takes longer than a turn waits for a query, a disk or its client, and gives up its place to the next.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._places = anyio.Semaphore(PLACES)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on in its turn."""
        if scope["type"] != "http" or scope["path"] in PROBES:
            await self._app(scope, receive, send)
            return
        await self._places.acquire()
        held = True

        def give_up() -> None:
            nonlocal held
            if held:
                held = False
                self._places.release()

        timer = asyncio.get_running_loop().call_later(TURN_SECONDS, give_up)
        try:
            await self._app(scope, receive, send)
        finally:
            timer.cancel()
            give_up()


class AnswerHead:
    """Asks the routes for GET where HEAD is asked, passes on the head of the answer, and lets the rest go.

    What would be read or waited for to make the body is cancelled: a file stays unread, and a stream of events ends.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; a HEAD as a GET."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        headers = [(name, value) for name, value in scope["headers"] if name != b"range"]  # which is for GET alone
        asked = {**scope, "method": "GET", "headers": headers}
        with anyio.CancelScope() as rest:

            async def told(message: Message) -> None:
                if message["type"] == "http.response.start":
                    await send(message)
                    await send({"type": "http.response.body", "body": b"", "more_body": False})
                    rest.cancel()

            try:
                await self._app(asked, receive, told)
            finally:
                if "route" in asked:
                    scope["route"] = asked["route"]  # which the recorder reads
