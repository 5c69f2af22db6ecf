"""The query process, from the HTTP process: a child whose callers take turns."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

from service.errors import Busy, InvalidRequest, OutOfTime, ProcessDied, TimedOut
from service.process import Children

WAITING = 16  # calls that wait or run
# Without these, each array of a query is mapped again and its pages fault one by one: a fifth of its time.
ENVIRONMENT = {"MALLOC_MMAP_THRESHOLD_": str(64 << 20), "MALLOC_TRIM_THRESHOLD_": str(256 << 20)}


class QueryClient(Children):
    """Process that answers queries, one at a time; any thread may call.

    The seconds are from a call to its answer, with the time in the queue. One thread: a query is many small
    operations, each of which would wait for its library's threads to synchronise.
    """

    def __init__(self, encoder: str, seconds: float) -> None:
        super().__init__(1, "service.query_worker", encoder, orders=math.inf, **ENVIRONMENT)
        self._seconds, self._turn, self._places = seconds, threading.Lock(), threading.Semaphore(WAITING)
        self.calls = 0

    def call(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send a request to `service.query_worker`; return its answer."""
        deadline = time.monotonic() + self._seconds
        self.calls += 1
        if not self._places.acquire(blocking=False):
            raise Busy("query", expected=f"at most {WAITING} waiting queries", got="more", hint="try again soon")
        try:
            if not self._turn.acquire(timeout=self._seconds):
                raise Busy("query", expected="a turn in time", got="none", hint="try again soon")
            try:
                return self.result_of(request, deadline - time.monotonic(), "query")
            finally:
                self._turn.release()
        except OutOfTime:
            expected = f"an answer within {self._seconds:g} s"
            raise TimedOut("query", expected=expected, got="none yet") from None
        except InvalidRequest:
            raise ProcessDied("query", expected="an answer", got="an error of the server") from None
        finally:
            self._places.release()
