"""The query process: turns are shared fairly, questions together are answered as alone, what is kept has a size."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
from fastapi.testclient import TestClient

from liftcore.errors import SplatliftError
from service import query_client as client
from service import query_worker as answers
from service.auth import LOCAL_ADMIN
from service.child import children_of
from service.errors import ClientDisconnected, ServiceUnavailable, TimedOut
from service.models import Question
from service.query_client import Frame, QueryClient, QueryLimits, Waiter
from service.query_worker import Answers, reply_to
from service.routes.queries import query_request
from tests.crash.conftest import address_of, until
from tests.crash.server import NoQueries
from tests.tiny_scene import CHANNELS, WORDS

from .conftest import parts_of
from .guarded import keyed_server
from .test_slow_clients import running

# Answers a request once the file that it names is there, and writes down which it answers and what waits behind it.
STAND_IN = """
import json, sys, time
from multiprocessing.connection import Connection
from pathlib import Path
from service.query_client import Frame, send_frame
folder, server = Path(sys.argv[1]), Connection(int(sys.argv[2]))
while True:
    first, *others = json.loads(server.recv_bytes())
    with (folder / "asked").open("a") as log:
        print(json.dumps([first["name"], [other["name"] for other in others]]), file=log)
    while not (folder / first["after"]).exists():
        time.sleep(0.005)
    send_frame(server, Frame({"name": first["name"]}))
"""
Start = Callable[..., QueryClient]


class Calls:
    """Calls in threads of their own, and what came of each by its name."""

    def __init__(self, worker: QueryClient) -> None:
        self.worker, self.came = worker, dict[str, str]()
        self._threads: list[threading.Thread] = []

    def begin(self, name: str, waiter: Waiter, after: str = "open") -> None:
        """Call, and return once it waits or is asked."""
        waiting_before, call = self.worker.waiting, {"operation": "query", "name": name, "after": after}

        def run() -> None:
            try:
                self.came[name] = self.worker.call(call, waiter).header["name"]
            except SplatliftError as error:
                self.came[name] = error.kind

        self._threads.append(threading.Thread(target=run))
        self._threads[-1].start()
        until(lambda: self.worker.waiting > waiting_before or name in self.came or self.worker._busy_with is not None)

    def end(self) -> None:
        """Wait for all of them."""
        for thread in self._threads:
            thread.join()


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Start]:
    """Start workers that stand in for the query process."""
    original, clients = client.subprocess.Popen, list[QueryClient]()
    (tmp_path / "at once").touch()

    def run(command: list[str], **options: Any) -> Any:
        return original([command[0], "-c", STAND_IN, str(tmp_path), command[3]], **options)

    def begin(*, seconds: float = 120.0, of_a_key: int | None = None, waiting: int = 16) -> QueryClient:
        limits = QueryLimits(waiting, seconds, scenes=1, cache_bytes=0, encoder="lvis", of_a_key=of_a_key)
        clients.append(QueryClient(limits))
        clients[-1].start()
        return clients[-1]

    monkeypatch.setattr(client.subprocess, "Popen", run)
    yield begin
    (tmp_path / "open").touch()
    for worker in clients:
        worker.stop()


def read_calls(folder: Path) -> list[tuple[str, list[str]]]:
    """Return the calls in the order of their start, with the calls that waited behind each."""
    return [tuple(json.loads(line)) for line in (folder / "asked").read_text().splitlines()]


def test_call_whose_client_left_is_not_asked(start: Start, tmp_path: Path) -> None:
    calls, stays, leaves = Calls(start()), Waiter(), Waiter()
    calls.begin("first", stays)
    calls.begin("gone", leaves)
    calls.worker.cancel(leaves)
    until(lambda: "gone" in calls.came)  # at once, while the first is still asked
    assert calls.came == {"gone": ClientDisconnected.kind}
    calls.begin("last", stays)
    (tmp_path / "open").touch()
    calls.end()
    assert read_calls(tmp_path) == [("first", []), ("last", [])] and calls.came["last"] == "last"


def stop(worker: QueryClient) -> subprocess.Popen[bytes]:
    """Stop its process, as a debugger does."""
    process = worker._process
    assert process is not None
    os.kill(process.pid, signal.SIGSTOP)
    return process


def test_every_call_has_one_time_for_waiting_and_answer(start: Start, tmp_path: Path) -> None:
    worker = start(seconds=4.0)  # a process begins within it, on a busy machine too
    calls = Calls(worker)
    for name in ("never", "behind"):
        calls.begin(name, Waiter(), after="never")
    calls.end()
    assert calls.came["never"] == TimedOut.kind and calls.came["behind"] in (TimedOut.kind, ServiceUnavailable.kind)
    assert worker.call({"operation": "query", "name": "next", "after": "at once"}) == Frame({"name": "next"})


def test_process_that_is_stopped_is_replaced(start: Start) -> None:
    worker = start(seconds=60.0)
    request = {"operation": "query", "name": "x", "after": "at once"}
    worker.call(request)
    process = stop(worker)
    until(lambda: not worker.alive())
    assert worker.call(request) == Frame({"name": "x"})
    assert process.poll() is not None


def test_process_that_reads_nothing_holds_the_turn_no_longer(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    worker = start(seconds=4.0)
    request = {"operation": "query", "name": "x", "after": "at once"}
    worker.call(request)
    monkeypatch.setattr(client, "is_stopped", lambda pid: False)  # it is stopped as soon as it was looked at
    stop(worker)
    with pytest.raises(TimedOut):
        worker.call(request | {"padding": "x" * 1_000_000})  # more than a pipe holds
    assert worker.call(request) == Frame({"name": "x"})


def test_stop_answers_who_waits(start: Start) -> None:
    calls = Calls(start())
    for name in ("asked", "waits"):
        calls.begin(name, Waiter())
    calls.worker.stop()
    calls.end()
    assert set(calls.came.values()) == {ServiceUnavailable.kind}


class Patient(NoQueries):
    """Stands in for the query process: a call waits until its client has left."""

    def __init__(self) -> None:
        self.waiters: list[Waiter] = []

    def call(self, request: dict[str, Any], waiter: Waiter) -> Frame:
        self.waiters.append(waiter)
        until(lambda: waiter.disconnected)
        raise ClientDisconnected("query", expected="a client that waits", got="one that left")

    def cancel(self, waiter: Waiter) -> None:
        waiter.disconnected = True


@pytest.mark.parametrize("method", ["GET", "POST"])
def test_closed_connection_is_a_client_that_left(tmp_path: Path, method: str) -> None:
    with keyed_server(tmp_path / "data") as lifts_server:
        lift, secret = lifts_server.lift_job, lifts_server.secrets["alice"]
    body = json.dumps({"text": ["x"], "lift": lift})
    path = f"/query/scores?text=x&lift={lift}" if method == "GET" else "/query/scores"
    head = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {secret}\r\n"
    request_heads = {
        "GET": "\r\n",
        "POST": f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n{body}",
    }
    queries = Patient()
    server_settings = {"text_spaces": {"t": "lvis"}}
    with running(tmp_path / "data", queries=cast("QueryClient", queries), **server_settings) as server:
        with socket.create_connection(address_of(server), timeout=60) as connection:
            connection.sendall((head + request_heads[method]).encode())
            until(lambda: queries.waiters)
            assert not queries.waiters[0].disconnected and queries.waiters[0].key == lifts_server.ids["alice"]
        until(lambda: queries.waiters[0].disconnected)
        until(lambda: not server.server_state.connections)


# Answers


AN_ANSWER = 6 * 60 + (2 << 10)  # bytes, for the splats of the tiny scene
AN_IMAGE = 9 * 32 * 24 + (2 << 10)
AXES = [[float(row == channel) for channel in range(CHANNELS)] for row in range(3)]
QUESTIONS: list[dict[str, Any]] = [
    *({"text": [word]} for word in WORDS),
    {"text": list(WORDS), "negatives": ["book"], "threshold": "otsu"},
    {"text": ["lamp"], "like": [AXES[0]]},
    {"like": [AXES[1], [0.3, 0.4, 0, 0, 0, 0, 0, 0.5]], "unlike": [AXES[2]]},
    {"text": ["zeppelin"]},  # which the table does not know
    {"like": ["splat:7"]},
    {"text": ["apple"]},  # again
]


@pytest.fixture
def request_of(client: TestClient, lift: dict[str, Any]) -> Callable[..., dict[str, Any]]:
    """A request as the query process gets it."""
    parts = parts_of(client)
    parts_of_admin = replace(parts, caller=LOCAL_ADMIN)  # as for a caller who sees the lift
    record = parts_of_admin.store.lifts.get(parts_of_admin.owner, lift["id"])

    def make(operation: str = "scores", **fields: Any) -> dict[str, Any]:
        body = Question.model_validate({"lift": lift["id"], **fields})
        return query_request(operation, body, record, parts_of_admin) | {"view": "left", "top": 3}

    return make


def frame_parts(frame: Frame) -> tuple[object, bytes]:
    return frame.header, frame.body


def test_questions_asked_together_are_answered_as_alone_to_the_bit(request_of: Callable[..., dict[str, Any]]) -> None:
    requests = [request_of(operation, **fields) for fields in QUESTIONS for operation in ("scores", "query", "mask")]
    shared = Answers(scenes=1, cache_bytes=1 << 20)
    replies = [frame_parts(reply_to(requests[first:], shared)) for first in range(len(requests))]
    single = [frame_parts(reply_to([request], Answers(scenes=1, cache_bytes=0))) for request in requests]
    assert replies == single
    assert sum("fault" in header for header, _ in replies if isinstance(header, dict)) == 3
    assert len({body for _, body in replies}) > len(QUESTIONS)


def test_large_answer_is_a_file_and_the_same_bytes(
    request_of: Callable[..., dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_calls, cached = {"draft": str(tmp_path / "draft")}, Answers(scenes=1, cache_bytes=1 << 20)
    requests = [request_of(operation, text=["apple"]) | read_calls for operation in ("scores", "mask", "attention")]
    small = [reply_to([request], cached).body for request in requests]
    assert all(small) and not list(tmp_path.iterdir())
    monkeypatch.setattr(answers, "PIPE_BYTES", 10)
    for request, content in zip(requests, small, strict=True):
        assert reply_to([request], cached) == Frame({}) and (tmp_path / "draft").read_bytes() == content


@pytest.mark.skipif(sys.platform != "linux", reason="/proc tells the environment of a process")
def test_libraries_of_the_query_process_compute_in_one_thread(client: TestClient) -> None:
    assert parts_of(client).query_client.alive()
    processes = [Path("/proc", str(child)) for child in children_of(os.getpid())]
    workers = [process for process in processes if b"query_worker" in (process / "cmdline").read_bytes()]
    assert workers
    for worker in workers:
        environment = (worker / "environ").read_bytes().split(b"\0")
        assert {b"OMP_NUM_THREADS=1", b"OPENBLAS_NUM_THREADS=1"} <= set(environment)


@pytest.mark.parametrize(
    ("bound", "argument", "of"), [("WORD_COSINES", "words", "words"), ("MASK_PIXELS", "view", "questions")]
)
def test_what_would_take_minutes_is_refused_before_it_begins(
    request_of: Callable[..., dict[str, Any]], monkeypatch: pytest.MonkeyPatch, bound: str, argument: str, of: str
) -> None:
    monkeypatch.setattr(answers, bound, 60)
    export = {"of": of, "of_view": None, "words": None, "parts": []}
    read_calls = request_of("export", text=["apple"]) | export
    (fault,) = reply_to([read_calls], Answers(scenes=1, cache_bytes=0)).header.values()
    assert (fault["kind"], fault["argument"]) == ("invalid-query", argument) and "at most" in fault["expected"]


def test_what_is_kept_stays_within_its_size_over_many_different_questions(
    request_of: Callable[..., dict[str, Any]],
) -> None:
    limit = 10 * AN_ANSWER + 2 * AN_IMAGE
    answers = Answers(scenes=1, cache_bytes=limit)
    sizes = []
    for number in range(300):
        operation = "mask" if number % 3 == 0 else "scores"
        reply_to([request_of(operation, text=["apple"], threshold=number / 300)], answers)
        sizes.append(answers.kept_bytes)
    assert max(sizes) <= limit and min(sizes[50:]) > limit / 2


def test_calls_of_a_worker_that_dies_are_answered_by_the_next(
    client: TestClient, lift: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    # a process that is seen stopped is replaced before it is asked
    monkeypatch.setattr("service.query_client.is_stopped", lambda pid: False)
    worker = parts_of(client).query_client
    process = worker._process
    assert process is not None
    os.kill(process.pid, signal.SIGSTOP)  # so that all calls are in the line, and the first asked, when it dies
    replies: list[int] = []

    def run(number: int) -> None:
        parameters = {"text": "book", "lift": lift["id"], "threshold": 0.5 + number / 100}
        replies.append(client.get("/query", params=parameters).status_code)

    threads = [threading.Thread(target=run, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    until(lambda: worker.waiting == 3)
    os.kill(process.pid, signal.SIGKILL)
    for thread in threads:
        thread.join()
    assert replies == [200] * 4
