"""A body that is too slow or too long after its answer began disturbs the answer no more."""

from __future__ import annotations

import anyio
import pytest
from starlette.requests import Request
from starlette.responses import StreamingResponse
from starlette.types import Message, Receive, Scope, Send

from service.limits import BodyLimit, Pace

SCOPE = {"type": "http", "method": "GET", "path": "/jobs/x/events", "headers": [], "asgi": {"spec_version": "2.3"}}
PIECES = 8


async def streaming(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer for eight times as long as a body may be silent, without a look at it."""

    async def pieces():
        for number in range(PIECES):
            yield f"{number}\n"
            await anyio.sleep(0.05)

    await StreamingResponse(pieces())(scope, receive, send)


@pytest.mark.parametrize("bytes_at_a_time", [0, 1, 100], ids=["silent", "slow", "long"])
def test_answer_that_began_goes_on_to_its_end(bytes_at_a_time: int) -> None:
    sent: list[Message] = []

    async def receive() -> Message:
        await anyio.sleep(0.02 if bytes_at_a_time else 60)
        return {"type": "http.request", "body": b"x" * bytes_at_a_time, "more_body": True}

    async def send(message: Message) -> None:
        sent.append(message)

    app = BodyLimit(streaming, limit=50, pace=Pace(bytes_per_second=1000, grace_seconds=0.05))
    anyio.run(app, dict(SCOPE), receive, send)
    assert b"".join(message.get("body", b"") for message in sent).count(b"\n") == PIECES
    assert sent[-1] == {"type": "http.response.body", "body": b"", "more_body": False}


def test_body_is_watched_until_the_answer_begins() -> None:
    async def reading(scope: Scope, receive: Receive, send: Send) -> None:
        await Request(scope, receive).body()

    async def silent() -> Message:
        await anyio.sleep(60)
        return {"type": "http.disconnect"}

    async def send(message: Message) -> None:
        raise AssertionError(message)

    app = BodyLimit(reading, limit=50, pace=Pace(grace_seconds=0.05))
    with pytest.raises(Exception, match="less than 1024 bytes"):
        anyio.run(app, dict(SCOPE), silent, send)
