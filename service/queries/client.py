"""The HTTP process's side of the query worker: a short line of calls, asked together, that outlive the worker."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import IO, Any

from liftcore.errors import SplatliftError
from service.child import error_of
from service.errors import Busy, Crashed, TimedOut

# Without these each array of a query is mapped anew and its pages are faulted in one by one: a fifth of its time.
MEMORY = {"MALLOC_MMAP_THRESHOLD_": str(64 << 20), "MALLOC_TRIM_THRESHOLD_": str(256 << 20)}

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Frame:
    """A message through the worker's pipes, with an optional picture or array: a line of JSON, then as many bytes as
    it says."""

    header: dict[str, Any]
    body: bytes = field(default=b"", repr=False)


def write_frame(out: IO[bytes], frame: Frame) -> None:
    """Send one message."""
    line = json.dumps({"bytes": len(frame.body), "header": frame.header}, allow_nan=False)
    out.write(line.encode() + b"\n")
    out.write(frame.body)
    out.flush()


def read_frame(source: IO[bytes]) -> Frame | None:
    """The next message, None when the other side is gone."""
    line = source.readline()
    if not line.endswith(b"\n"):
        return None
    message = json.loads(line)
    body = source.read(message["bytes"])
    return Frame(message["header"], body) if len(body) == message["bytes"] else None


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
    reply: Frame | SplatliftError | None = None


class QueryClient:
    """A process that answers queries, and the line in front of it; any thread may call any method.

    A thread of its own speaks with the process: calls that wait while others are answered are asked together, so that
    questions to one lift share a pass over its features.
    """

    def __init__(self, limits: QueryLimits) -> None:
        self._limits = limits
        self._bell = threading.Condition()  # guards all below but the process; rings when any of it changes
        self._line: list[_Call] = []
        self._places = limits.waiting
        self._wanted = True  # a process that nobody calls
        self._stopped = False
        self._process: subprocess.Popen[bytes] | None = None  # of the speaker, but for a look and a kill
        self._speaker = threading.Thread(target=self._speak, name="queries", daemon=True)
        self._told: Callable[[str, str, float], None] | None = None
        self._spawned = 0

    def start(self) -> None:
        """Start the process, so that the first query finds it warm."""
        self._speaker.start()
        with self._bell:
            self._bell.wait_for(lambda: not self._wanted)

    def stop(self) -> None:
        """End the process, and with it a query that still runs."""
        with self._bell:
            self._stopped = True
            self._bell.notify_all()
        process = self._process
        if process is not None:
            process.kill()
        if self._speaker.ident is not None:
            self._speaker.join()

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
        """Whether the process lives; when it does not, a new one starts."""
        if not self.alive():
            with self._bell:
                self._wanted = True
                self._bell.notify_all()
            return False
        return True

    def call(self, request: dict[str, Any]) -> Frame:
        """Ask the worker.

        Raises:
            SplatliftError: the worker's own error, as if raised here.
            Busy: too many calls are waiting, this one had no turn in its time, or the server stops.
            TimedOut: the answer took too long.
            Crashed: the worker died twice over this call, or failed with an error that is ours.
        """
        begun, outcome = time.monotonic(), "crashed"
        try:
            reply = self._reply_to(request)
            outcome = "answered"
        except SplatliftError as error:
            outcome = error.kind
            raise
        finally:
            if self._told is not None:
                self._told(request["operation"], outcome, time.monotonic() - begun)
        return reply

    def _reply_to(self, request: dict[str, Any]) -> Frame:
        call = _Call(request, time.monotonic() + self._limits.seconds)
        with self._bell:
            if self._stopped:
                raise _stops()
            if self._places == 0:
                raise self._busy()
            self._places -= 1
            self._line.append(call)
            self._bell.notify_all()
            try:
                if not self._bell.wait_for(lambda: call.reply is not None, self._limits.seconds):
                    if call in self._line:
                        self._line.remove(call)
                        raise self._busy()
                    self._bell.wait_for(lambda: call.reply is not None)  # it is asked, and its deadline is kept
            finally:
                self._places += 1
        reply = call.reply
        if isinstance(reply, SplatliftError):
            raise reply
        assert reply is not None
        if "fault" in reply.header:
            raise error_of(reply.header["fault"])
        if "crash" in reply.header:
            raise Crashed("query", expected="an answer", got="an error of the server")
        return reply

    def _busy(self) -> Busy:
        line = f"at most {self._limits.waiting} waiting queries"
        return Busy("query", expected=line, got="more", hint="try again soon")

    def _speak(self) -> None:
        """What the thread does until the stop: all that wait, then those that came meanwhile, and so on."""
        while True:
            with self._bell:
                self._bell.wait_for(lambda: self._line or self._wanted or self._stopped)
                calls, self._line = self._line, []
                if self._stopped:
                    break
            try:
                if not self.alive():
                    self._spawn()
                self._answer(calls)
            except Exception:  # the thread must outlive a machine without room for a process
                log.exception("the query worker could not be asked")
            finally:
                got = "a query process that died twice over it"
                self._settle(calls, Crashed("query", expected="an answer", got=got))
                with self._bell:
                    self._wanted = False
                    self._bell.notify_all()
        self._settle(calls, _stops())
        self._bury()

    def _answer(self, calls: list[_Call]) -> None:
        """Answer all of them together. When the process dies over that, those without an answer go one by one."""
        self._exchange(calls)
        for call in calls:
            if call.reply is None and not self._stopped:
                # It may have died while idle, so the first silence is no call's fault.
                log.error("the query worker died; a new one starts")
                self._spawn()
                self._exchange([call])

    def _exchange(self, calls: Sequence[_Call]) -> None:
        """Ask the process; a call without a reply is one over which it died, or one behind a call that took too long.

        Calls come in the order of their deadlines, so whoever waits for one has time left for those behind it.
        """
        late = [call for call in calls if call.deadline <= time.monotonic()]
        self._settle(late, self._late())
        calls = [call for call in calls if call.reply is None]
        process = self._process
        if not calls or process is None:
            return
        assert process.stdin is not None and process.stdout is not None
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
                self._settle([call], self._late())
                return
            if reply is None:
                return
            self._settle([call], reply)

    def _late(self) -> TimedOut:
        return TimedOut("query", expected=f"an answer within {self._limits.seconds:g} s", got="none yet")

    def _settle(self, calls: Sequence[_Call], reply: Frame | SplatliftError) -> None:
        """Give this reply to those that have none."""
        with self._bell:
            for call in calls:
                call.reply = call.reply or reply
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
        if self._stopped:  # whoever stopped us may have looked before there was a process
            self._process.kill()

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


def _stops() -> Busy:
    return Busy("query", expected="a running server", got="one that stops", hint="ask the next one")


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
