"""HEAD wherever there is GET: the same head, without the body."""

from __future__ import annotations

import anyio
from starlette.types import ASGIApp, Message, Receive, Scope, Send


class AnswerHead:
    """ASGI middleware: asks the routes for GET, passes on the head of the answer, and lets the rest go.

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
