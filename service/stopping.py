"""The orderly stop: work is refused, streams end, running jobs go back in line, and only then the port closes."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

import anyio
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import Busy
from service.jobs.streams import EventStreams
from service.jobs.supervisor import Supervisor
from service.problems import answer, problem_of

WORKLESS = frozenset({"GET", "HEAD", "OPTIONS"})  # methods that start nothing
LOOK_SECONDS = 0.1  # between two looks at whether somebody is in a hurry

log = logging.getLogger(__name__)


class Stopping:
    """Begun once, from the event loop; anybody may ask whether it has."""

    def __init__(self, streams: EventStreams, runner: Supervisor, *, notice_seconds: float = 0.0) -> None:
        self._streams = streams
        self._runner = runner
        self._notice = notice_seconds
        self.begun = False

    async def begin(self, hurried: Callable[[], bool]) -> None:
        """Stop taking work; returns when no job runs any more and those in front of us had their notice.

        Args:
            hurried: whether the notice is to end now; asked a few times a second.
        """
        begun = time.monotonic()
        self.begun = True
        log.info("stopping: no new work, running jobs go back in line")
        self._streams.close()
        await anyio.to_thread.run_sync(self._runner.stop)
        while not hurried() and (left := self._notice - (time.monotonic() - begun)) > 0:
            await anyio.sleep(min(left, LOOK_SECONDS))


class RefuseWork:
    """ASGI middleware: while the service stops, what would give it work is answered 503 and may go elsewhere."""

    def __init__(self, app: ASGIApp, stopping: Stopping) -> None:
        self._app = app
        self._stopping = stopping

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] == "http" and self._stopping.begun and scope["method"] not in WORKLESS:
            error = Busy("server", expected="a running server", got="one that stops", hint="ask the next one")
            headers = {"Retry-After": str(error.retry_after), "Connection": "close"}
            await answer(problem_of(error), headers)(scope, receive, send)
            return
        await self._app(scope, receive, send)
