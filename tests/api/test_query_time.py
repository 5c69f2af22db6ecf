"""A query's time is one time: from the call to the answer, whoever else is asked and however the worker hangs."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from service.errors import Busy, TimedOut
from service.queries import client
from service.queries.client import Frame, QueryClient, QueryLimits

SECONDS = 4.0  # a process begins within it, on a busy machine too
# Reads requests and answers each after the seconds that it names.
STAND_IN = """
import sys, time
from service.queries.client import Frame, read_frame, write_frame
while (asked := read_frame(sys.stdin.buffer)) is not None:
    for request in asked.header["requests"]:
        time.sleep(request["sleep"])
        write_frame(sys.stdout.buffer, Frame({}))
"""


@pytest.fixture
def worker(monkeypatch: pytest.MonkeyPatch) -> Iterator[QueryClient]:
    """A worker whose queries are sleeps."""
    original = client.subprocess.Popen
    monkeypatch.setattr(
        client.subprocess, "Popen", lambda command, **how: original([command[0], "-c", STAND_IN], **how)
    )
    worker = QueryClient(QueryLimits(waiting=16, seconds=SECONDS, scenes=1, cache_bytes=0, encoder="minilm"))
    worker.start()
    yield worker
    worker.stop()


def ask(worker: QueryClient, sleep: float, **more: Any) -> Frame:
    return worker.call({"operation": "query", "sleep": sleep, **more})


def test_calls_that_wait_for_one_another_have_one_time_each(worker: QueryClient) -> None:
    ended: list[float] = []
    late: list[float] = []

    def run() -> None:
        begun = time.monotonic()
        try:
            ask(worker, 0.9 * SECONDS)
        except (TimedOut, Busy):
            late.append(time.monotonic() - begun)
        ended.append(time.monotonic() - begun)

    threads = [threading.Thread(target=run) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(ended) == 6 and late


def test_worker_that_reads_nothing_holds_the_turn_no_longer_than_a_call_may_take(worker: QueryClient) -> None:
    ask(worker, 0)
    process = worker._process
    assert process is not None
    os.kill(process.pid, signal.SIGSTOP)
    with pytest.raises(TimedOut):
        ask(worker, 0, padding="x" * 1_000_000)  # more than a pipe holds
    assert ask(worker, 0) == Frame({})
