"""One client's connection: how many there may be, and how long each may wait without a request or a reader.

uvicorn closes a connection that is idle after an answer, and no other: a client that sends its headers a byte at a
time, or never reads what it asked for, would be kept for ever. Bodies are watched where they are read
(``service.limits``).
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Mapping
from http import HTTPStatus
from typing import ClassVar

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from service import problems, request_id
from service.limits import Pace
from service.wire import Problem

GOODBYE_SECONDS = 1.0  # for a client to read why it was turned away
UNREAD_BYTES = 128 << 10  # that may lie between a client that reads slowly and us, without our seeing it read


class WatchedConnection(H11Protocol):
    """HTTP/1.1 with limits on time and number; `watched` makes the class that a server is given."""

    pace: ClassVar[Pace] = Pace()
    most: ClassVar[int] = 400

    _request: asyncio.TimerHandle | None = None  # when a request must have come
    _reading: asyncio.TimerHandle | None = None  # when a client must have read something
    _turned_away = False

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Begin to wait for a request, or say that there are too many connections."""
        super().connection_made(transport)
        if len(self.connections) > self.most:
            self._turned_away = True
            detail = f"{self.most} connections are open already; try again soon."
            transport.write(_answer(503, "busy", "The server is busy", detail, {"Retry-After": "2"}))
            transport.write_eof()
            self._request = self.loop.call_later(GOODBYE_SECONDS, transport.abort)
        else:
            self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the clocks."""
        for clock in (self._request, self._reading):
            if clock is not None:
                clock.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take bytes of a request."""
        if not self._turned_away:
            super().data_received(data)
            self._watch()

    def on_response_complete(self) -> None:
        """Wait for the next request; for one whose body was answered before its end, no longer than for another."""
        self._await_reader()  # first, as the next request may be here already and begin to be answered
        super().on_response_complete()
        if self.conn.their_state is h11.SEND_BODY:
            self._watch()

    def pause_writing(self) -> None:
        """The client does not read as fast as we write."""
        super().pause_writing()
        self._await_reader()

    def resume_writing(self) -> None:
        """It has read."""
        super().resume_writing()
        if self._answering():
            self._forget_reader()
        else:
            self._await_reader()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP, in the shape of all our errors. Called while the error is handled."""
        error = sys.exc_info()[1]
        long = isinstance(error, h11.RemoteProtocolError) and error.error_status_hint == 431
        status = 431 if long else 400
        slug, title = problems.FRAMEWORK[status]
        self._refuse(status, slug, title, msg)

    def _watch(self) -> None:
        """See that the clock runs while no request is being answered."""
        if self._answering():
            if self._request is not None:
                self._request.cancel()
                self._request = None
        elif self._request is None:
            self._request = self.loop.call_later(self.pace.head_seconds, self._no_request)

    def _no_request(self) -> None:
        begun = self.conn.their_state is h11.IDLE and bool(self.conn.trailing_data[0])
        if begun and not self.transport.is_closing():
            detail = f"The headers of the request did not come within {self.pace.head_seconds:g} s."
            self._refuse(408, "too-slow", problems.FRAMEWORK[408][1], detail)
        else:
            self.transport.close()

    def _answering(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _await_reader(self) -> None:
        """See that what was written is read: a transport that is closed waits for that without an end."""
        self._forget_reader()
        unread = self.transport.get_write_buffer_size()
        if unread:
            seconds = self.pace.grace_seconds + UNREAD_BYTES / self.pace.bytes_per_second
            self._reading = self.loop.call_later(seconds, self._no_reader, unread)

    def _forget_reader(self) -> None:
        if self._reading is not None:
            self._reading.cancel()
            self._reading = None

    def _no_reader(self, unread: int) -> None:
        growing = self._answering() and not self.flow.write_paused and not self.transport.is_closing()
        if growing or self.transport.get_write_buffer_size() < unread:
            self._await_reader()
        else:
            self.transport.abort()

    def _refuse(self, status: int, slug: str, title: str, detail: str) -> None:
        if self.cycle is None or self.cycle.response_complete or not self.cycle.response_started:
            self.transport.write(_answer(status, slug, title, detail, {}))
        self.transport.close()
        self._await_reader()


def watched(pace: Pace, most: int) -> type[WatchedConnection]:
    """The class of connections with these limits."""
    return type("WatchedConnection", (WatchedConnection,), {"pace": pace, "most": most})


def _answer(status: int, slug: str, title: str, detail: str, headers: Mapping[str, str]) -> bytes:
    """A problem as it goes over the wire when there is no request to answer."""
    problem = Problem(type=f"/problems/{slug}", title=title, status=status, detail=detail)
    made = request_id.chosen(())
    with request_id.working_for(made):
        reply = problems.answer(problem, {**headers, "Connection": "close", "X-Request-ID": made})
    lines = [f"HTTP/1.1 {status} {HTTPStatus(status).phrase}".encode()]
    lines += [name + b": " + value for name, value in reply.raw_headers]
    return b"\r\n".join([*lines, b"", bytes(reply.body)])
