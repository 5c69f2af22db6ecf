"""How much a request may send, and how slowly."""

from __future__ import annotations

import time
from dataclasses import dataclass

import anyio
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

UPLOADS = "/assets/"  # routes below it count their own bytes: their limits are of another order
CLOSE = {"Connection": "close"}  # what is still to come of the body would be taken for the next request


@dataclass(frozen=True)
class Pace:
    """What a client must keep up with, once it is waited for."""

    bytes_per_second: int = 1024  # of a body, up or down
    grace_seconds: float = 10.0  # over which that is measured
    head_seconds: float = 10.0  # for a request's line and headers

    @property
    def least(self) -> int:
        """Bytes that must come in each span of waiting as long as the grace."""
        return round(self.bytes_per_second * self.grace_seconds)


class BodyLimit:
    """ASGI middleware: no route reads more than ``limit`` bytes, and no body comes more slowly than ``pace``.

    Time counts only while the route waits for the client, so our own slowness is nobody's fault. The errors are
    the framework's: it turns all others that come up while it reads a JSON body into 400. Once an answer has begun
    nobody waits for the body, and the one who listens for the end of the connection hears no more of this.
    """

    def __init__(self, app: ASGIApp, limit: int, pace: Pace) -> None:
        self._app = app
        self._limit = limit
        self._pace = pace

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on with a receive channel that counts and looks at the clock."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limited = _paced(receive, self._pace)
        if not scope["path"].startswith(UPLOADS):
            limited = _counted(limited, self._limit)
        begun = False

        async def heard() -> Message:
            try:
                return await (receive() if begun else limited())
            except HTTPException:
                if not begun:
                    raise
                return await receive()

        async def told(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        await self._app(scope, heard, told)


def _counted(receive: Receive, limit: int) -> Receive:
    received = 0

    async def counted() -> Message:
        nonlocal received
        message = await receive()
        received += len(message.get("body", b""))
        if received > limit:
            raise HTTPException(413, f"the body has more than {limit} bytes")
        return message

    return counted


def _paced(receive: Receive, pace: Pace) -> Receive:
    waited, came, coming = 0.0, 0, True  # seconds and bytes of the span that is measured, whether more is to come

    async def paced() -> Message:
        nonlocal waited, came, coming
        if not coming:  # what comes after the body is the end of the connection, whenever it likes
            return await receive()
        begun = time.monotonic()
        try:
            with anyio.fail_after(pace.grace_seconds - waited):
                message = await receive()
        except TimeoutError:
            told = f"less than {pace.bytes_per_second} bytes of the body came in a second"
            raise HTTPException(408, told, CLOSE) from None
        waited += time.monotonic() - begun
        came += len(message.get("body", b""))
        if came >= pace.least:
            waited, came = 0.0, 0
        coming = message["type"] == "http.request" and message.get("more_body", False)
        return message

    return paced
