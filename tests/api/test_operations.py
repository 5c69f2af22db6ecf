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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import anyio
import httpx
import pytest
import uvicorn
from fastapi.testclient import TestClient
from prometheus_client import REGISTRY
from prometheus_client.parser import text_string_to_metric_families

from service.__main__ import AnnouncingServer
from service.errand import ErrandLimits
from service.errors import Busy
from service.jobs.process import JobLimits
from service.jobs.supervisor import Supervisor
from service.models import AssetKind
from service.observe import JsonLines, TextLines, current_id, working_for
from service.state import Stopping
from service.store.owners import SERVICE
from service.store.store import Store
from service.streams import EventStreams
from service.uploads.intake import check
from tests.crash.conftest import order, stand_in, until
from tests.crash.service_process import ServiceProcess, processes_of

from .conftest import LIFT_REQUEST, Uploaded, app_of, parts_of
from .test_problems import assert_problem
from .tiny_scene import TinyScene

Start = Callable[..., Any]
MADE = re.compile(r"[0-9a-f]{32}")


def failing(client: TestClient) -> str:
    """The checks that /readyz says have failed."""
    reply = client.get("/readyz")
    body = assert_problem(reply)
    assert (reply.status_code, body["type"]) == (503, "/problems/not-ready")
    assert int(reply.headers["retry-after"]) > 0
    return body["argument"]


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


def test_readyz_says_what_was_looked_at(client: TestClient) -> None:
    reply = client.get("/readyz")
    assert reply.status_code == 200
    assert reply.json() == {"status": "ready", "checks": ["database", "disk", "supervisor", "queries"]}


def test_readyz_names_a_disk_below_the_floor(start: Start) -> None:
    with start(disk_floor_bytes=1 << 60) as client:
        assert failing(client) == "disk"


def test_readyz_names_a_database_that_another_process_holds(start: Start, tmp_path: Path) -> None:
    with start() as client:
        other = sqlite3.connect(tmp_path / "data" / "service.sqlite", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        assert failing(client) == "database"
        assert failing(client) == "database"  # and the look that still waits holds up nobody but the next one
        other.execute("ROLLBACK")
        other.close()
        until(lambda: client.get("/readyz").status_code == 200)


def test_readyz_names_a_supervisor_whose_thread_died(start: Start) -> None:
    with start() as client:
        parts_of(client).runner.stop()
        assert failing(client) == "supervisor"


def test_readyz_names_a_dead_query_worker_and_a_new_one_starts(start: Start) -> None:
    with start() as client:
        process = parts_of(client).queries._process
        assert process is not None
        process.kill()
        process.wait()
        assert failing(client) == "queries"
        until(lambda: client.get("/readyz").status_code == 200)
        assert counted(samples(client), "splatlift_query_worker_restarts_total") == 1


def test_operations_and_errors_answer_while_every_thread_of_the_pool_is_busy(start: Start) -> None:
    release, held, answered = threading.Event(), threading.Event(), []

    def slow() -> None:
        held.set()
        answered.append(not release.wait(60))

    with start() as client:
        app_of(client).get("/slow")(slow)
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


def test_version_tells_what_runs_without_loading_it(client: TestClient) -> None:
    found = client.get("/version").json()
    assert found["version"] == version("splatlift")
    assert found["python"] == ".".join(map(str, sys.version_info[:3]))
    assert found["packages"]["torch"] == version("torch")
    assert found["commit"] is None


def test_commit_is_told_when_the_operator_knows_it(start: Start) -> None:
    with start(commit="abc1234") as client:
        assert client.get("/version").json()["commit"] == "abc1234"
        assert any(dict(labels).get("commit") == "abc1234" for name, labels in samples(client) if "build" in name)


def test_metrics_count_requests_by_route_template(client: TestClient, uploaded: Uploaded) -> None:
    labels = {"method": "GET", "route": "/assets/{asset}", "status": "200"}
    before = counted(samples(client), "splatlift_http_requests_total", **labels)
    for asset in (uploaded.splats, uploaded.cameras):
        client.get(f"/assets/{asset}")
    found = samples(client)
    assert counted(found, "splatlift_http_requests_total", **labels) == before + 2
    seconds = {"method": "GET", "route": "/assets/{asset}"}
    assert counted(found, "splatlift_http_request_seconds_count", **seconds) >= 2


def test_labels_stay_few_whatever_clients_ask_for(client: TestClient) -> None:
    client.get("/x")
    client.request("BREW", "/x")
    client.get("/jobs/x")
    samples(client)
    before = samples(client).keys()
    for number in range(40):
        client.get(f"/nowhere/{number}?{number}", headers={"X-Request-ID": f"id{number}"})
        client.get(f"/jobs/{number}")
        client.request(f"BREW{number}", "/x")
        client.request(f"BREW{number}", f"/y{number}")
    assert samples(client).keys() == before


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


def test_queue_and_running_lifts_are_counted(tmp_path: Path) -> None:
    with hanging_server(tmp_path, jobs=3) as (service, jobs):
        until(lambda: service.job(jobs[0])["state"] == "running")
        text = service.client.get("/metrics").text
        assert "splatlift_queue_length 2.0" in text and "splatlift_running_lifts 1.0" in text
        assert 'splatlift_jobs{state="queued"} 2.0' in text


def test_each_application_counts_for_itself(start: Start) -> None:
    with start("one") as one, start("two") as two:
        one.get("/healthz")
        name, labels = "splatlift_http_requests_total", {"method": "GET", "route": "/healthz", "status": "200"}
        assert (counted(samples(one), name, **labels), counted(samples(two), name, **labels)) == (1, 0)
    assert not [family.name for family in REGISTRY.collect() if family.name.startswith("splatlift")]


@pytest.mark.parametrize("sane", ["a", "7f3c-22.ab_~", "Root=1-67891233-abcdef012345678912345678", "x" * 128])
def test_sane_request_id_is_kept(client: TestClient, sane: str) -> None:
    assert client.get("/healthz", headers={"X-Request-ID": sane}).headers.get_list("x-request-id") == [sane]


@pytest.mark.parametrize("odd", ["", " ", "a b", 'a"b', "x" * 129, "a\tb", "<script>", "{}", "ä"])
def test_other_request_ids_are_replaced(client: TestClient, odd: str) -> None:
    reply = client.get("/healthz", headers={b"X-Request-ID": odd.encode()})
    (found,) = reply.headers.get_list("x-request-id")
    assert MADE.fullmatch(found)


def test_two_request_ids_are_none(client: TestClient) -> None:
    reply = client.get("/healthz", headers=[("X-Request-ID", "a"), ("X-Request-ID", "b")])
    assert MADE.fullmatch(reply.headers["x-request-id"])


def test_every_problem_names_its_request(start: Start) -> None:
    with start() as client:

        def broken() -> None:
            raise RuntimeError("the secret")

        app_of(client).get("/broken")(broken)
        requests = [("GET", "/nowhere"), ("PUT", "/query"), ("POST", "/lift"), ("GET", "/jobs/x"), ("GET", "/broken")]
        statuses = []
        for number, (method, path) in enumerate(requests):
            reply = client.request(method, path, headers={"X-Request-ID": f"id-{number}"})
            assert assert_problem(reply)["request_id"] == reply.headers["x-request-id"] == f"id-{number}"
            statuses.append(reply.status_code)
        assert statuses == [404, 405, 422, 404, 500]


def test_job_knows_the_request_that_made_it(client: TestClient, lift: dict[str, Any]) -> None:
    job = client.get(lift["links"]["job"]).json()
    assert job["request_id"] == LIFT_REQUEST
    assert LIFT_REQUEST in client.get(job["links"]["events"]).text


def test_log_of_a_job_names_the_request_that_made_it(tmp_path: Path) -> None:
    seen: dict[str, str | None] = {}

    class Watch(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            seen[record.getMessage()] = current_id()

    watch, logger = Watch(), logging.getLogger("service.jobs")
    store = Store.open(tmp_path)
    job = store.jobs.submit(SERVICE, replace(order(store), request_id="the-order"))[0]
    runner = Supervisor(store, JobLimits(), command=stand_in("answer"))
    logger.addHandler(watch)
    logger.setLevel(logging.INFO)
    try:
        runner.start()
        until(lambda: any("succeeded" in message for message in seen))
    finally:
        logger.setLevel(logging.NOTSET)
        logger.removeHandler(watch)
        runner.stop()
        store.close()
    assert {request for message, request in seen.items() if job in message} == {"the-order"}


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


@contextmanager
def hanging_server(data: Path, jobs: int) -> Iterator[tuple[ServiceProcess, list[str]]]:
    """A server process whose lifts never end, with jobs in line."""
    store = Store.open(data)
    ids = [store.jobs.submit(SERVICE, order(store))[0] for _ in range(jobs)]
    store.close()
    with ServiceProcess(data, "--behaviour", "hang") as service:
        yield service, ids


def test_stop_refuses_work_ends_streams_puts_jobs_back_and_exits_0(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATLIFT_NOTICE_SECONDS", "10")  # for three requests, on a machine that may be busy
    with hanging_server(tmp_path, jobs=1) as (service, (job,)):
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


def test_log_of_a_server_is_json_lines_and_holds_no_secret(tmp_path: Path, table: Path) -> None:
    from .test_server import server

    log = tmp_path / "log"
    with log.open("w") as stderr, server(tmp_path / "data", table, stderr=stderr) as address:
        secret = {"Authorization": "Bearer the-secret", "X-Request-ID": "mine", "Cookie": "the-secret"}
        with httpx.Client(base_url=address, headers=secret, timeout=120) as client:
            for path in ("/healthz?token=the-secret", "/nowhere?the-secret", "/query?text=the-secret"):
                client.get(path)
            client.post("/lift", json={"splats": "the-secret"})
            client.put("/assets/splats", content=b"the-secret")
    text = log.read_text()
    told = [json.loads(line) for line in text.splitlines()]
    assert "the-secret" not in text
    access = [line for line in told if line["logger"] == "service.access"]
    assert [line["status"] for line in access] == [200, 404, 404, 422, 422]
    assert {line["request_id"] for line in access} == {"mine"}
    wanted = {"method", "route", "path", "status", "seconds", "received", "sent"}
    assert all(wanted <= line.keys() for line in access)
    assert access[-1]["received"] == len(b"the-secret") and access[-1]["sent"] > 0


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
