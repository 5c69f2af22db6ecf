"""Events of a job as a stream (server-sent events), for a bounded number of clients at a time."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import AsyncIterator, Callable

import anyio
from fastapi.sse import EventSourceResponse, format_sse_event
from starlette.types import Receive, Scope, Send

from liftcore.errors import NotFound
from service.errors import Busy, require_share
from service.models import ENDED
from service.store.jobs import Event, EventKind

LOOK_SECONDS = 0.25  # between looks for new events
BREATH_SECONDS = 15.0  # of silence, then a comment shows that the line is open
LOOKERS = 2  # threads that look, however many follow: streams must not starve the other routes

Look = Callable[[int], list[Event]]  # the events after a number
Shape = Callable[[Event], str]  # the JSON of an event


class EventStreams:
    """All open streams, of which a key has a share. Used from the event loop only.

    Args:
        limit: how many there may be.
        of_a_key: how many of these one key may have; never all of them.
    """

    def __init__(self, limit: int, of_a_key: int) -> None:
        self._limit = limit
        self._share = max(1, min(of_a_key, limit - 1))
        self._closing = False
        self._lookers = anyio.CapacityLimiter(LOOKERS)
        self._open: Counter[str | None] = Counter()

    @property
    def open(self) -> int:
        """How many there are."""
        return self._open.total()

    def close(self) -> None:
        """Let every stream end soon: the server stops."""
        self._closing = True

    def answer(self, look: Look, shape: Shape, after: int, key: str | None) -> EventSourceResponse:
        """The events after a number as they come, until the last state.

        Raises:
            Busy: as many streams are open as may be.
            TooMany: the key has its share of them.
        """
        if self.open >= self._limit:
            raise Busy(
                "events", expected=f"at most {self._limit} open streams", got="more", hint="GET the job instead"
            )
        require_share("events", self._open[key], None if key is None else self._share)
        return _Stream(self._open, key, self._follow(look, shape, after))

    async def _follow(self, look: Look, shape: Shape, after: int) -> AsyncIterator[bytes]:
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

    def __init__(self, count: Counter[str | None], key: str | None, events: AsyncIterator[bytes]) -> None:
        super().__init__(events, headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})
        self._count, self._key = count, key
        count[key] += 1

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._count[self._key] -= 1
            if not self._count[self._key]:
                del self._count[self._key]
