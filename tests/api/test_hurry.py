"""A stop has time for its notice, until somebody is in a hurry."""

from __future__ import annotations

import signal
import threading
from typing import Any, cast

import anyio
import uvicorn

from service.__main__ import AnnouncingServer
from service.jobs.supervisor import Supervisor
from service.state import Stopping
from service.streams import EventStreams


class Idle:
    """Stands in for the supervisor of jobs."""

    def stop(self) -> None: ...


async def nothing(*_: Any) -> None:
    """No application."""


def test_second_sigint_ends_the_notice() -> None:
    stopping = Stopping(EventStreams(1, 1), cast("Supervisor", Idle()), notice_seconds=600)
    server = AnnouncingServer(uvicorn.Config(nothing, lifespan="off"), stopping, print)
    server.handle_exit(signal.SIGINT, None)
    again = threading.Timer(0.3, server.handle_exit, (signal.SIGINT, None))

    async def stop() -> None:
        again.start()
        with anyio.fail_after(60):
            await stopping.begin(lambda: server.force_exit)

    anyio.run(stop)
    assert server.force_exit


def test_notice_is_kept_while_nobody_hurries() -> None:
    asked: list[int] = []

    def hurried() -> bool:
        asked.append(1)
        return False

    stopping = Stopping(EventStreams(1, 1), cast("Supervisor", Idle()), notice_seconds=0.5)
    anyio.run(stopping.begin, hurried)
    assert stopping.begun and len(asked) > 1
