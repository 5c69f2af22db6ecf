"""Events of a job as a stream (server-sent events), for a bounded number of clients at a time."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable

import anyio
from fastapi.sse import EventSourceResponse, format_sse_event
from starlette.types import Receive, Scope, Send

from liftcore.errors import NotFound
from service.errors import Busy
from service.models import ENDED
from service.store.jobs import Event, EventKind

LOOK_SECONDS = 0.25  # between looks for new events
BREATH_SECONDS = 15.0  # of silence, then a comment shows that the line is open
LOOKERS = 2  # threads that look, however many follow: streams must not starve the other routes

Look = Callable[[int], list[Event]]  # the events after a number
Shape = Callable[[Event], str]  # the JSON of an event


class EventStreams:
    """All open streams. Used from the event loop only."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._closing = False
        self._lookers: anyio.CapacityLimiter | None = None
        self.open = 0

    def close(self) -> None:
        """Let every stream end soon: the server stops."""
        self._closing = True

    def answer(self, look: Look, shape: Shape, after: int) -> EventSourceResponse:
        """The events after a number as they come, until the last state.

        Raises:
            Busy: as many streams are open as may be.
        """
        if self.open >= self._limit:
            raise Busy(
                "events", expected=f"at most {self._limit} open streams", got="more", hint="GET the job instead"
            )
        return _Stream(self, self._follow(look, shape, after))

    async def _follow(self, look: Look, shape: Shape, after: int) -> AsyncIterator[bytes]:
        if self._lookers is None:
            self._lookers = anyio.CapacityLimiter(LOOKERS)
        spoke = time.monotonic()
        while not self._closing:
            try:
                events = await anyio.to_thread.run_sync(look, after, limiter=self._lookers)
            except NotFound:  # deleted meanwhile, or the key was revoked
                return
            for event in events:
                after, spoke = event.number, time.monotonic()
                yield format_sse_event(id=str(event.number), event=event.kind, data_str=shape(event))
                if is_last(event):
                    return
            if time.monotonic() - spoke > BREATH_SECONDS:
                spoke = time.monotonic()
                yield format_sse_event(comment="still here")
            await anyio.sleep(LOOK_SECONDS)


def is_last(event: Event) -> bool:
    """Whether nothing comes after this event."""
    return event.kind is EventKind.STATE and event.data["state"] in ENDED


class _Stream(EventSourceResponse):
    """Counts as open while it is being sent, and lets go however that ends."""

    def __init__(self, streams: EventStreams, events: AsyncIterator[bytes]) -> None:
        super().__init__(events, headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})
        self._streams = streams
        streams.open += 1

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._streams.open -= 1
