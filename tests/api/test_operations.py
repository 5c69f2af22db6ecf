"""Operation of the service: readiness, versions, counters, log, orderly stop; slow disks block no other request."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import sqlite3
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock, patch

import anyio
import pytest
import uvicorn
from fastapi.testclient import TestClient
from prometheus_client import REGISTRY
from prometheus_client.parser import text_string_to_metric_families
from pydantic import ValidationError

from service import app as layers
from service.commands.serve import AnnouncingServer
from service.content import EventStreams
from service.errors import NoSpace, ServiceUnavailable
from service.models import BODY_BRACKETS, BODY_COMMAS, PACKS, SETTINGS, AssetKind, Question
from service.observe import SAME_A_MINUTE, JsonLines, LogRateLimit, TextLines, working_for
from service.query_client import Frame
from service.sandbox import SandboxLimits
from service.state import Stopping
from service.store.assets import SHOWN_CHARACTERS
from service.store.database import Database
from service.store.files import DataDirectory
from service.store.owners import SERVICE
from service.store.store import Store
from service.supervisor import Supervisor
from service.uploads import check
from tests.crash.conftest import order, until
from tests.crash.server import NoQueries
from tests.crash.service_process import ServiceProcess, processes_of, template_of
from tests.tiny_scene import TinyScene, cameras_document

from .conftest import SceneAssets, app_of, parts_of, put
from .guarded import address, every_route, keyed_server
from .test_problems import assert_problem

Start = Callable[..., Any]
REQUEST_ID = re.compile(r"[0-9a-f]{32}")


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


def test_metrics_count_requests_by_route_template_and_labels_stay_few(
    client: TestClient, scene_assets: SceneAssets
) -> None:
    name, labels = "splatlift_http_requests_total", {"route": "/assets/{asset}", "status": "200"}
    for path in ("/x", "/jobs/x"):
        client.get(path)
    client.request("BREW", "/x")
    before = samples(client)
    for asset in (scene_assets.splats, scene_assets.cameras):
        client.get(f"/assets/{asset}")
        client.head(f"/assets/{asset}")
    value = samples(client)
    for method in ("GET", "HEAD"):
        assert (
            metric_value(value, name, method=method, **labels)
            == metric_value(before, name, method=method, **labels) + 2
        )
    assert metric_value(value, "splatlift_http_request_seconds_count", method="GET", route="/assets/{asset}") >= 2
    for number in range(20):
        client.get(f"/nowhere/{number}?{number}", headers={"X-Request-ID": f"id{number}"})
        client.get(f"/jobs/{number}")
        client.request(f"BREW{number}", f"/y{number}")
    assert samples(client).keys() == value.keys()
    # Each application counts for itself.
    assert not [family.name for family in REGISTRY.collect() if family.name.startswith("splatlift")]


def test_metrics_tell_of_uploads_jobs_queries_and_the_disk(client: TestClient, scene: TinyScene, lift: Any) -> None:
    before = samples(client)
    body = scene.cameras
    assert client.put("/assets/cameras", content=body).status_code == 200  # it is there already, and still was sent
    assert client.get("/query", params={"text": "apple", "lift": lift["id"]}).status_code == 200
    assert client.get("/query", params={"text": "zeppelin", "lift": lift["id"]}).status_code == 422
    value = samples(client)

    def growth(name: str, **labels: str) -> float:
        return metric_value(value, name, **labels) - metric_value(before, name, **labels)

    uploads = {"method": "PUT", "route": "/assets/{asset}"}
    assert growth("splatlift_http_request_body_bytes_total", **uploads) == len(body)
    for outcome in ("answered", "invalid-query"):
        assert growth("splatlift_query_seconds_count", operation="query", outcome=outcome) == 1
    succeeded = len([job for job in client.get("/jobs").json()["jobs"] if job["state"] == "succeeded"])
    assert metric_value(value, "splatlift_jobs", state="succeeded") == succeeded > 0
    assert metric_value(value, "splatlift_attempt_seconds_count", outcome="succeeded") >= succeeded
    assert metric_value(value, "splatlift_disk_free_bytes") > 0
    assert metric_value(value, "splatlift_query_worker_up") == 1


def test_sane_request_id_is_kept_and_any_other_replaced(client: TestClient) -> None:
    for sane in ("a", "7f3c-22.ab_~", "Root=1-67891233-abcdef012345678912345678", "x" * 128):
        assert client.get("/healthz", headers={"X-Request-ID": sane}).headers.get_list("x-request-id") == [sane]
    odd = ["", " ", "a b", 'a"b', "x" * 129, "a\tb", "<script>", "{}", "\u00e4"]
    for headers in [[(b"X-Request-ID", request_id.encode())] for request_id in odd] + [[(b"X-Request-ID", b"a")] * 2]:
        (value,) = client.get("/healthz", headers=headers).headers.get_list("x-request-id")
        assert REQUEST_ID.fullmatch(value), headers


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


def test_routes_are_described_without_another_host(client: TestClient) -> None:
    page = client.get("/docs").text
    parameters = re.findall(r"(?:src|href|url)[=:]\s*['\"]([^'\"]+)", page)
    assert {"openapi.json", "docs/swagger-ui-bundle.js", "docs/swagger-ui.css"} <= set(parameters)
    assert all(client.get(f"/{address}").status_code == 200 for address in parameters if address != "data:,")
    assert "//" not in page.replace("<!-- ", "").split("<script>")[0]
    assert client.get("/redoc").status_code == 404


class Idle:
    """Stands in for the supervisor of jobs."""

    def stop(self) -> None: ...


async def do_nothing(*_: Any) -> None:
    """No application."""


def test_second_sigint_ends_the_notice() -> None:
    stopping = Stopping(EventStreams(1, 1), cast("Supervisor", Idle()), notice_seconds=600)
    server = AnnouncingServer(uvicorn.Config(do_nothing, lifespan="off"), stopping, 1, print)
    server.handle_exit(signal.SIGINT, None)
    timer = threading.Timer(0.3, server.handle_exit, (signal.SIGINT, None))

    async def stop() -> None:
        timer.start()
        with anyio.fail_after(60):
            await stopping.begin(lambda: server.force_exit)

    anyio.run(stop)
    assert server.force_exit


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


@pytest.mark.parametrize(("seconds", "at_once"), [(1000.0, layers.SLOTS), (0.001, 2 * layers.SLOTS)])
def test_few_requests_begin_at_a_time_and_none_waits_for_slow_ones(
    monkeypatch: pytest.MonkeyPatch, seconds: float, at_once: int
) -> None:
    monkeypatch.setattr(layers, "SLOT_SECONDS", seconds)
    started_names: list[str] = []

    async def ask_all() -> None:
        go_on = anyio.Event()

        async def app(scope: Any, receive: Any, send: Any) -> None:
            started_names.append(scope["path"])
            if scope["path"] == "/slow":
                await go_on.wait()

        turns: Any = layers.ConcurrencyLimit(app)
        async with anyio.create_task_group() as parameters:
            for path in ["/slow"] * 2 * layers.SLOTS + ["/healthz"]:
                parameters.start_soon(turns, {"type": "http", "path": path}, None, None)
            while "/healthz" not in started_names or started_names.count("/slow") < at_once:
                await anyio.sleep(0.001)
            assert started_names.count("/slow") == at_once
            go_on.set()
        assert started_names.count("/slow") == 2 * layers.SLOTS

    anyio.run(ask_all)


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


def test_page_of_long_names_is_no_longer_than_others(client: TestClient) -> None:
    cameras = cameras_document()
    names = [f"{number:03}" + "\U0001f600" * 490 for number in range(700)]
    cameras["frames"] = [cameras["frames"][0] | {"file_path": f"{name}.png"} for name in names]
    route = f"/assets/{put(client, AssetKind.CAMERAS, json.dumps(cameras).encode())}/names"
    value: list[str] = []
    cursor: int | None = 0
    while cursor is not None:
        reply = client.get(route, params={"cursor": cursor})
        assert len(reply.content) < 2 << 20
        value += reply.json()["names"]
        cursor = reply.json()["next"]
    assert value == names


def test_small_pages_together_are_the_large_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.content.STREAMED_RECORDS", 2)
    with keyed_server(tmp_path / "data") as server:
        for _ in range(3):
            server.store.jobs.submit(SERVICE, server.order)
        for path, count in (("jobs", 6), ("lifts", 1), ("assets", 3)):
            full = server.ask("boss", "GET", f"/{path}").json()
            value, cursor = [], {}
            while cursor is not None:
                page = server.ask("boss", "GET", f"/{path}", params={"limit": 2} | cursor).json()
                assert len(page[path]) <= 2
                value += page[path]
                cursor = None if page["next"] is None else {"cursor": page["next"]}
            assert full == {path: value, "next": None} and len(value) == count
            for wrong in ({"cursor": "x"}, {"limit": 0}):
                assert server.ask("boss", "GET", f"/{path}", params=wrong).status_code == 422


def test_very_many_names_are_distinct_in_pages(client: TestClient) -> None:
    document = cameras_document()
    frame, long = document["frames"][0], "a" * 400
    names = [f"{long}{number:04}" for number in range(SHOWN_CHARACTERS // 400 + 1)]
    document["frames"] = [frame | {"file_path": f"images/{name}.png"} for name in names]
    asset = put(client, AssetKind.CAMERAS, json.dumps(document).encode())
    problem = client.get(f"/assets/{asset}")
    assert "names" not in problem.json()["counts"] and len(problem.content) < 10_000
    first = client.get(problem.json()["links"]["names"], params={"limit": 500}).json()
    rest = client.get(problem.json()["links"]["names"], params={"cursor": first["next"]}).json()
    assert sorted(first["names"] + rest["names"]) == names and rest["next"] is None
    assert client.delete(f"/assets/{asset}").status_code == 204


def test_lift_of_very_many_views_tells_their_names_apart_in_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lifted = [f"{'a' * 100}{number:04}" for number in range(3000)]
    with keyed_server(tmp_path / "data", views=lifted) as server:
        path = f"/lifts/{server.lift_job}"
        problem = server.ask("alice", "GET", path)
        assert (problem.json()["views"], problem.json()["view_count"]) == ([], 3000) and len(problem.content) < 4000
        assert problem.json()["diagnostics"] == {"warnings": ["x"]}  # and no names of views in it
        assert server.ask("alice", "GET", "/lifts").json()["lifts"] == [problem.json()]
        numbers = {"width": 1, "height": 1, "fx": 1, "fy": 1, "cx": 1, "cy": 1, "viewmat": [[1.0]]}
        page = Frame({"views": [{"name": name, **numbers} for name in (lifted[7], "another")], "more": True})
        monkeypatch.setattr(NoQueries, "call", lambda *arguments: page, raising=False)
        views = server.ask("alice", "GET", problem.json()["links"]["views"], params={"limit": 2}).json()
        assert [(view["name"], view["lifted"]) for view in views["views"]] == [(lifted[7], True), ("another", False)]
        assert views["next"] == 2
    with keyed_server(tmp_path / "few") as server:
        problem = server.ask("alice", "GET", f"/lifts/{server.lift_job}").json()
        assert (problem["views"], problem["view_count"]) == (["v"], 1)


def test_every_answer_tells_browsers_to_guess_and_frame_nothing(client: TestClient) -> None:
    for path in ("/", "/docs", "/healthz", "/nowhere", "/assets", "/lifts/x"):
        problem = client.get(path).headers
        assert (problem["x-content-type-options"], problem["x-frame-options"]) == ("nosniff", "DENY"), path
        assert problem["cross-origin-resource-policy"] == "same-origin", path
        assert "default-src 'none'" in problem["content-security-policy"], path
        assert "frame-ancestors 'none'" in problem["content-security-policy"], path
    policy = client.get("/").headers["content-security-policy"]
    assert "script-src 'self' 'wasm-unsafe-eval'; style-src 'self';" in policy  # its own files alone
    assert "http" not in policy and "unsafe-inline" not in policy and "'unsafe-eval'" not in policy


def test_log_of_one_thing_again_and_again_is_thinned_out() -> None:
    now = [0.0]
    sparing, access = LogRateLimit(lambda: now[0]), logging.LogRecord("service.access", 20, "x", 1, "m", (), None)
    records = [logging.LogRecord("service.jobs", 40, "x", 1, "m", (), None) for _ in range(10_000)]
    assert sum(map(sparing.filter, records)) == SAME_A_MINUTE
    assert all(sparing.filter(access) for _ in range(1000))
    now[0] = 61
    late = logging.LogRecord("service.jobs", 40, "x", 1, "m", (), None)
    assert sparing.filter(late) and vars(late)["fields"] == {"left_out": 10_000 - SAME_A_MINUTE}
