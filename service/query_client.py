"""The HTTP process's side of the query worker: turns at one process that keys share fairly, and that outlive it."""

from __future__ import annotations

import itertools
import json
import logging
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from liftcore.errors import SplatliftError
from service.child import ONE_THREAD, error_of, is_stopped
from service.errors import ClientDisconnected, ProcessDied, ServiceUnavailable, TimedOut, require_share

# Without the first two each array of a query is mapped anew and its pages are faulted in one by one: a fifth of its
# time. A query is a row of small operations, each of which would wait for a team of threads of its library to meet,
# late beside a lift: more than half of its time. The kernels bring threads of their own.
ENVIRONMENT = {
    "MALLOC_MMAP_THRESHOLD_": str(64 << 20), "MALLOC_TRIM_THRESHOLD_": str(256 << 20), **ONE_THREAD
}  # fmt: skip
STDERR = 2  # where what libraries of the worker print goes
PIPE_BYTES = 256 << 10  # of an answer; the HTTP process holds it in memory while a client reads it: more is a file
AHEAD_BYTES = 1 << 20  # of requests that are sent along with the one before them

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Frame:
    """An answer of the worker: what is told of it, with an optional picture or array."""

    header: dict[str, Any]
    body: bytes = field(default=b"", repr=False)


def send_frame(worker: Connection, frame: Frame) -> None:
    """Send an answer, as the worker does; it gets requests as a JSON list."""
    worker.send_bytes(json.dumps(frame.header, allow_nan=False).encode())
    worker.send_bytes(frame.body)


@dataclass(frozen=True)
class QueryLimits:
    """What queries may take."""

    waiting: int  # calls that wait or run
    seconds: float  # from a call to its answer, however many are before it
    scenes: int  # lifts kept open
    cache_bytes: int  # of answers and views kept
    encoder: str  # specification of the text encoder that is loaded before it is asked for
    of_a_key: int | None = None  # calls of one key that wait or run; never so many that it has all places


@dataclass(eq=False)
class Waiter:
    """Who asks, and whether they still wait for the answer."""

    key: str = ""  # the id of a key; empty while there are none: then all share one line
    disconnected: bool = False


@dataclass(eq=False)
class _Call:
    """A request in the line."""

    line: bytes  # the request as JSON
    waiter: Waiter
    deadline: float  # of time.monotonic


class QueryClient:
    """A process that answers queries, and the line in front of it; any thread may call any method.

    Callers take turns at the process, each key in its turn and within a key the oldest first. What waits is sent
    along with each call, so that questions to one lift share a pass over its features. Who leaves the line before its
    turn is not answered.
    """

    def __init__(self, limits: QueryLimits) -> None:
        self._limits = limits
        self._condition = threading.Condition()  # guards all below but the process; notified when any of it changes
        self._line: list[_Call] = []
        self._busy_with: object | None = None  # the call that speaks with the process, or whoever revives it
        self._turns: dict[str, int] = {}  # key -> the number of its last turn
        self._stopped = False
        self._process: subprocess.Popen[bytes] | None = None  # of whose turn it is, but for a look and a kill
        self._worker: Connection | None = None  # to it, likewise
        self._cuda: dict[str, Any] | None = None  # what the worker says of the device
        self._callback: Callable[[str, str, float], None] | None = None
        self._spawned = 0

    def start(self) -> None:
        """Start the process, so that the first query finds it warm."""
        self.revive()

    def stop(self) -> None:
        """End the process, and with it a query that still runs; those that wait are told to ask elsewhere."""
        with self._condition:
            self._stopped = True
            self._condition.notify_all()
            process = self._process
            if process is not None:
                process.kill()
            self._condition.wait_for(lambda: self._busy_with is None and not self._line)
        self._reap()

    def on_call_finished(self, callback: Callable[[str, str, float], None]) -> None:
        """Call this after each call, with its operation, what came of it and the seconds that it took."""
        self._callback = callback

    @property
    def restarts(self) -> int:
        """Processes after the first."""
        return max(0, self._spawned - 1)

    @property
    def waiting(self) -> int:
        """Calls that wait for their turn."""
        return len(self._line)

    def alive(self) -> bool:
        """Whether the process lives, and is not stopped."""
        process = self._process
        return process is not None and process.poll() is None and not is_stopped(process.pid)

    def revive(self) -> bool:
        """Whether the process lives; when it does not, a new one starts."""
        if self.alive():
            return True
        with self._condition:
            if self._busy_with is not None or self._stopped:
                return False  # whoever speaks with it will see
            self._busy_with = self
        try:
            self._spawn()
        except OSError:  # a machine without room for a process; whoever asks next tries again
            log.exception("the query worker could not be started")
        finally:
            self._end_turn()
        return False

    def cancel(self, waiter: Waiter) -> None:
        """Say that nobody waits for the answers of this one any more. Never waits."""
        waiter.disconnected = True
        with self._condition:
            self._condition.notify_all()

    def call(self, request: dict[str, Any], waiter: Waiter | None = None) -> Frame:
        """Ask the worker.

        Args:
            request: what is asked, as JSON takes it.
            waiter: for whom.

        Raises:
            SplatliftError: the worker's own error, as if raised here.
            ServiceUnavailable: too many calls are waiting, this one had no turn in its time, or the server stops.
            KeyLimitReached: too many of them are of this key.
            TimedOut: the answer took too long.
            ClientDisconnected: nobody waits for it.
            ProcessDied: the worker died twice over this call, or failed with an error that is ours.
        """
        start, outcome = time.monotonic(), "crashed"
        call = _Call(json.dumps(request, allow_nan=False).encode(), waiter or Waiter(), start + self._limits.seconds)
        try:
            ahead = self._wait_for_turn(call)
            try:
                reply = self._ask(call, ahead)
            finally:
                self._end_turn()
            if "fault" in reply.header:
                raise error_of(reply.header["fault"])
            if "crash" in reply.header:
                raise ProcessDied("query", expected="an answer", got="an error of the server")
            outcome = "answered"
        except SplatliftError as error:
            outcome = error.kind
            raise
        finally:
            if self._callback is not None:
                self._callback(request["operation"], outcome, time.monotonic() - start)
        return reply

    def require_device(self, device: str) -> None:
        """Refuse a device that is not there; ``auto`` and ``cpu`` always are.

        The worker looks, once, as this process never loads torch. When it cannot be asked the device is let through:
        the job looks again, and fails in the same words.

        Raises:
            Unavailable: what is missing, as the lift would say it.
        """
        if device != "cuda":
            return
        if self._cuda is None:
            try:
                self._cuda = self.call({"operation": "device", "device": device}).header
            except (ServiceUnavailable, TimedOut, ProcessDied):
                return
        if self._cuda["lack"] is not None:
            raise error_of(self._cuda["lack"])

    def _wait_for_turn(self, call: _Call) -> list[bytes]:
        """Wait until nobody is to be asked before this call; what waits behind it."""
        with self._condition:
            self._require_place(call.waiter.key)
            self._line.append(call)
            try:
                self._condition.wait_for(
                    lambda: self._stopped or call.waiter.disconnected or self._next() is call,
                    _remaining_seconds(call),
                )
                came = not self._stopped and self._next() is call
            finally:
                self._line.remove(call)
                self._condition.notify_all()
            if self._stopped:
                raise ServiceUnavailable(
                    "query", expected="a running server", got="one that stops", hint="ask the next one"
                )
            if call.waiter.disconnected:
                raise ClientDisconnected("query", expected="a client that waits for its turn", got="one that left")
            if not came:
                raise self._busy()
            self._busy_with = call
            self._turns[call.waiter.key] = 1 + max(self._turns.values(), default=0)
            return [other.line for other in self._line if not other.waiter.disconnected]

    def _end_turn(self) -> None:
        with self._condition:
            self._busy_with = None
            self._condition.notify_all()

    def _next(self) -> _Call | None:
        """Whose turn it is: the oldest call of the key that had its last turn before all others."""
        if self._busy_with is not None:
            return None
        waiting = (call for call in self._line if not call.waiter.disconnected)
        return min(waiting, key=lambda call: self._turns.get(call.waiter.key, 0), default=None)

    def _require_place(self, key: str) -> None:
        speaking = self._busy_with if isinstance(self._busy_with, _Call) else None
        calls = [*self._line, *([] if speaking is None else [speaking])]
        if self._stopped or len(calls) >= self._limits.waiting:
            raise self._busy()
        limit = self._limits.of_a_key
        if key and limit is not None:  # with one place in all there are no shares
            limit = max(1, min(limit, self._limits.waiting - 1))
            require_share("query", sum(call.waiter.key == key for call in calls), limit)

    def _busy(self) -> ServiceUnavailable:
        line = f"at most {self._limits.waiting} waiting queries"
        return ServiceUnavailable("query", expected=line, got="more", hint="try again soon")

    def _ask(self, call: _Call, ahead: list[bytes]) -> Frame:
        """Ask the process; when it dies over that, a new one."""
        for _ in range(2):  # it may have died while idle, so the first silence is no call's fault
            if not self.alive():
                self._spawn()
            reply = self._exchange(call, ahead)
            if reply is not None:
                return reply
            if self._stopped:
                raise ServiceUnavailable(
                    "query", expected="a running server", got="one that stops", hint="ask the next one"
                )
            log.error("the query worker died; a new one starts")
            self._spawn()
            ahead = []
        raise ProcessDied("query", expected="an answer", got="a query process that died twice over it")

    def _exchange(self, call: _Call, ahead: list[bytes]) -> Frame | None:
        """What the process says, None when it dies.

        Raises:
            TimedOut: it takes too long; a new one starts.
        """
        process, worker = self._process, self._worker
        assert process is not None and worker is not None
        sizes = itertools.accumulate(map(len, ahead))
        lines = [call.line, *(line for line, size in zip(ahead, sizes, strict=True) if size <= AHEAD_BYTES)]
        deadline = threading.Timer(
            _remaining_seconds(call), process.kill
        )  # it may be stopped, and neither read nor write
        deadline.start()
        try:
            worker.send_bytes(b"[" + b", ".join(lines) + b"]")
            return Frame(json.loads(worker.recv_bytes()), worker.recv_bytes())
        except (EOFError, OSError):
            if _remaining_seconds(call):
                return None
        finally:
            deadline.cancel()
            deadline.join()
        self._spawn()
        raise TimedOut("query", expected=f"an answer within {self._limits.seconds:g} s", got="none yet")

    def _spawn(self) -> None:
        self._reap()
        near_end, far_end = socket.socketpair()
        command = [sys.executable, "-m", "service.query_worker", str(far_end.fileno())]
        command += [str(self._limits.scenes), str(self._limits.cache_bytes), self._limits.encoder]
        self._spawned += 1
        with near_end, far_end:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=STDERR, pass_fds=[far_end.fileno()], start_new_session=True,
                env=ENVIRONMENT | os.environ,
            )  # fmt: skip
            self._worker = Connection(near_end.detach())
        if self._stopped:  # whoever stopped us may have looked before there was a process
            self._process.kill()

    def _reap(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.communicate()  # closes its lifeline, and waits
        if self._worker is not None:
            self._worker.close()
            self._worker = None


def _remaining_seconds(call: _Call) -> float:
    return max(0.0, call.deadline - time.monotonic())
