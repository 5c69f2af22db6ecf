"""Operation of the service: readiness, versions, counters, log, orderly stop; slow disks block no other request."""

from __future__ import annotations

import json
import logging
import os
import signal
import sqlite3
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

import anyio
import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families
from pydantic import ValidationError

from service.errors import NoSpace, ServiceUnavailable
from service.models import BODY_BRACKETS, BODY_COMMAS, PACKS, SETTINGS, AssetKind, Question
from service.observe import JsonLines, working_for
from service.sandbox import SandboxLimits
from service.store.database import Database
from service.store.files import DataDirectory
from service.store.owners import SERVICE
from service.store.store import Store
from service.uploads import check
from tests.crash.conftest import order, until
from tests.crash.service_process import ServiceProcess, processes_of, template_of
from tests.tiny_scene import TinyScene

from .conftest import SceneAssets, app_of, parts_of
from .guarded import address, every_route, keyed_server
from .test_problems import assert_problem

Start = Callable[..., Any]


def fails(client: TestClient, check: str) -> None:
    """Wait until /readyz has looked again, and says that a check has failed."""
    replies: list[Any] = []

    def says_so() -> bool:
        replies.append(client.get("/readyz"))
        return replies[-1].json().get("argument") == check

    until(says_so)
    assert "/" not in replies[-1].json()["detail"]  # no file of the server
    assert (replies[-1].status_code, assert_problem(replies[-1])["type"]) == (503, "/problems/not-ready")
    assert int(replies[-1].headers["retry-after"]) > 0


def samples(client: TestClient) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Return the samples of /metrics by name and labels."""
    reply = client.get("/metrics")
    assert reply.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    families = text_string_to_metric_families(reply.text)
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in families
        for sample in family.samples
    }


def metric_value(value: dict[Any, float], name: str, **labels: str) -> float:
    return value.get((name, tuple(sorted(labels.items()))), 0.0)


def test_readyz_names_what_fails_until_it_works_again(start: Start, tmp_path: Path, monkeypatch: Any) -> None:
    with start() as client:
        until(lambda: client.get("/readyz").status_code == 200)
        value = client.get("/readyz").json()
        assert value == {"status": "ready", "checks": ["database", "disk", "supervisor", "queries", "uploads"]}
        with monkeypatch.context() as full:
            full.setattr(DataDirectory, "free_bytes", lambda files: 0)
            fails(client, "disk")
        until(lambda: client.get("/readyz").status_code == 200)
        with monkeypatch.context() as read_only:
            read_only.setattr(
                DataDirectory, "draft", Mock(side_effect=OSError(30, "Read-only file system", "/srv/tmp"))
            )
            fails(client, "disk")
        until(lambda: client.get("/readyz").status_code == 200)
        with closing(sqlite3.connect(tmp_path / "data" / "service.sqlite", isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            fails(client, "database")  # and the look that still waits holds up nobody but the next one
            other.execute("ROLLBACK")
        until(lambda: client.get("/readyz").status_code == 200)
        for restarts, ends in enumerate((signal.SIGKILL, signal.SIGSTOP), 1):
            process = parts_of(client).query_client._process
            assert process is not None
            process.send_signal(ends)
            fails(client, "queries")
            until(lambda: client.get("/readyz").status_code == 200)
            assert metric_value(samples(client), "splatlift_query_worker_restarts_total") == restarts
            os.kill(template_of(os.getpid()), ends)
            fails(client, "uploads")
            until(lambda: client.get("/readyz").status_code == 200)
            assert client.put("/assets/cameras", content=b"{}").status_code == 422
        parts_of(client).supervisor.stop()
        fails(client, "supervisor")


def test_operations_and_errors_answer_while_every_thread_of_the_pool_is_busy(start: Start) -> None:
    release, threads_held, all_answered = threading.Event(), threading.Event(), []

    def slow() -> None:
        threads_held.set()
        all_answered.append(not release.wait(60))

    def broken() -> None:
        raise RuntimeError("the secret")

    with start(commit="abc1234") as client:
        app_of(client).get("/slow")(slow)
        app_of(client).get("/broken")(broken)
        assert client.portal is not None
        client.portal.call(lambda: setattr(anyio.to_thread.current_default_thread_limiter(), "total_tokens", 1))
        thread = threading.Thread(target=client.get, args=("/slow",))
        thread.start()
        assert threads_held.wait(60)
        try:
            for path, status in (("/healthz", 200), ("/readyz", 200), ("/version", 200), ("/metrics", 200)):
                assert client.get(path).status_code == status
            assert client.get("/nowhere").status_code == 404
            assert client.patch("/query").status_code == 405
            assert thread.is_alive() and not all_answered
        finally:
            release.set()
            thread.join()
        assert all_answered == [False]
        value = client.get("/version").json()
        assert (value["version"], value["commit"]) == (version("splatlift"), "abc1234")
        assert value["python"] == ".".join(map(str, sys.version_info[:3]))
        assert value["packages"]["torch"] == version("torch")
        assert any(dict(labels).get("commit") == "abc1234" for name, labels in samples(client) if "build" in name)
        for path, status in (("/nowhere", 404), ("/jobs/x", 404), ("/lifts?x", 422), ("/broken", 500)):
            problem = assert_problem(client.get(path, headers={"X-Request-ID": "mine"}))
            assert (problem["status"], problem["request_id"]) == (status, "mine")


def record(message: str, **fields: Any) -> logging.LogRecord:
    value = logging.makeLogRecord({"name": "place", "levelname": "INFO", "msg": message, "created": 0.25})
    value.fields = fields
    return value


def test_json_log_is_one_object_a_line_whatever_is_logged() -> None:
    try:
        raise ValueError("two\nlines with Bearer abc.def and \ud800")
    except ValueError:
        value = record("a\nb \x1b[31m\u2028", path="/\x00", odd=Path("p"))
        value.exc_info = sys.exc_info()
    with working_for("r"):
        line = JsonLines().format(value)
    assert len(line.splitlines()) == 1 and line.isascii()
    problem = json.loads(line)
    assert list(problem) == ["time", "level", "logger", "message", "request_id", "path", "odd", "error"]
    assert problem["time"] == "1970-01-01T00:00:00.250Z"
    assert "ValueError" in problem["error"] and "abc.def" not in line


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
    value = store.jobs.get(SERVICE, job)
    store.close()
    assert (value.state, value.attempt) == ("queued", 1)


def test_stop_ends_a_check_that_would_take_long(tmp_path: Path) -> None:
    fifo = tmp_path / "never.ply"
    os.mkfifo(fifo)  # who opens it waits for a writer, for ever
    ending, ends = threading.Event(), []
    limits = SandboxLimits(300.0, 1 << 33, ending)

    def run() -> None:
        with pytest.raises(ServiceUnavailable):
            check(AssetKind.SPLATS, fifo, tmp_path, limits)
        ends.append(True)

    thread = threading.Thread(target=run)
    thread.start()
    assert thread.is_alive()
    ending.set()
    thread.join(30)
    assert ends == [True]


AUDIT_HOOKS: list[Callable[[str, tuple[Any, ...]], None]] = []  # an audit hook stays for good, so it asks here
TOUCHES = {
    "open", "sqlite3.connect", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.scandir", "os.listdir",
    "shutil.rmtree", "subprocess.Popen", "glob.glob",
}  # fmt: skip
sys.addaudithook(lambda event, arguments: [watch(event, arguments) for watch in AUDIT_HOOKS] and None)


@contextmanager
def touches_on_the_loop(client: TestClient, patch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Record operations of the event loop's thread on files of the service and on its database."""
    assert client.portal is not None
    loop, root = client.portal.call(threading.get_ident), str(parts_of(client).store.files.root)
    roots = (root, str(Path(__file__).parents[2] / "service" / "web"))
    touches: list[str] = []

    def note(operation: str) -> None:
        if threading.get_ident() == loop:
            touches.append(operation)

    def on_audit(event: str, arguments: tuple[Any, ...]) -> None:
        place = str(arguments[0]) if arguments else ""
        if event in TOUCHES and (place.startswith(roots) or not event.startswith(("open", "os.", "glob"))):
            note(f"{event} {place}")

    def noting(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *arguments, **keywords: (note(name), original(*arguments, **keywords))[1]

    for cls, names in ((Database, ("read", "write")), (DataDirectory, ("free_bytes", "draft", "scratch"))):
        for name in names:
            patch.setattr(cls, name, noting(f"{cls.__name__}.{name}", getattr(cls, name)))
    AUDIT_HOOKS.append(on_audit)
    try:
        yield touches
    finally:
        AUDIT_HOOKS.remove(on_audit)


def test_no_route_touches_files_or_the_database_on_the_event_loop(
    client: TestClient,
    scene_assets: SceneAssets,
    lift: dict[str, Any],
    scene: TinyScene,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    parameters = {"lift": lift["id"], "text": "apple", "view": "left"}
    bodies = {"/lift": scene_assets.order(stride=0), "/tradeoff": scene_assets.order(stride=0)}
    with touches_on_the_loop(client, monkeypatch) as touches:
        for method, path in every_route(app_of(client)):
            if method == "DELETE" or path.endswith("/cancel"):
                continue  # of things that other tests need: `address` names none below
            address_of_route = address(path, lift["id"], "splats" if method == "PUT" else scene_assets.cameras)
            body = {"json": bodies.get(path, {**parameters, "text": ["apple"]})} if method == "POST" else {}
            parameter_names = (
                set(parameters) if path.startswith("/query") else {"lift", "view"} if path == "/render" else set()
            )
            parameter_names -= (
                {"view"}
                if path in ("/query/scores", "/query/selection", "/query/splats", "/query/objects")
                else set()
            )
            options: dict[str, Any] = {"content": scene.splats} if method == "PUT" else body
            client.request(
                method,
                address_of_route,
                params={name: parameters[name] for name in parameter_names if method == "GET"},
                **options,
            )
        client.delete(address("/jobs/{job}", "0" * 32, ""))
        client.delete(f"/assets/{scene_assets.splats}")  # refused: a lift needs it
        client.put("/assets/cameras", content=b"no cameras")
        assert not touches


def test_upload_to_a_stalled_disk_keeps_nobody_else_waiting(
    start: Start, scene: TinyScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    stalled, released = threading.Event(), threading.Event()

    def stall(files: DataDirectory, coming: int = 0) -> None:
        stalled.set()
        assert released.wait(120)
        raise NoSpace("data", expected="a disk that answers", got="one that did not")

    with start() as client:
        monkeypatch.setattr(DataDirectory, "require_room", stall)
        uploads = [
            threading.Thread(target=client.put, args=("/assets/splats",), kwargs={"content": scene.splats})
            for _ in range(50)  # more than there are threads
        ]
        for upload in uploads:
            upload.start()
        try:
            assert stalled.wait(60)
            for path in ("/healthz", "/version", "/jobs", "/assets", "/metrics", "/"):
                assert client.get(path).status_code == 200
            assert "disk" in assert_problem(client.get("/readyz"))["argument"]
        finally:
            released.set()
            for upload in uploads:
                upload.join()


def test_settings_are_bounded_before_they_are_looked_at(client: TestClient, scene_assets: SceneAssets) -> None:
    for settings in (
        {f"name{number}": 1 for number in range(SETTINGS + 1)},
        {"n" * 10_000: 1},
        {"preset": "x" * 10_000},
    ):
        for path in ("/lift", "/tradeoff"):
            problem = assert_problem(client.post(path, json=scene_assets.order() | {"settings": settings}))
            assert (problem["status"], problem["argument"]) == (422, "settings")
            assert f"at most {SETTINGS} settings" in problem["expected"]


# Lists


@pytest.mark.parametrize(
    "wrong", [{"like": [{}] * 200_000}, {"like": ["x", *[3] * 30]}, {"text": [1] * 200_000}, {"like": [["x"] * 9000]}]
)
def test_body_is_refused_for_the_first_thing_that_is_wrong_and_not_for_all(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError) as problem:
        Question.model_validate({"text": ["apple"], **wrong})
    assert problem.value.error_count() == 1


@pytest.mark.parametrize(
    "body", ["[]," * (BODY_BRACKETS + 1), "0," * (BODY_COMMAS + 1), '{"a":' * (BODY_BRACKETS + 1)]
)
def test_body_of_more_values_than_any_question_has_is_not_parsed(client: TestClient, body: str) -> None:
    with patch("service.requests.json", Mock(loads=Mock(side_effect=AssertionError("parsed")))):
        reply = client.post("/query", content=body, headers={"Content-Type": "application/json"})
    assert "at most" in assert_problem(reply)["expected"] and reply.status_code == 422


def test_pack_counts_once_and_packs_are_bounded(tmp_path: Path) -> None:
    with keyed_server(tmp_path / "data") as server:
        body = server.body()
        response = server.ask("alice", "POST", "/lift", json=body | {"features": body["features"] * 10_000})
        assert response.status_code == 202 and response.json()["features"] == body["features"]
        other_packs = [f"sha256:{number:064x}" for number in range(PACKS + 1)]
        problem = assert_problem(server.ask("alice", "POST", "/lift", json=body | {"features": other_packs}))
        assert (problem["argument"], problem["status"]) == ("features", 422) and f"at most {PACKS}" in problem[
            "expected"
        ]
