"""ASGI layers between the gate and the routes: bodies have an end, HEAD is GET's head, a stop takes no work."""

from __future__ import annotations

import anyio
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.auth import UPLOADS
from service.errors import Busy
from service.problems import CLOSE, answer_to
from service.state import Stopping

WORKLESS = frozenset({"GET", "HEAD", "OPTIONS"})  # methods that start nothing


class BodyLimit:
    """No route reads more than ``limit`` bytes, but for uploads, which count their own.

    Once an answer has begun nobody waits for the body, and the one who listens for the end of the connection hears no
    more of this.
    """

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app = app
        self._limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on with a receive channel that counts."""
        if scope["type"] != "http" or scope["path"].startswith(UPLOADS):
            await self._app(scope, receive, send)
            return
        received, begun = 0, False

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > self._limit and not begun:
                raise HTTPException(413, f"the body has more than {self._limit} bytes", CLOSE)
            return message

        async def told(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        await self._app(scope, counted, told)


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
        asked = {**scope, "method": "GET"}
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


class RefuseWork:
    """While the service stops, what would give it work is answered 503 and may go elsewhere."""

    def __init__(self, app: ASGIApp, stopping: Stopping) -> None:
        self._app = app
        self._stopping = stopping

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] == "http" and self._stopping.begun and scope["method"] not in WORKLESS:
            error = Busy("server", expected="a running server", got="one that stops", hint="ask the next one")
            await answer_to(error, CLOSE)(scope, receive, send)
            return
        await self._app(scope, receive, send)
