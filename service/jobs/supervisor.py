"""The supervisor: takes queued jobs in order and runs each in a child process, some at the same time."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence

from liftcore.errors import SplatliftError
from service.child import fault_of
from service.errors import Crashed, NoSpace
from service.jobs.attempt import CHILD, TROUBLE, Attempt, Clock, insist
from service.jobs.process import JobLimits, end_orphans
from service.observe import working_for
from service.store.jobs import JobRecord
from service.store.owners import SERVICE
from service.store.store import Store

IDLE_SECONDS = 5.0  # a forgotten wake-up costs at most this
TROUBLED_SECONDS = (1.0, 30.0)  # first and longest pause after an attempt that the server could not keep up
ROOM_SECONDS = 60.0  # how long an attempt waits for room on the disk before it tries without

log = logging.getLogger(__name__)


class Supervisor:
    """Threads that own the running jobs, one each. Only they change a job after it was submitted or canceled.

    Args:
        store: that holds the jobs.
        limits: what they may take.
        command: of their processes.
        clock: by which leases are measured.
    """

    def __init__(
        self, store: Store, limits: JobLimits, *, command: Sequence[str] = CHILD, clock: Clock = time.monotonic
    ) -> None:
        self._store = store
        self._limits = limits
        self._command = command
        self._clock = clock
        self._bell = threading.Condition()
        self._rung = 0
        self._stopping = threading.Event()
        self._told: Callable[[str, float], None] | None = None
        self._beginning = threading.Lock()
        self._left_behind = True  # jobs of the server before us may seem to run
        self._threads = [
            threading.Thread(target=self._loop, name=f"supervisor-{number}", daemon=True)
            for number in range(limits.parallel)
        ]

    def start(self) -> None:
        """End what a dead server left running, then begin to take jobs."""
        found = end_orphans(self._store.jobs.unfinished())
        if found:
            log.warning("ended %d processes that outlived their server", found)
        for thread in self._threads:
            thread.start()

    def tell(self, told: Callable[[str, float], None]) -> None:
        """Call this after each attempt, with the state that its job came to and the seconds that it took."""
        self._told = told

    def alive(self) -> bool:
        """Whether all threads live."""
        return all(thread.is_alive() for thread in self._threads)

    def wake(self) -> None:
        """Say that there is a new job."""
        with self._bell:
            self._rung += 1
            self._bell.notify_all()

    def stop(self) -> None:
        """End the running children and put their jobs back in line; returns when no child is left."""
        self._stopping.set()
        self.wake()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()

    def _loop(self) -> None:
        troubled = 0  # attempts in a row that the server could not keep up
        while not self._stopping.is_set():
            rung = self._rung
            try:
                job = self._next()
                if job is not None:
                    troubled = 0 if self._run(job) else troubled + 1
                    self._pause(troubled)
                    continue
            except Exception:  # the thread must outlive a full disk or a locked database
                log.exception("the supervisor stumbled")
            self._rest(rung)

    def _next(self) -> JobRecord | None:
        """Claim a job; before the first one, those of the server before us go back in line."""
        with self._beginning:
            if self._left_behind:
                self._store.jobs.release_all("the server died")
                self._left_behind = False
        return self._store.jobs.claim()

    def _rest(self, rung: int) -> None:
        """Wait for a ring of the bell after that one, for a stop, or for IDLE_SECONDS."""
        with self._bell:
            self._bell.wait_for(lambda: self._rung != rung or self._stopping.is_set(), IDLE_SECONDS)

    def _pause(self, troubled: int) -> None:
        """Wait while the server has trouble: longer each time, then for a disk above its floor, though not for ever:
        what fills it may be what the next job goes on from.
        """
        first, longest = TROUBLED_SECONDS
        if troubled:
            self._stopping.wait(min(longest, first * 2 ** min(troubled - 1, 10)))
        until = time.monotonic() + ROOM_SECONDS
        while time.monotonic() < until and not self._stopping.is_set():
            try:
                self._store.files.require_room()
                return
            except (NoSpace, OSError):
                self._stopping.wait(first)

    def _run(self, job: JobRecord) -> bool:
        """Run a job; whether its attempt came to an end of its own."""
        begun, attempts, kept_up = time.monotonic(), self._store.jobs, True
        with working_for(job.request_id):
            log.info("job %s, attempt %d begins", job.id, job.attempt)
            try:
                Attempt(job, self._store, self._limits, self._command, self._clock).run(self._stopping)
            except TROUBLE as error:
                log.exception("job %s could not be kept up", job.id)
                kept_up, why = False, f"the server could not keep it up: {error}"
                insist(lambda: attempts.release(job.id, job.attempt, why), self._stopping)
            except Exception as error:
                log.exception("job %s could not be run", job.id)
                unforeseen = Crashed("job", expected="a process that runs", got="an error of the server")
                fault = fault_of(error if isinstance(error, SplatliftError) else unforeseen)
                insist(lambda: attempts.fail(job.id, job.attempt, fault), self._stopping)
            outcome, seconds = attempts.state(SERVICE, job.id) or "deleted", time.monotonic() - begun
            log.info("job %s, attempt %d: %s after %.3f s", job.id, job.attempt, outcome, seconds)
        if self._told is not None:
            self._told(outcome, seconds)
        return kept_up
