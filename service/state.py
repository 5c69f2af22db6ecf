"""State of an application: the parts that routes call, its readiness, and its stop."""

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

PATIENCE_SECONDS = 2.0  # for all checks of readiness; a disk that takes longer is not usable
FRESH_SECONDS = 1.0  # a result is kept so long: the disk is written once a second, for any number of probes
HURRY_SECONDS = 0.1  # between two polls for a forced exit
PROBE_BYTES = 4096
CHECKS = ("database", "disk", "supervisor", "queries", "uploads")

log = logging.getLogger(__name__)


class Stopping:
    """The orderly stop: refuse work, end streams, requeue running jobs, and then close the port.

    It begins once, from the event loop; any thread may read `has_begun`.
    """

    def __init__(self, streams: EventStreams, runner: Supervisor, *, notice_seconds: float = 0.0) -> None:
        self._streams = streams
        self._runner = runner
        self._notice = notice_seconds
        self.has_begun = False

    async def begin(self, hurried: Callable[[], bool]) -> None:
        """Stop taking work; return when no job runs and proxies had `notice_seconds` to notice.

        Args:
            hurried: returns True if the notice is to end now; called a few times a second.
        """
        start = time.monotonic()
        self.has_begun = True
        log.info("stopping: no new work, running jobs go back in line")
        self._streams.close()
        await anyio.to_thread.run_sync(self._runner.stop)
        while not hurried() and (remaining := self._notice - (time.monotonic() - start)) > 0:
            await anyio.sleep(min(remaining, HURRY_SECONDS))


class Readiness:
    """Checks behind ``/readyz``, in a thread of their own: independent of slow routes and of the event loop."""

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
        self._checked_at = -FRESH_SECONDS
        self._current_check = CHECKS[0]
        self._failures: dict[str, str] = {}

    async def require(self) -> None:
        """Check the readiness; return if all checks pass.

        Raises:
            NotReady: the service stops, or a check failed; it says which.
        """
        if self._stopping.has_begun:
            raise NotReady("stopping", expected="a service that goes on", got="one that stops")
        failures = self._failures if self._fresh() else await self._run_checks_in_time()
        if failures:  # the reasons go to the log only: they may name private files
            failed = ", ".join(failures)
            raise NotReady(failed, expected="checks that pass", got=f"{failed} failed", hint="the log says why")

    async def _run_checks_in_time(self) -> dict[str, str]:
        with anyio.move_on_after(PATIENCE_SECONDS):
            # A check that hangs keeps the lock: later probes time out, and no second thread hangs.
            return await anyio.to_thread.run_sync(self._run_checks, limiter=self._turn, abandon_on_cancel=True)
        return {self._current_check: f"no answer within {PATIENCE_SECONDS:g} s"}

    def _run_checks(self) -> dict[str, str]:
        if not self._fresh():  # another probe may just have run the checks
            results = {}
            for name, check in self._checks.items():
                self._current_check = name
                results[name] = check()
            self._failures = {name: reason for name, reason in results.items() if reason is not None}
            for name, reason in self._failures.items():
                log.warning("the check of the %s failed: %s", name, reason)
            self._checked_at = time.monotonic()
        return self._failures

    def _fresh(self) -> bool:
        return time.monotonic() - self._checked_at < FRESH_SECONDS


def _prove_disk(store: Store) -> None:
    """Require free space, and that a file can be written to the disk."""
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
    """Parts of the application, and the caller of the current request."""

    settings: ServiceSettings
    version: Version
    store: Store
    caller: Caller
    supervisor: Supervisor
    query_client: QueryClient
    streams: EventStreams
    photos: PhotoIndexes
    metrics: Metrics
    readiness: Readiness
    checks: anyio.CapacityLimiter  # separate thread limits, so that slow operations do not starve others
    planning: anyio.CapacityLimiter
    writing: anyio.CapacityLimiter
    parsing: anyio.CapacityLimiter
    ordering: anyio.CapacityLimiter
    scrapes: anyio.CapacityLimiter
    ending: threading.Event = field(default_factory=threading.Event)  # set when running checks must end

    @property
    def check_limits(self) -> SandboxLimits:
        """Return the limits of an upload's check or of a plan."""
        return SandboxLimits(self.settings.check_seconds, self.settings.check_memory_bytes, self.ending)

    @property
    def owner(self) -> Owner:
        """Return the owner for which a route works."""
        return self.caller.owner


# Async: a sync dependency waits for a thread of the pool, and every route with it.
async def _deps(request: Request) -> AppState:
    deps: AppState = request.app.state.deps
    return replace(deps, caller=request.scope["state"][CALLER])


Deps = Annotated[AppState, Depends(_deps)]
