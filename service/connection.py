"""One client's connection: how many there may be, and how long each may keep the server waiting.

uvicorn closes a connection that is idle after an answer, and no other: a client that sends its headers or its body a
byte at a time, or never reads what it asked for, would be kept for ever. A proxy before the service watches its own
clients; this is for those who come without one.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

import h11
from uvicorn.protocols.http.h11_impl import STATUS_PHRASES, H11Protocol

from service import problems
from service.observe import chosen_id, working_for

GOODBYE_SECONDS = 1.0  # for a client to read why it was turned away
LOOKS = 4  # at a connection, in the shortest time that it has for anything
UNREAD_BYTES = 128 << 10  # that may lie between a client that reads slowly and us, without our seeing it read


@dataclass(frozen=True)
class Pace:
    """What a client must keep up with, once it is waited for."""

    bytes_per_second: int = 1024  # of a body, up or down
    grace_seconds: float = 10.0  # over which that is measured
    head_seconds: float = 10.0  # for a request's line and headers
    connections: int = 400  # of all clients together


class Wait(StrEnum):
    """What the server waits for."""

    NOTHING = "nothing"
    HEAD = "head"
    BODY = "body"
    READER = "reader"


class Patience:
    """Judges how long a client has kept the server waiting for one thing."""

    def __init__(self, pace: Pace) -> None:
        self._pace = pace
        self._wait: tuple[Wait, int] | None = None
        self._since = 0.0
        self._mark = 0

    def is_over(self, wait: Wait, turn: int, moved: int, now: float) -> bool:
        """Whether the client had its time.

        Args:
            wait: what the server waits for now.
            turn: of the requests of the connection; another turn is another wait.
            moved: bytes that the client has sent, or read, so far.
            now: seconds of a clock that never goes back.
        """
        if (wait, turn) != self._wait:
            self._wait, self._since, self._mark = (wait, turn), now, moved
        waited, brought = now - self._since, moved - self._mark
        pace = self._pace
        if wait is Wait.HEAD:
            return waited >= pace.head_seconds
        if wait is Wait.BODY and waited >= pace.grace_seconds:
            self._since, self._mark = now, moved
            return brought < pace.bytes_per_second * waited
        if wait is Wait.READER:
            if brought:
                self._since, self._mark = now, moved
            return not brought and waited >= pace.grace_seconds + UNREAD_BYTES / pace.bytes_per_second
        return False


class Connection(H11Protocol):
    """HTTP/1.1 with limits on time and number; `watched` makes the class that a server is given."""

    pace: ClassVar[Pace] = Pace()

    _look: asyncio.TimerHandle | None = None
    _turned_away = False
    _turn = 0  # requests that were answered
    _received = 0  # bytes
    _unread = 0  # bytes in the transport's buffer when they were last looked at
    _read = 0  # counts what of these the client took

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Begin to wait for a request, or say that there are too many connections."""
        super().connection_made(transport)
        self._patience = Patience(self.pace)
        if len(self.connections) > self.pace.connections:
            self._turned_away = True
            detail = f"{self.pace.connections} connections are open already; try again soon."
            transport.write(_answer(503, detail, {"Retry-After": "2"}))
            transport.write_eof()
            self._look = self.loop.call_later(GOODBYE_SECONDS, transport.abort)
        else:
            self._judge()

    def connection_lost(self, exc: Exception | None) -> None:
        """Look no more."""
        if self._look is not None:
            self._look.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take bytes of a request."""
        if not self._turned_away:
            self._received += len(data)
            super().data_received(data)

    def on_response_complete(self) -> None:
        """Wait for the next request, or for the rest of a body that was answered before its end."""
        self._turn += 1
        super().on_response_complete()

    def resume_writing(self) -> None:
        """The client has read most of what there was."""
        self._read += 1
        super().resume_writing()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP, in the shape of all our errors. Called while the error is handled."""
        error = sys.exc_info()[1]
        long = isinstance(error, h11.RemoteProtocolError) and error.error_status_hint == 431
        self._refuse(431 if long else 400, msg)

    def _judge(self) -> None:
        """Look at what the client keeps us waiting for, again and again."""
        pace = self.pace
        self._look = self.loop.call_later(min(pace.head_seconds, pace.grace_seconds) / LOOKS, self._judge)
        unread = self.transport.get_write_buffer_size()
        self._read += unread < self._unread
        self._unread = unread
        wait = self._awaited()
        moved = self._read if wait is Wait.READER else self._received
        if not self._patience.is_over(wait, self._turn, moved, self.loop.time()):
            return
        begun = self.conn.their_state is h11.SEND_BODY or self.conn.trailing_data[0]
        if wait is Wait.READER:
            self.transport.abort()
        elif self.transport.is_closing() or not begun or (wait is Wait.HEAD and self.conn.our_state is h11.DONE):
            self.transport.close()
        elif wait is Wait.HEAD:
            self._refuse(408, f"The headers of the request did not come within {pace.head_seconds:g} s.")
        else:
            self._refuse(408, f"Less than {pace.bytes_per_second} bytes of the body came in a second.")

    def _awaited(self) -> Wait:
        answering = self.cycle is not None and not self.cycle.response_complete
        blocked = self.flow.write_paused or not answering or self.transport.is_closing()
        if self._unread and blocked:
            return Wait.READER
        if not answering:
            return Wait.HEAD
        cycle = self.cycle
        ours = self.flow.read_paused or cycle.waiting_for_100_continue  # then it is we who keep the client waiting
        return Wait.BODY if cycle.more_body and not cycle.response_started and not ours else Wait.NOTHING

    def _refuse(self, status: int, detail: str) -> None:
        if self.cycle is None or self.cycle.response_complete or not self.cycle.response_started:
            self.transport.write(_answer(status, detail, {}))
        if self.cycle is not None:
            self.cycle.disconnected = True  # whoever reads the body, or is about to answer, has no client any more
            self.cycle.message_event.set()
        self.transport.close()


def watched(pace: Pace) -> type[Connection]:
    """The class of connections with these limits."""
    return type("Connection", (Connection,), {"pace": pace})


def _answer(status: int, detail: str, headers: Mapping[str, str]) -> bytes:
    """A problem as bytes, where there is no request to answer."""
    made = chosen_id(())
    with working_for(made):
        told = {**headers, **problems.CLOSE, "X-Request-ID": made}
        reply = problems.answer(problems.by_status(status, detail), told)
    lines = [b"HTTP/1.1 %d %s" % (status, STATUS_PHRASES[status])]
    lines += [name + b": " + value for name, value in reply.raw_headers]
    return b"\r\n".join([*lines, b"", bytes(reply.body)])
