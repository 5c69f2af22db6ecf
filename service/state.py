"""What an application carries: the parts that routes call, whether it can work, and how it stops."""

from __future__ import annotations

import logging
import os
import sqlite3
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated

import anyio
from fastapi import Depends, Request

from liftcore.errors import SplatliftError
from liftcore.files import PhotoIndexes
from service import sandbox
from service.auth import CALLER, Caller
from service.content import EventStreams
from service.errors import NotReady
from service.models import Version
from service.observe import Metrics
from service.query_client import QueryClient
from service.sandbox import SandboxLimits
from service.settings import ServiceSettings
from service.store.owners import Owner
from service.store.store import Store
from service.supervisor import Supervisor

PATIENCE_SECONDS = 2.0  # for all checks of readiness; a disk that takes longer is no disk to work with
FRESH_SECONDS = 1.0  # a look counts for so long: however many ask, the disk is written once a second
HURRY_SECONDS = 0.1  # between two looks at whether somebody is in a hurry
PROBE_BYTES = 4096
CHECKS = ("database", "disk", "supervisor", "queries", "uploads")

log = logging.getLogger(__name__)


class Stopping:
    """The orderly stop: work is refused, streams end, running jobs go back in line, and only then the port closes.

    Begun once, from the event loop; anybody may ask whether it has.
    """

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
        start = time.monotonic()
        self.begun = True
        log.info("stopping: no new work, running jobs go back in line")
        self._streams.close()
        await anyio.to_thread.run_sync(self._runner.stop)
        while not hurried() and (remaining := self._notice - (time.monotonic() - start)) > 0:
            await anyio.sleep(min(remaining, HURRY_SECONDS))


class Readiness:
    """What ``/readyz`` asks. The checks run in a thread of their own: they neither wait behind slow routes nor hold
    up the event loop."""

    def __init__(self, store: Store, runner: Supervisor, queries: QueryClient, stopping: Stopping) -> None:
        self._stopping = stopping
        self._checks: dict[str, Callable[[], str | None]] = {
            "database": lambda: _complaint(store.database.prove_usable),
            "disk": lambda: _complaint(lambda: _prove_disk(store)),
            "supervisor": lambda: None if runner.alive() else "a thread of the supervisor has died",
            "queries": lambda: (
                None if queries.revive() else "the query worker has died or was stopped; a new one starts"
            ),
            "uploads": lambda: (
                None if sandbox.revive() else "what checks uploads has died or was stopped; a new one starts"
            ),
        }
        self._turn = anyio.CapacityLimiter(1)
        self._looked = -FRESH_SECONDS
        self._looking_at = CHECKS[0]
        self._found: dict[str, str] = {}

    async def require(self) -> None:
        """Return when all is well.

        Raises:
            NotReady: the service stops, or a check failed; it says which.
        """
        if self._stopping.begun:
            raise NotReady("stopping", expected="a service that goes on", got="one that stops")
        failures = self._found if self._fresh() else await self._look_in_time()
        if failures:  # why, is for the log: it may name files of the server
            failed = ", ".join(failures)
            raise NotReady(failed, expected="checks that pass", got=f"{failed} failed", hint="the log says why")

    async def _look_in_time(self) -> dict[str, str]:
        with anyio.move_on_after(PATIENCE_SECONDS):
            # A look that hangs keeps its turn: those after it wait in vain, and no second thread hangs beside it.
            return await anyio.to_thread.run_sync(self._look, limiter=self._turn, abandon_on_cancel=True)
        return {self._looking_at: f"no answer within {PATIENCE_SECONDS:g} s"}

    def _look(self) -> dict[str, str]:
        if not self._fresh():  # the one before us may just have looked
            results = {}
            for name, check in self._checks.items():
                self._looking_at = name
                results[name] = check()
            self._found = {name: reason for name, reason in results.items() if reason is not None}
            for name, reason in self._found.items():
                log.warning("the check of the %s failed: %s", name, reason)
            self._looked = time.monotonic()
        return self._found

    def _fresh(self) -> bool:
        return time.monotonic() - self._looked < FRESH_SECONDS


def _prove_disk(store: Store) -> None:
    """See that there is room, and that a file can be written as far as the disk."""
    store.files.require_room()
    with store.files.draft(".probe") as path, path.open("wb") as probe:
        probe.write(bytes(PROBE_BYTES))
        probe.flush()
        os.fsync(probe.fileno())


def _complaint(check: Callable[[], None]) -> str | None:
    try:
        check()
    except (SplatliftError, sqlite3.Error, OSError) as error:
        return str(error)
    return None


@dataclass(frozen=True)
class AppState:
    """What `create_app` was given and made, and for whom a route uses it."""

    settings: ServiceSettings
    version: Version
    store: Store
    caller: Caller
    runner: Supervisor
    queries: QueryClient
    streams: EventStreams
    photos: PhotoIndexes
    metrics: Metrics
    readiness: Readiness
    checks: anyio.CapacityLimiter  # threads of their own, so that who waits for them keeps nobody else waiting
    planning: anyio.CapacityLimiter
    writing: anyio.CapacityLimiter
    parsing: anyio.CapacityLimiter
    ordering: anyio.CapacityLimiter
    scrapes: anyio.CapacityLimiter
    ending: threading.Event = field(default_factory=threading.Event)  # set when what still runs must end

    @property
    def check_limits(self) -> SandboxLimits:
        """What the check of an upload, or a plan, may take."""
        return SandboxLimits(self.settings.check_seconds, self.settings.check_memory_bytes, self.ending)

    @property
    def owner(self) -> Owner:
        """For whom a route works."""
        return self.caller.owner


# Async: a sync dependency waits for a thread of the pool, and every route with it.
async def _deps(request: Request) -> AppState:
    deps: AppState = request.app.state.deps
    return replace(deps, caller=request.scope["state"][CALLER])


Deps = Annotated[AppState, Depends(_deps)]
