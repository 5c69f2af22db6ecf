"""The query process, from the HTTP process: callers take turns; one that dies or is late is started again."""

from __future__ import annotations

import json
import logging
import threading
import time
from contextlib import suppress
from typing import Any

from service.errors import Busy, Fault, ProcessDied, TimedOut
from service.process import Child

WAITING = 16  # calls that wait or run
TRIES = 3  # of a call whose process is killed
# Without the first two, each array of a query is mapped again and its pages fault one by one: a fifth of its time.
# A query is many small operations, each of which would wait for its library's threads to synchronise.
ENVIRONMENT = {
    "MALLOC_MMAP_THRESHOLD_": str(64 << 20), "MALLOC_TRIM_THRESHOLD_": str(256 << 20),
    "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
}  # fmt: skip

log = logging.getLogger(__name__)


class QueryClient:
    """Process that answers queries, one at a time; any thread may call any method.

    A request is a JSON line, and so is its answer, with the content behind it (`service.query_worker`). The seconds
    are from a call to its answer, with the time in the queue.
    """

    def __init__(self, encoder: str, seconds: float) -> None:
        self._encoder, self._seconds = encoder, seconds
        self._turn, self._places = threading.Lock(), threading.Semaphore(WAITING)
        self._is_stopped, self.starts, self.calls = False, 0, 0
        self._child = self._start()

    def _start(self) -> Child:
        self.starts += 1
        return Child("service.query_worker", self._encoder, **ENVIRONMENT)

    def revive(self) -> bool:
        """Return True if the process lives; else start a new one, unless a call is about to."""
        if self._child.is_alive():
            return True
        if self._turn.acquire(blocking=False):
            try:
                self._restart()
            finally:
                self._turn.release()
        return False

    def stop(self) -> None:
        """End the process and its query; waiting calls are refused."""
        self._is_stopped = True
        self._child.end()
        with self._turn:
            self._child.end()
            self._child.close()

    def call(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send a request to the worker; return its answer: a ``value``, or the ``content``, empty if it is a file."""
        deadline = time.monotonic() + self._seconds
        self.calls += 1
        if not self._places.acquire(blocking=False):
            raise Busy("query", expected=f"at most {WAITING} waiting queries", got="more", hint="try again soon")
        try:
            if not self._turn.acquire(timeout=self._seconds):
                raise Busy("query", expected="a turn in time", got="none", hint="try again soon")
            try:
                return self._ask(json.dumps(request, allow_nan=False).encode() + b"\n", deadline)
            finally:
                self._turn.release()
        finally:
            self._places.release()

    def _restart(self) -> None:
        if self._is_stopped:
            raise Busy("query", expected="a running server", got="one that stops", hint="ask the next one")
        self._child.end()
        self._child.close()
        try:
            self._child = self._start()
        except OSError as error:
            got = f"none: {error.strerror}"
            raise Busy("query", expected="room for a process", got=got, hint="try again soon") from None

    def _ask(self, line: bytes, deadline: float) -> dict[str, Any]:
        for _ in range(TRIES):  # it may have been killed while idle, which is not the fault of this call
            if self._is_stopped or not self._child.is_alive():
                self._restart()
            answer = self._exchange(line, deadline)
            if answer is not None:
                if "crash" in answer:
                    raise ProcessDied("query", expected="an answer", got="an error of the server")
                if "fault" in answer:
                    raise Fault(answer["fault"])
                return answer
            if time.monotonic() >= deadline:
                raise TimedOut("query", expected=f"an answer within {self._seconds:g} s", got="none yet")
            log.warning("the query process ended; a new one starts")
        raise Busy("query", expected="a process that answers", got="one that was ended", hint="try again soon")

    def _exchange(self, line: bytes, deadline: float) -> dict[str, Any] | None:
        """Return the answer of the process; None if it died, or was ended at the deadline."""
        child = self._child
        with child.watched(lambda: "it is late" if time.monotonic() > deadline else ""), suppress(OSError):
            child.input.write(line)
            child.input.flush()
            header = child.output.readline()
            if header.endswith(b"\n"):
                answer = json.loads(header)
                count = answer.get("bytes", 0)
                content = child.output.read(count)
                if len(content) == count:
                    return answer | {"content": content}
        child.end()
        return None
