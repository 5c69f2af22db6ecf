"""The HTTP process's side of the query worker: few calls wait, are asked together, and survive the worker's death."""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from liftcore.errors import SplatliftError
from service.errors import Busy, Crashed, TimedOut
from service.faults import error_of
from service.queries.frames import Frame, read_frame, write_frame

# Without these each array of a query is mapped anew and its pages are faulted in one by one: a fifth of its time.
MEMORY = {"MALLOC_MMAP_THRESHOLD_": str(64 << 20), "MALLOC_TRIM_THRESHOLD_": str(256 << 20)}

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class QueryLimits:
    """What queries may take."""

    waiting: int  # calls that wait or run
    seconds: float  # from a call to its answer, however many are before it
    scenes: int  # lifts kept open
    cache_bytes: int  # of answers and views kept
    encoder: str  # specification of the text encoder that is loaded before it is asked for


@dataclass(eq=False)
class _Call:
    """A request in the line, and what became of it."""

    request: dict[str, Any]
    deadline: float  # of time.monotonic
    reply: Frame | SplatliftError | None = field(default=None)


class WarmWorker:
    """A process that answers queries, and the line in front of it; any thread may call any method.

    Calls that wait while others are answered are asked together, so that questions to one lift share a pass over its
    features. The thread of one of them speaks for all: it has the turn.
    """

    def __init__(self, limits: QueryLimits) -> None:
        self._limits = limits
        self._bell = threading.Condition()  # guards the next three; rings at each reply and at the end of each turn
        self._places = limits.waiting
        self._line: list[_Call] = []
        self._taken = False  # whether a thread has the turn, and with it the process
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = False
        self._told: Callable[[str, str, float], None] | None = None
        self._spawned = 0

    def start(self) -> None:
        """Start the process, so that the first query finds it warm."""
        with self._turn():
            self._spawn()

    def stop(self) -> None:
        """End the process."""
        self._stopped = True
        process = self._process
        if process is not None:
            process.kill()  # a query that still runs ends with it, and lets go of its turn
        with self._turn():
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
        with self._bell:
            if self.alive() or self._stopped or self._taken:
                return self.alive()
            self._taken = True
        with self._turn(taken=True):
            self._spawn()
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
            Busy: too many calls are waiting, or this one had no turn in its time.
            TimedOut: the answer took too long.
            Crashed: the worker died twice over this call, or failed with an error that is ours.
        """
        call = _Call(request, time.monotonic() + self._limits.seconds)
        with self._place():
            if not self._answered_by_another(call):
                with self._turn(taken=True):
                    self._answer(self._waiting())
        if isinstance(call.reply, SplatliftError):
            raise call.reply
        assert call.reply is not None
        if "fault" in call.reply.header:
            raise error_of(call.reply.header["fault"])
        if "crash" in call.reply.header:
            raise Crashed("query", expected="an answer", got="an error of the server")
        return call.reply

    def _busy(self) -> Busy:
        line = f"at most {self._limits.waiting} waiting queries"
        return Busy("query", expected=line, got="more", hint="try again soon")

    @contextlib.contextmanager
    def _place(self) -> Iterator[None]:
        """A place in the line."""
        with self._bell:
            if self._places == 0:
                raise self._busy()
            self._places -= 1
        try:
            yield
        finally:
            with self._bell:
                self._places += 1

    def _answered_by_another(self, call: _Call) -> bool:
        """Wait for the reply, or else for the turn; whether it is the reply that came."""
        with self._bell:
            self._line.append(call)
            come = self._bell.wait_for(lambda: call.reply is not None or not self._taken, self._limits.seconds)
            if not come and call in self._line:
                self._line.remove(call)
                raise self._busy()
            # No longer than its time: the one who has the turn asks for it, and keeps its deadline.
            self._bell.wait_for(lambda: call.reply is not None or not self._taken)
            if call.reply is None:
                self._taken = True
            return call.reply is not None

    @contextlib.contextmanager
    def _turn(self, *, taken: bool = False) -> Iterator[None]:
        """The turn, to be let go at the end."""
        if not taken:
            with self._bell:
                self._bell.wait_for(lambda: not self._taken)
                self._taken = True
        try:
            yield
        finally:
            with self._bell:
                self._taken = False
                self._bell.notify_all()

    def _waiting(self) -> list[_Call]:
        with self._bell:
            calls, self._line = self._line, []
        return calls

    def _answer(self, calls: list[_Call]) -> None:
        """Answer all of them together. When the process dies over that, those without an answer go one by one."""
        try:
            self._exchange(calls)
            for call in calls:
                if call.reply is None:  # it may have died while idle, so the first silence is no call's fault
                    log.error("the query worker died; a new one starts")
                    self._bury()
                    self._exchange([call])
        finally:
            for call in calls:
                if call.reply is None:
                    got = "a query process that died twice over it"
                    self._reply(call, Crashed("query", expected="an answer", got=got))

    def _exchange(self, calls: Sequence[_Call]) -> None:
        """Ask the process; a call without a reply is one over which it died, or one behind a call that took too long.

        Calls come in the order of their deadlines, so whoever waits for one has time left for those behind it.
        """
        if self._stopped:
            stops = Busy("query", expected="a running server", got="one that stops", hint="ask the next one")
            for call in calls:
                self._reply(call, stops)
            return
        for call in calls:
            if call.deadline <= time.monotonic():
                self._reply(call, self._late())
        calls = [call for call in calls if call.reply is None]
        if not calls:
            return
        if self._process is None or self._process.poll() is not None:
            self._spawn()
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        unsent: Frame | None = Frame({"requests": [call.request for call in calls]})
        for call in calls:
            reply = None
            with _ended_at(call.deadline, process) as expired, contextlib.suppress(BrokenPipeError):
                if unsent is not None:
                    write_frame(process.stdin, unsent)  # a process that is stopped does not read it
                    unsent = None
                reply = read_frame(process.stdout)
            if expired.is_set():
                self._bury()
                self._reply(call, self._late())
                return
            if reply is None:
                return
            self._reply(call, reply)

    def _late(self) -> TimedOut:
        return TimedOut("query", expected=f"an answer within {self._limits.seconds:g} s", got="none yet")

    def _reply(self, call: _Call, reply: Frame | SplatliftError) -> None:
        with self._bell:
            call.reply = reply
            self._bell.notify_all()

    def _spawn(self) -> None:
        self._bury()
        command = [sys.executable, "-m", "service.queries.worker"]
        command += [str(self._limits.scenes), str(self._limits.cache_bytes), self._limits.encoder]
        self._spawned += 1
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            env=MEMORY | os.environ,
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


@contextlib.contextmanager
def _ended_at(deadline: float, process: subprocess.Popen[bytes]) -> Iterator[threading.Event]:
    """Kill the process when the block still runs at its deadline; the event says whether that came."""
    expired = threading.Event()

    def expire() -> None:
        expired.set()
        process.kill()

    timer = threading.Timer(max(0.0, deadline - time.monotonic()), expire)
    timer.start()
    try:
        yield expired
    finally:
        timer.cancel()
        timer.join()
