"""Slow, broken and too many connections, over real sockets."""

from __future__ import annotations

import contextlib
import itertools
import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import httpx
import pytest
import uvicorn

from service.app import create_app, job_limits
from service.models import AssetKind
from service.query_client import QueryClient
from service.settings import ServiceSettings
from service.store.store import Store
from service.supervisor import Supervisor
from tests.crash.conftest import address_of, listening, until
from tests.crash.server import NoQueries

PATIENCE_SECONDS = 60.0  # for what takes half a second; the machine may be busy
HEAD = b"PUT /assets/splats HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5000\r\n\r\n"
JSON_HEAD = (
    b"POST /lift HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 5000\r\n\r\n"
)


@contextmanager
def serve(data: Path, **settings: Any) -> Iterator[tuple[str, int]]:
    """A server in a thread: host and port."""
    with running(data, **settings) as server:
        yield address_of(server)


@contextmanager
def running(data: Path, queries: QueryClient | None = None, **settings: Any) -> Iterator[uvicorn.Server]:
    """That server, to look into it; without a query process, unless one is given."""
    server_settings = ServiceSettings.model_validate(
        {"data": data, "disk_floor_bytes": 0, "notice_seconds": 0, **settings}
    )
    store = Store.open(server_settings.data)
    worker = queries or cast("QueryClient", NoQueries())
    try:
        with listening(
            create_app(server_settings, store, Supervisor(store, job_limits(server_settings)), worker),
            server_settings,
        ) as server:
            yield server
    finally:
        store.close()


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("live") / "data"


@pytest.fixture(scope="module")
def live(data: Path) -> Iterator[tuple[str, int]]:
    """A server."""
    with serve(data) as address:
        yield address


@contextmanager
def client_of(address: tuple[str, int]) -> Iterator[socket.socket]:
    with socket.create_connection(address, timeout=PATIENCE_SECONDS) as client:
        yield client


def answer(client: socket.socket) -> tuple[bytes, bytes]:
    """Head and body of all that comes until the server closes; fails when it does not."""
    response = b""
    try:
        while piece := client.recv(1 << 16):
            response += piece
    except ConnectionResetError:  # what we still sent met a closed door
        pass
    head, _, body = response.partition(b"\r\n\r\n")
    return head, body


def assert_problem(response: tuple[bytes, bytes], status: int, kind: str) -> None:
    head, body = response
    assert head.startswith(f"HTTP/1.1 {status} ".encode()), response
    assert b"content-type: application/problem+json" in head.lower()
    assert b"connection: close" in head.lower()
    problem = json.loads(body)
    assert (problem["status"], problem["type"]) == (status, f"/problems/{kind}")
    assert problem["detail"] and problem["title"]


def test_clients_that_trickle_slow_nobody_and_leave_nothing(live: tuple[str, int], data: Path) -> None:
    openings = (b"G", b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ", HEAD, JSON_HEAD)
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(client_of(live)) for _ in range(10 * len(openings))]
        for client, head in zip(clients, openings * 10, strict=True):
            client.sendall(head)
        for _ in range(3):
            for client in clients:
                client.sendall(b" ")
            assert httpx.get(f"http://127.0.0.1:{live[1]}/healthz").status_code == 200
    until(lambda: not list((data / "tmp").iterdir()))


def test_no_answer_waits_for_the_client_to_confirm_the_one_before(tmp_path: Path) -> None:
    with running(tmp_path / "data") as server, client_of(address_of(server)):
        until(lambda: server.server_state.connections)
        [connection] = server.server_state.connections
        served_by = cast("Any", connection).transport.get_extra_info("socket")
        assert served_by.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_body_a_few_times_too_long_is_answered(live: tuple[str, int]) -> None:
    url = f"http://127.0.0.1:{live[1]}/lift"
    with httpx.Client(timeout=PATIENCE_SECONDS) as client:
        for _ in range(2):  # a connection that were closed at once would often be reset before the answer is read
            response = client.post(url, content=b"0" * (12 << 20), headers={"Content-Type": "application/json"})
            assert response.status_code == 413 and "connection" not in response.headers


def test_upload_that_announces_too_much_is_refused_before_it_is_sent(tmp_path: Path) -> None:
    limits = {f"max_{kind}_bytes": 1000 for kind in AssetKind}
    with serve(tmp_path / "data", **limits) as address:
        for kind, length in itertools.product(AssetKind, (1001, 10**19)):
            with client_of(address) as client:
                expects = f"Expect: 100-continue\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n"
                client.sendall(f"PUT /assets/{kind} HTTP/1.1\r\nHost: localhost\r\n{expects}".encode())
                response = answer(client)
            assert_problem(response, 413, "too-large")
            assert ("hint" in json.loads(response[1])) == (kind is AssetKind.FEATURES)


def test_answer_does_not_wait_for_the_rest_of_a_body_that_nobody_reads(live: tuple[str, int]) -> None:
    begin = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5000\r\n\r\n"
    with client_of(live) as client:
        client.sendall(begin)
        assert client.recv(1 << 16).startswith(b"HTTP/1.1 200 ")


def test_request_that_outlasts_the_time_of_a_stop_is_refused_as_a_problem(tmp_path: Path) -> None:
    with running(tmp_path, stop_seconds=0.1) as server, client_of(address_of(server)) as client:
        client.sendall(HEAD + b"ply\n")
        until(lambda: server.server_state.tasks)
        server.should_exit = True
        assert_problem(answer(client), 503, "busy")
