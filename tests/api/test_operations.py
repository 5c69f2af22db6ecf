"""What an operator sees: readiness, versions, counters, the log, and an orderly stop."""

from __future__ import annotations

import itertools
import json
import logging
import os
import re
import signal
import sqlite3
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import anyio
import pytest
import uvicorn
from fastapi.testclient import TestClient
from prometheus_client import REGISTRY
from prometheus_client.parser import text_string_to_metric_families

from service.__main__ import AnnouncingServer
from service.errand import ErrandLimits
from service.errors import Busy
from service.jobs.supervisor import Supervisor
from service.models import AssetKind
from service.observe import JsonLines, TextLines, working_for
from service.state import Stopping
from service.store.files import DataDirectory
from service.store.owners import SERVICE
from service.store.store import Store
from service.streams import EventStreams
from service.uploads.intake import check
from tests.crash.conftest import order, until
from tests.crash.service_process import ServiceProcess, processes_of

from .conftest import Uploaded, app_of, parts_of
from .test_problems import assert_problem
from .tiny_scene import TinyScene

Start = Callable[..., Any]
MADE = re.compile(r"[0-9a-f]{32}")


def fails(client: TestClient, check: str) -> None:
    """Wait until /readyz has looked again, and says that a check has failed."""
    replies: list[Any] = []

    def says_so() -> bool:
        replies.append(client.get("/readyz"))
        return replies[-1].json().get("argument") == check

    until(says_so)
    assert (replies[-1].status_code, assert_problem(replies[-1])["type"]) == (503, "/problems/not-ready")
    assert int(replies[-1].headers["retry-after"]) > 0


def samples(client: TestClient) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """What /metrics says, by name and labels."""
    reply = client.get("/metrics")
    assert reply.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    families = text_string_to_metric_families(reply.text)
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in families
        for sample in family.samples
    }


def counted(found: dict[Any, float], name: str, **labels: str) -> float:
    return found.get((name, tuple(sorted(labels.items()))), 0.0)


def test_readyz_names_what_fails_until_it_works_again(start: Start, tmp_path: Path, monkeypatch: Any) -> None:
    with start() as client:
        until(lambda: client.get("/readyz").status_code == 200)
        found = client.get("/readyz").json()
        assert found == {"status": "ready", "checks": ["database", "disk", "supervisor", "queries"]}
        with monkeypatch.context() as full:
            full.setattr(DataDirectory, "free_bytes", lambda files: 0)
            fails(client, "disk")
        until(lambda: client.get("/readyz").status_code == 200)
        with monkeypatch.context() as read_only:
            read_only.setattr(DataDirectory, "draft", Mock(side_effect=OSError(30, "Read-only file system")))
            fails(client, "disk")
        until(lambda: client.get("/readyz").status_code == 200)
        with closing(sqlite3.connect(tmp_path / "data" / "service.sqlite", isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            fails(client, "database")  # and the look that still waits holds up nobody but the next one
            other.execute("ROLLBACK")
        until(lambda: client.get("/readyz").status_code == 200)
        process = parts_of(client).queries._process
        assert process is not None
        process.kill()
        fails(client, "queries")
        until(lambda: client.get("/readyz").status_code == 200)
        assert counted(samples(client), "splatlift_query_worker_restarts_total") == 1
        parts_of(client).runner.stop()
        fails(client, "supervisor")


def test_operations_and_errors_answer_while_every_thread_of_the_pool_is_busy(start: Start) -> None:
    release, held, answered = threading.Event(), threading.Event(), []

    def slow() -> None:
        held.set()
        answered.append(not release.wait(60))

    def broken() -> None:
        raise RuntimeError("the secret")

    with start(commit="abc1234") as client:
        app_of(client).get("/slow")(slow)
        app_of(client).get("/broken")(broken)
        assert client.portal is not None
        client.portal.call(lambda: setattr(anyio.to_thread.current_default_thread_limiter(), "total_tokens", 1))
        thread = threading.Thread(target=client.get, args=("/slow",))
        thread.start()
        assert held.wait(60)
        try:
            for path, status in (("/healthz", 200), ("/readyz", 200), ("/version", 200), ("/metrics", 200)):
                assert client.get(path).status_code == status
            assert client.get("/nowhere").status_code == 404
            assert client.patch("/query").status_code == 405
            assert thread.is_alive() and not answered
        finally:
            release.set()
            thread.join()
        assert answered == [False]
        found = client.get("/version").json()
        assert (found["version"], found["commit"]) == (version("splatlift"), "abc1234")
        assert found["python"] == ".".join(map(str, sys.version_info[:3]))
        assert found["packages"]["torch"] == version("torch")
        assert any(dict(labels).get("commit") == "abc1234" for name, labels in samples(client) if "build" in name)
        for path, status in (("/nowhere", 404), ("/jobs/x", 404), ("/lifts?x", 422), ("/broken", 500)):
            problem = assert_problem(client.get(path, headers={"X-Request-ID": "mine"}))
            assert (problem["status"], problem["request_id"]) == (status, "mine")


def test_metrics_count_requests_by_route_template_and_labels_stay_few(client: TestClient, uploaded: Uploaded) -> None:
    name, labels = "splatlift_http_requests_total", {"route": "/assets/{asset}", "status": "200"}
    for path in ("/x", "/jobs/x"):
        client.get(path)
    client.request("BREW", "/x")
    before = samples(client)
    for asset in (uploaded.splats, uploaded.cameras):
        client.get(f"/assets/{asset}")
        client.head(f"/assets/{asset}")
    found = samples(client)
    for method in ("GET", "HEAD"):
        assert counted(found, name, method=method, **labels) == counted(before, name, method=method, **labels) + 2
    assert counted(found, "splatlift_http_request_seconds_count", method="GET", route="/assets/{asset}") >= 2
    for number in range(20):
        client.get(f"/nowhere/{number}?{number}", headers={"X-Request-ID": f"id{number}"})
        client.get(f"/jobs/{number}")
        client.request(f"BREW{number}", f"/y{number}")
    assert samples(client).keys() == found.keys()
    # Each application counts for itself.
    assert not [family.name for family in REGISTRY.collect() if family.name.startswith("splatlift")]


def test_metrics_tell_of_uploads_jobs_queries_and_the_disk(client: TestClient, scene: TinyScene, lift: Any) -> None:
    before = samples(client)
    body = scene.cameras
    assert client.put("/assets/cameras", content=body).status_code == 200  # it is there already, and still was sent
    assert client.get("/query", params={"text": "apple", "lift": lift["id"]}).status_code == 200
    assert client.get("/query", params={"text": "zeppelin", "lift": lift["id"]}).status_code == 422
    found = samples(client)

    def grown(name: str, **labels: str) -> float:
        return counted(found, name, **labels) - counted(before, name, **labels)

    uploads = {"method": "PUT", "route": "/assets/{asset}"}
    assert grown("splatlift_http_request_body_bytes_total", **uploads) == len(body)
    for outcome in ("answered", "invalid-query"):
        assert grown("splatlift_query_seconds_count", operation="query", outcome=outcome) == 1
    succeeded = len([job for job in client.get("/jobs").json()["jobs"] if job["state"] == "succeeded"])
    assert counted(found, "splatlift_jobs", state="succeeded") == succeeded > 0
    assert counted(found, "splatlift_attempt_seconds_count", outcome="succeeded") >= succeeded
    assert counted(found, "splatlift_disk_free_bytes") > 0
    assert counted(found, "splatlift_query_worker_up") == 1


def test_sane_request_id_is_kept_and_any_other_replaced(client: TestClient) -> None:
    for sane in ("a", "7f3c-22.ab_~", "Root=1-67891233-abcdef012345678912345678", "x" * 128):
        assert client.get("/healthz", headers={"X-Request-ID": sane}).headers.get_list("x-request-id") == [sane]
    odd = ["", " ", "a b", 'a"b', "x" * 129, "a\tb", "<script>", "{}", "\u00e4"]
    for headers in [[(b"X-Request-ID", one.encode())] for one in odd] + [[(b"X-Request-ID", b"a")] * 2]:
        (found,) = client.get("/healthz", headers=headers).headers.get_list("x-request-id")
        assert MADE.fullmatch(found), headers


def record(message: str, **fields: Any) -> logging.LogRecord:
    found = logging.makeLogRecord({"name": "place", "levelname": "INFO", "msg": message, "created": 0.25})
    found.fields = fields
    return found


def test_json_log_is_one_object_a_line_whatever_is_logged() -> None:
    try:
        raise ValueError("two\nlines with Bearer abc.def and \ud800")
    except ValueError:
        found = record("a\nb \x1b[31m\u2028", path="/\x00", odd=Path("p"))
        found.exc_info = sys.exc_info()
    with working_for("r"):
        line = JsonLines().format(found)
    assert len(line.splitlines()) == 1 and line.isascii()
    told = json.loads(line)
    assert list(told) == ["time", "level", "logger", "message", "request_id", "path", "odd", "error"]
    assert told["time"] == "1970-01-01T00:00:00.250Z"
    assert "ValueError" in told["error"] and "abc.def" not in line


def test_text_log_is_one_line_that_no_client_can_break() -> None:
    line = TextLines().format(record("a\nINFO forged", path="/b\nINFO forged"))
    assert line == r'1970-01-01T00:00:00.250Z INFO place: a\nINFO forged path="/b\nINFO forged"'


def test_stop_refuses_work_ends_streams_puts_jobs_back_and_exits_0(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATLIFT_NOTICE_SECONDS", "5")  # for three requests, on a machine that may be busy
    store = Store.open(tmp_path)
    job = store.jobs.submit(SERVICE, order(store))[0]
    store.close()
    with ServiceProcess(tmp_path, "--behaviour", "hang") as service:
        until(lambda: processes_of(job))
        with service.client.stream("GET", f"/jobs/{job}/events") as stream:
            lines = stream.iter_lines()
            assert next(lines) == "event: state"
            os.kill(service.pid, signal.SIGTERM)
            until(lambda: service.client.get("/readyz").status_code == 503)
            reply = service.client.post("/lift", json={})
            assert (assert_problem(reply)["type"], reply.status_code) == ("/problems/busy", 503)
            assert reply.headers["connection"] == "close" and int(reply.headers["retry-after"]) > 0
            assert service.client.get("/healthz").status_code == 200
            assert "data: " in "".join(lines)  # it ends
        assert service.wait() == 0
        assert not processes_of(job)
    store = Store.open(tmp_path)
    found = store.jobs.get(SERVICE, job)
    store.close()
    assert (found.state, found.attempt) == ("queued", 1)


def test_stop_ends_a_check_that_would_take_long(tmp_path: Path) -> None:
    fifo = tmp_path / "never.ply"
    os.mkfifo(fifo)  # who opens it waits for a writer, for ever
    ending, ended = threading.Event(), []
    limits = ErrandLimits(300.0, 1 << 33, ending)

    def run() -> None:
        with pytest.raises(Busy):
            check(AssetKind.SPLATS, fifo, tmp_path, limits)
        ended.append(True)

    thread = threading.Thread(target=run)
    thread.start()
    assert thread.is_alive()
    ending.set()
    thread.join(30)
    assert ended == [True]


def test_routes_are_described_without_another_host(client: TestClient) -> None:
    page = client.get("/docs").text
    asked = re.findall(r"(?:src|href|url)[=:]\s*['\"]([^'\"]+)", page)
    assert {"openapi.json", "docs/swagger-ui-bundle.js", "docs/swagger-ui.css"} <= set(asked)
    assert all(client.get(f"/{address}").status_code == 200 for address in asked if address != "data:,")
    assert "//" not in page.replace("<!-- ", "").split("<script>")[0]
    assert client.get("/redoc").status_code == 404


class Idle:
    """Stands in for the supervisor of jobs."""

    def stop(self) -> None: ...


async def nothing(*_: Any) -> None:
    """No application."""


def test_second_sigint_ends_the_notice() -> None:
    stopping = Stopping(EventStreams(1, 1), cast("Supervisor", Idle()), notice_seconds=600)
    server = AnnouncingServer(uvicorn.Config(nothing, lifespan="off"), stopping, print)
    server.handle_exit(signal.SIGINT, None)
    again = threading.Timer(0.3, server.handle_exit, (signal.SIGINT, None))

    async def stop() -> None:
        again.start()
        with anyio.fail_after(60):
            await stopping.begin(lambda: server.force_exit)

    anyio.run(stop)
    assert server.force_exit


def test_notice_is_kept_while_nobody_hurries(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    ticks = itertools.count()  # a clock of the test's own, a fifth of a second a look
    monkeypatch.setattr("service.state.time", SimpleNamespace(monotonic=lambda: 0.2 * next(ticks)))

    def hurried() -> bool:
        asked.append(1)
        return False

    stopping = Stopping(EventStreams(1, 1), cast("Supervisor", Idle()), notice_seconds=0.5)
    anyio.run(stopping.begin, hurried)
    assert stopping.begun and len(asked) == 3
