"""What a job's process prints is part of the server's log, however it is printed."""

from __future__ import annotations

import io
import json
import logging
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest

from service.jobs.process import LONGEST
from service.observe import JsonLines
from service.store.owners import SERVICE
from service.store.store import Store

from .conftest import Supervising, ended, order


class Slow(logging.StreamHandler[io.StringIO]):
    """A log that takes its time, as on a busy disk."""

    def emit(self, record: logging.LogRecord) -> None:
        time.sleep(0.02)
        super().emit(record)


@pytest.fixture
def logged() -> Iterator[io.StringIO]:
    """The server's log of what jobs print."""
    written, logger = io.StringIO(), logging.getLogger("service.jobs.process")
    handler = Slow(written)
    handler.setFormatter(JsonLines())
    logger.addHandler(handler)
    yield written
    logger.removeHandler(handler)


def test_every_line_that_a_job_prints_is_a_record_with_its_job_and_request(
    store: Store, supervising: Supervising, logged: io.StringIO, capfd: pytest.CaptureFixture[str]
) -> None:
    job = store.jobs.submit(SERVICE, replace(order(store), request_id="the-order"))[0]
    with supervising("print_much"):
        ended(store, job)
    records = [json.loads(line) for line in logged.getvalue().splitlines()]
    assert {(record["job"], record["request_id"], record["level"]) for record in records} == {
        (job, "the-order", "warning")
    }
    messages = [record["message"] for record in records]
    assert messages.count('a warning with "quotes" and \ufffd') == 3  # once an attempt: none is lost, however it ends
    assert messages.count("RuntimeError: unforeseen") == 3
    long = [message for message in messages if message.strip("x") == ""]
    assert max(map(len, long)) == LONGEST and sum(map(len, long)) == 3 * 100_000
    assert "unforeseen" not in capfd.readouterr().err  # and nothing of it goes past the log
