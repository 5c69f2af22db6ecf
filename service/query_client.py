"""Client of the query process, for the HTTP process: a queue with fair turns between keys; restarts the process."""

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

# Without the first two, each array of a query is mapped again and its pages fault one by one: a fifth of its time.
# A query is many small operations, each of which would wait for its library's threads to synchronise; beside a lift
# that took more than half of its time. The kernels have threads of their own.
ENVIRONMENT = {
    "MALLOC_MMAP_THRESHOLD_": str(64 << 20), "MALLOC_TRIM_THRESHOLD_": str(256 << 20), **ONE_THREAD
}  # fmt: skip
STDERR = 2  # for the output of the worker's libraries
PIPE_BYTES = 256 << 10  # of an answer, which the HTTP process holds in memory; larger ones go to a file
AHEAD_BYTES = 1 << 20  # of later requests that are sent with the current one

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Frame:
    """Answer of the worker: a JSON header, with an optional picture or array."""

    header: dict[str, Any]
    body: bytes = field(default=b"", repr=False)


def send_frame(worker: Connection, frame: Frame) -> None:
    """Send an answer, from the worker; requests come as a JSON list."""
    worker.send_bytes(json.dumps(frame.header, allow_nan=False).encode())
    worker.send_bytes(frame.body)


@dataclass(frozen=True)
class QueryLimits:
    """Limits of queries."""

    waiting: int  # calls that wait or run
    seconds: float  # from a call to its answer, with the time in the queue
    scenes: int  # open lifts
    cache_bytes: int  # of cached answers and views
    encoder: str  # specification of the text encoder that is loaded at the start
    of_a_key: int | None = None  # calls of one key that wait or run; always fewer than `waiting`


@dataclass(eq=False)
class Waiter:
    """Client of a call: its key, and whether it is still connected."""

    key: str = ""  # the id of a key; empty while there are no keys: all calls share one queue
    disconnected: bool = False


@dataclass(eq=False)
class _Call:
    """A request in the queue."""

    line: bytes  # the request as JSON
    waiter: Waiter
    deadline: float  # of time.monotonic


class QueryClient:
    """Process that answers queries, with a queue; any thread may call any method.

    Callers take turns at the process, each key in its turn and within a key the oldest first. What waits is sent
    along with each call, so that questions to one lift share a pass over its features. Who leaves the line before its
    turn is not answered.
    """

    def __init__(self, limits: QueryLimits) -> None:
        self._limits = limits
        self._condition = threading.Condition()  # guards everything below except the process; notified of each change
        self._line: list[_Call] = []
        self._busy_with: object | None = None  # the call that uses the process, or this client while it restarts it
        self._turns: dict[str, int] = {}  # key -> the number of its last turn
        self._is_stopped = False
        self._process: subprocess.Popen[bytes] | None = None  # used by the current call; others poll or kill it
        self._worker: Connection | None = None  # likewise
        self._cuda: dict[str, Any] | None = None  # the device, as the worker reports it
        self._callback: Callable[[str, str, float], None] | None = None
        self._spawned = 0

    def start(self) -> None:
        """Start the process, so that the first query finds it ready."""
        self.revive()

    def stop(self) -> None:
        """End the process and its current query; waiting calls are refused."""
        with self._condition:
            self._is_stopped = True
            self._condition.notify_all()
            process = self._process
            if process is not None:
                process.kill()
            self._condition.wait_for(lambda: self._busy_with is None and not self._line)
        self._reap()

    def on_call_finished(self, callback: Callable[[str, str, float], None]) -> None:
        """Call `callback` after each call, with its operation, outcome and seconds."""
        self._callback = callback

    @property
    def restarts(self) -> int:
        """Processes started after the first one."""
        return max(0, self._spawned - 1)

    @property
    def waiting(self) -> int:
        """Calls in the queue."""
        return len(self._line)

    def alive(self) -> bool:
        """Return True if the process lives and is not stopped."""
        process = self._process
        return process is not None and process.poll() is None and not is_stopped(process.pid)

    def revive(self) -> bool:
        """Return True if the process lives; else start a new one."""
        if self.alive():
            return True
        with self._condition:
            if self._busy_with is not None or self._is_stopped:
                return False  # the call that uses it will notice
            self._busy_with = self
        try:
            self._spawn()
        except OSError:  # no room for a process; the next call tries again
            log.exception("the query worker could not be started")
        finally:
            self._end_turn()
        return False

    def cancel(self, waiter: Waiter) -> None:
        """Note that the client no longer waits for an answer. Does not block."""
        waiter.disconnected = True
        with self._condition:
            self._condition.notify_all()

    def call(self, request: dict[str, Any], waiter: Waiter | None = None) -> Frame:
        """Send a request to the worker and return its answer.

        Args:
            request: JSON values.
            waiter: for whom.

        Raises:
            SplatliftError: the worker's own error, as if raised here.
            ServiceUnavailable: too many calls are waiting, this one had no turn in its time, or the server stops.
            KeyLimitReached: too many of them are of this key.
            TimedOut: the answer took too long.
            ClientDisconnected: all clients that waited have left.
            ProcessDied: the worker died twice over this call, or failed with an error that is ours.
        """
        start, outcome = time.monotonic(), "crashed"
        call = _Call(json.dumps(request, allow_nan=False).encode(), waiter or Waiter(), start + self._limits.seconds)
        try:
            lookahead = self._wait_for_turn(call)
            try:
                reply = self._ask(call, lookahead)
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
        """Refuse a device that is not available; ``auto`` and ``cpu`` always are.

        The worker looks, once, as this process never loads torch. If it cannot run, the device is accepted:
        the job looks again, and fails in the same words.

        Raises:
            Unavailable: something is missing, as in a lift.
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
        """Wait for the call's turn; return the requests behind it in the queue."""
        with self._condition:
            self._require_place(call.waiter.key)
            self._line.append(call)
            try:
                self._condition.wait_for(
                    lambda: self._is_stopped or call.waiter.disconnected or self._next() is call,
                    _remaining_seconds(call),
                )
                came = not self._is_stopped and self._next() is call
            finally:
                self._line.remove(call)
                self._condition.notify_all()
            if self._is_stopped:
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
        """Return the next call: the oldest of the key whose last turn is longest ago."""
        if self._busy_with is not None:
            return None
        waiting = (call for call in self._line if not call.waiter.disconnected)
        return min(waiting, key=lambda call: self._turns.get(call.waiter.key, 0), default=None)

    def _require_place(self, key: str) -> None:
        speaking = self._busy_with if isinstance(self._busy_with, _Call) else None
        calls = [*self._line, *([] if speaking is None else [speaking])]
        if self._is_stopped or len(calls) >= self._limits.waiting:
            raise self._busy()
        limit = self._limits.of_a_key
        if key and limit is not None:  # with one place in all there is nothing to share
            limit = max(1, min(limit, self._limits.waiting - 1))
            require_share("query", sum(call.waiter.key == key for call in calls), limit)

    def _busy(self) -> ServiceUnavailable:
        line = f"at most {self._limits.waiting} waiting queries"
        return ServiceUnavailable("query", expected=line, got="more", hint="try again soon")

    def _ask(self, call: _Call, lookahead: list[bytes]) -> Frame:
        """Send the request to the process; restart the process once if it dies."""
        for _ in range(2):  # it may have died while idle, which is not the fault of this call
            if not self.alive():
                self._spawn()
            reply = self._exchange(call, lookahead)
            if reply is not None:
                return reply
            if self._is_stopped:
                raise ServiceUnavailable(
                    "query", expected="a running server", got="one that stops", hint="ask the next one"
                )
            log.error("the query worker died; a new one starts")
            self._spawn()
            lookahead = []
        raise ProcessDied("query", expected="an answer", got="a query process that died twice over it")

    def _exchange(self, call: _Call, lookahead: list[bytes]) -> Frame | None:
        """Return the process' answer; None if it dies.

        Raises:
            TimedOut: it takes too long; a new one starts.
        """
        process, worker = self._process, self._worker
        assert process is not None and worker is not None
        sizes = itertools.accumulate(map(len, lookahead))
        lines = [call.line, *(line for line, size in zip(lookahead, sizes, strict=True) if size <= AHEAD_BYTES)]
        # A stopped process neither reads nor writes.
        deadline = threading.Timer(_remaining_seconds(call), process.kill)
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
        if self._is_stopped:  # the stop may have come before there was a process
            self._process.kill()

    def _reap(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.communicate()  # this closes its lifeline and waits for it
        if self._worker is not None:
            self._worker.close()
            self._worker = None


def _remaining_seconds(call: _Call) -> float:
    return max(0.0, call.deadline - time.monotonic())
