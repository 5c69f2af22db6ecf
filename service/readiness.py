"""Whether the service can do what it is for: what `/readyz` asks."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable

import anyio

from liftcore.errors import SplatliftError
from service.errors import NotReady
from service.jobs.supervisor import Supervisor
from service.queries.warm import WarmWorker
from service.stopping import Stopping
from service.store.store import Store

PATIENCE_SECONDS = 2.0  # for all checks; a disk that takes longer is no disk to work with
FRESH_SECONDS = 1.0  # a look counts for so long: however many ask, the disk is written once a second

CHECKS = ("database", "disk", "supervisor", "queries")


class Readiness:
    """The checks, in a thread of their own: they neither wait behind slow routes nor hold up the event loop."""

    def __init__(self, store: Store, runner: Supervisor, worker: WarmWorker, stopping: Stopping) -> None:
        self._stopping = stopping
        self._checks: dict[str, Callable[[], str | None]] = {
            "database": lambda: _complaint(store.database.prove_writable),
            "disk": lambda: _complaint(store.files.require_room),
            "supervisor": lambda: None if runner.alive() else "a thread of the supervisor has died",
            "queries": lambda: None if worker.revive() else "the query worker has died; a new one starts",
        }
        self._turn: anyio.CapacityLimiter | None = None
        self._looked = -FRESH_SECONDS
        self._found: dict[str, str] = {}

    async def require(self) -> None:
        """Return when all is well.

        Raises:
            NotReady: the service stops, or a check failed; it says which.
        """
        if self._stopping.begun:
            raise NotReady("stopping", expected="a service that goes on", got="one that stops")
        found = self._found if self._fresh() else await self._look_in_time()
        if found:
            told = "; ".join(f"{name}: {why}" for name, why in found.items())
            raise NotReady(", ".join(found), expected="checks that pass", got=told)

    async def _look_in_time(self) -> dict[str, str]:
        if self._turn is None:
            self._turn = anyio.CapacityLimiter(1)
        with anyio.move_on_after(PATIENCE_SECONDS):
            # A look that hangs keeps its turn: those after it wait in vain, and no second thread hangs beside it.
            return await anyio.to_thread.run_sync(self._look, limiter=self._turn, abandon_on_cancel=True)
        return {"database": f"no answer within {PATIENCE_SECONDS:g} s"}

    def _look(self) -> dict[str, str]:
        if not self._fresh():  # the one before us may just have looked
            found = {name: check() for name, check in self._checks.items()}
            self._found = {name: why for name, why in found.items() if why is not None}
            self._looked = time.monotonic()
        return self._found

    def _fresh(self) -> bool:
        return time.monotonic() - self._looked < FRESH_SECONDS


def _complaint(check: Callable[[], None]) -> str | None:
    try:
        check()
    except (SplatliftError, sqlite3.Error, OSError) as error:
        return str(error)
    return None
