"""The HTTP process's side of the query worker: one call at a time, few waiting, restarted when it dies."""

from __future__ import annotations

import contextlib
import logging
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from liftcore.errors import SplatliftError
from service.errors import Busy, Crashed, TimedOut
from service.faults import error_of
from service.queries.frames import Frame, read_frame, write_frame

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class QueryLimits:
    """What queries may take."""

    waiting: int  # calls that wait or run
    seconds: float  # of one call, waiting included
    scenes: int  # lifts kept open
    answers: int  # answers kept
    encoder: str  # specification of the text encoder that is loaded before it is asked for


class WarmWorker:
    """A process that answers queries, and the line in front of it; any thread may call any method."""

    def __init__(self, limits: QueryLimits) -> None:
        self._limits = limits
        self._line = threading.BoundedSemaphore(limits.waiting)
        self._turn = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = False
        self._told: Callable[[str, str, float], None] | None = None
        self._spawned = 0

    def start(self) -> None:
        """Start the process, so that the first query finds it warm."""
        with self._turn:
            self._spawn()

    def stop(self) -> None:
        """End the process."""
        self._stopped = True
        process = self._process
        if process is not None:
            process.kill()  # a query that still runs ends with it, and lets go of its turn
        with self._turn:
            self._bury()

    def tell(self, told: Callable[[str, str, float], None]) -> None:
        """Call this after each call, with its operation, what came of it and the seconds that it took."""
        self._told = told

    @property
    def restarts(self) -> int:
        """Processes after the first."""
        return max(0, self._spawned - 1)

    def alive(self) -> bool:
        """Whether the process lives."""
        process = self._process
        return process is not None and process.poll() is None

    def revive(self) -> bool:
        """Whether the process lives; when it does not, and no call is about to see to it, a new one starts."""
        if self.alive() or self._stopped or not self._turn.acquire(blocking=False):
            return self.alive()
        try:
            self._spawn()
        finally:
            self._turn.release()
        return False

    def call(self, request: dict[str, Any]) -> Frame:
        """Ask the worker, and tell what came of it.

        Raises:
            SplatliftError: as `_call` does.
        """
        begun, outcome = time.monotonic(), "crashed"
        try:
            reply = self._call(request)
            outcome = "answered"
        except SplatliftError as error:
            outcome = error.kind
            raise
        finally:
            if self._told is not None:
                self._told(request["operation"], outcome, time.monotonic() - begun)
        return reply

    def _call(self, request: dict[str, Any]) -> Frame:
        """Ask the worker.

        Raises:
            SplatliftError: the worker's own error, as if raised here.
            Busy: too many calls are waiting, or this one waited too long.
            TimedOut: the answer took too long.
            Crashed: the worker died twice over this call, or failed with an error that is ours.
        """
        with self._place():
            reply = self._ask(request)
        if "fault" in reply.header:
            raise error_of(reply.header["fault"])
        if "crash" in reply.header:
            raise Crashed("query", expected="an answer", got="an error of the server")
        return reply

    @contextlib.contextmanager
    def _place(self) -> Iterator[None]:
        """A place in the line, then the turn."""
        line = f"at most {self._limits.waiting} waiting queries"
        busy = Busy("query", expected=line, got="more", hint="try again soon")
        if not self._line.acquire(blocking=False):
            raise busy
        try:
            if not self._turn.acquire(timeout=self._limits.seconds):
                raise busy
            try:
                yield
            finally:
                self._turn.release()
        finally:
            self._line.release()

    def _ask(self, request: dict[str, Any]) -> Frame:
        for _ in range(2):  # it may have died while idle, so the first silence is not the request's fault
            if self._stopped:
                raise Busy("query", expected="a running server", got="one that stops", hint="ask the next one")
            reply = self._exchange(request)
            if reply is not None:
                return reply
            log.error("the query worker died; a new one starts")
            self._bury()
        raise Crashed("query", expected="an answer", got="a query process that died twice over it")

    def _exchange(self, request: dict[str, Any]) -> Frame | None:
        if self._process is None or self._process.poll() is not None:
            self._spawn()
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        expired = threading.Event()

        def expire() -> None:
            expired.set()
            process.kill()

        timer = threading.Timer(self._limits.seconds, expire)
        timer.start()
        try:
            write_frame(process.stdin, Frame(request))
            reply = read_frame(process.stdout)
        except BrokenPipeError:
            reply = None
        finally:
            timer.cancel()
            timer.join()
        if expired.is_set():
            self._bury()
            raise TimedOut("query", expected=f"an answer within {self._limits.seconds:g} s", got="none yet")
        return reply

    def _spawn(self) -> None:
        self._bury()
        command = [sys.executable, "-m", "service.queries.worker"]
        command += [str(self._limits.scenes), str(self._limits.answers), self._limits.encoder]
        self._spawned += 1
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )

    def _bury(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
