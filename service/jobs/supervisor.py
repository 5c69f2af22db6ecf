"""The supervisor: takes queued jobs in order and runs each in a child process, some at the same time."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence

from service.child import fault_of
from service.errors import Crashed
from service.jobs.attempt import CHILD, Attempt
from service.jobs.leftovers import end_leftovers
from service.jobs.limits import JobLimits
from service.observe import working_for
from service.store.jobs import JobRecord
from service.store.store import Store

IDLE_SECONDS = 5.0  # a forgotten wake-up costs at most this
INSIST_SECONDS = 1.0  # between tries to note the end of a job

log = logging.getLogger(__name__)


class Supervisor:
    """Threads that own the running jobs, one each. Only they change a job after it was submitted or canceled."""

    def __init__(self, store: Store, limits: JobLimits, *, command: Sequence[str] = CHILD) -> None:
        self._store = store
        self._limits = limits
        self._command = command
        self._bell = threading.Condition()
        self._rung = 0
        self._stopping = threading.Event()
        self._told: Callable[[str, float], None] | None = None
        self._threads = [
            threading.Thread(target=self._loop, name=f"supervisor-{number}", daemon=True)
            for number in range(limits.parallel)
        ]

    def start(self) -> None:
        """End and put back what a dead server left running, then begin to take jobs."""
        found = end_leftovers(self._store.attempts.unfinished())
        if found:
            log.warning("ended %d processes that outlived their server", found)
        self._store.attempts.lose_all("the server died")
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
        while not self._stopping.is_set():
            rung = self._rung
            try:
                job = self._store.attempts.claim(self._limits.lease_seconds)
                if job is not None:
                    self._run(job)
                    continue
            except Exception:  # the thread must outlive a full disk or a locked database
                log.exception("the supervisor stumbled")
            self._rest(rung)

    def _rest(self, rung: int) -> None:
        """Wait for a ring of the bell after that one, for a stop, or for IDLE_SECONDS."""
        with self._bell:
            self._bell.wait_for(lambda: self._rung != rung or self._stopping.is_set(), IDLE_SECONDS)

    def _run(self, job: JobRecord) -> None:
        begun = time.monotonic()
        with working_for(job.request_id):
            log.info("job %s, attempt %d begins", job.id, job.attempt)
            try:
                Attempt(job, self._store, self._limits, self._command).run(self._stopping)
            except Exception:
                log.exception("job %s could not be run", job.id)
                error = Crashed("job", expected="a process that runs", got="an error of the server")
                self._insist(lambda: self._store.attempts.fail(job.id, job.attempt, fault_of(error)))
            outcome, seconds = self._store.attempts.state(job.id) or "deleted", time.monotonic() - begun
            log.info("job %s, attempt %d: %s after %.3f s", job.id, job.attempt, outcome, seconds)
        if self._told is not None:
            self._told(outcome, seconds)

    def _insist(self, note: Callable[[], None]) -> None:
        """Note the end of a job, however long the disk is full: else it would seem to run for ever."""
        while not self._stopping.is_set():
            try:
                note()
                return
            except Exception:
                log.exception("the end of a job could not be noted yet")
                self._stopping.wait(INSIST_SECONDS)
