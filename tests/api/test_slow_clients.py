"""Nobody may keep a connection by being slow: what clients must keep up with, over real sockets."""

from __future__ import annotations

import hashlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, cast

import httpx
import pytest
import uvicorn

from service.app import create_app, lift_limits, pace_of
from service.connection import watched
from service.jobs.supervisor import Supervisor
from service.queries.warm import WarmWorker
from service.settings import ServiceSettings
from service.store.assets import CheckedUpload
from service.store.store import Store
from service.wire import AssetKind
from tests.crash.server import NoQueries

PATIENCE_SECONDS = 30.0  # for what takes half a second; the machine may be busy
HEAD = b"PUT /assets/splats HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5000\r\n\r\n"
JSON_HEAD = (
    b"POST /lift HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 5000\r\n\r\n"
)
Served = Callable[..., AbstractContextManager[tuple[str, int]]]


@contextmanager
def served(data: Path, **settings: Any) -> Iterator[tuple[str, int]]:
    """A server in a thread: host and port. A body needs 1,000 bytes a second here, over half a second."""
    quick = {"min_bytes_per_second": 1000, "slow_grace_seconds": 0.5, "header_seconds": 0.5}
    chosen = ServiceSettings.model_validate({"data": data, "disk_floor_bytes": 0, **quick, **settings})
    store = Store.open(chosen.data)
    app = create_app(chosen, store, Supervisor(store, lift_limits(chosen)), cast("WarmWorker", NoQueries()))
    listener = socket.create_server(("127.0.0.1", 0))
    connection = watched(pace_of(chosen), chosen.max_connections)
    server = uvicorn.Server(uvicorn.Config(app, http=connection, log_level="critical"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        while not server.started:
            time.sleep(0.01)
        yield listener.getsockname()
    finally:
        server.should_exit = True
        thread.join()
        store.close()
        listener.close()


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, int]]:
    with served(tmp_path_factory.mktemp("slow") / "data") as address:
        yield address


@pytest.fixture(scope="module")
def drafts(address: tuple[str, int], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return next(tmp_path_factory.getbasetemp().glob("slow*/data/tmp"))


@contextmanager
def client_of(address: tuple[str, int]) -> Iterator[socket.socket]:
    with socket.create_connection(address, timeout=PATIENCE_SECONDS) as client:
        yield client


def answer(client: socket.socket) -> tuple[bytes, bytes]:
    """Head and body of all that comes until the server closes; fails when it does not."""
    said = b""
    try:
        while piece := client.recv(1 << 16):
            said += piece
    except ConnectionResetError:  # what we still sent met a closed door
        pass
    head, _, body = said.partition(b"\r\n\r\n")
    return head, body


def ask_for_health(client: socket.socket) -> None:
    """One request over a connection that stays open."""
    client.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
    said = b""
    while b"ok" not in said.partition(b"\r\n\r\n")[2]:
        said += client.recv(1 << 16)
    assert said.startswith(b"HTTP/1.1 200 ")


def trickle(client: socket.socket, begin: bytes, byte: bytes) -> tuple[bytes, bytes]:
    """Send a beginning, then a byte at a time, until the server has had enough; what it says."""
    client.sendall(begin)

    def drip() -> None:
        deadline = time.monotonic() + PATIENCE_SECONDS
        try:
            while time.monotonic() < deadline:
                client.sendall(byte)
                time.sleep(0.05)
        except OSError:
            pass

    thread = threading.Thread(target=drip)
    thread.start()
    said = answer(client)
    thread.join()
    return said


def assert_problem(said: tuple[bytes, bytes], status: int, kind: str) -> None:
    head, body = said
    assert head.startswith(f"HTTP/1.1 {status} ".encode()), said
    assert b"content-type: application/problem+json" in head.lower()
    assert b"connection: close" in head.lower()
    problem = json.loads(body)
    assert (problem["status"], problem["type"]) == (status, f"/problems/{kind}")
    assert problem["detail"] and problem["title"]


@pytest.mark.parametrize("head", [HEAD, JSON_HEAD], ids=["upload", "json"])
def test_body_that_trickles_is_408_and_closed_and_leaves_no_draft(
    address: tuple[str, int], drafts: Path, head: bytes
) -> None:
    with client_of(address) as client:
        assert_problem(trickle(client, head, b" "), 408, "too-slow")
    deadline = time.monotonic() + PATIENCE_SECONDS
    while list(drafts.iterdir()):
        assert time.monotonic() < deadline, "the draft stays"
        time.sleep(0.01)


@pytest.mark.parametrize("head", [HEAD, JSON_HEAD], ids=["upload", "json"])
def test_body_that_does_not_come_is_408(address: tuple[str, int], head: bytes) -> None:
    with client_of(address) as client:
        client.sendall(head)
        assert_problem(answer(client), 408, "too-slow")


def test_body_that_comes_fast_and_then_trickles_is_408(address: tuple[str, int]) -> None:
    with client_of(address) as client:
        head = HEAD.replace(b"5000", b"500000")
        assert_problem(trickle(client, head + b" " * 200_000, b" "), 408, "too-slow")


def test_body_at_five_times_the_least_speed_is_taken(address: tuple[str, int]) -> None:
    with client_of(address) as client:
        client.sendall(JSON_HEAD.replace(b"Host: localhost\r\n", b"Host: localhost\r\nConnection: close\r\n"))
        for _ in range(20):
            client.sendall(b" " * 250)
            time.sleep(0.05)
        head, _ = answer(client)
    assert head.startswith(b"HTTP/1.1 422 ")  # read to its end, and found to be no order


@pytest.mark.parametrize("begin", [b"G", b"GET / HTTP/1.1\r\nHost: localhost\r\n"], ids=["line", "headers"])
def test_headers_that_trickle_are_408_and_closed(address: tuple[str, int], begin: bytes) -> None:
    with client_of(address) as client:
        assert_problem(trickle(client, begin, b"a"), 408, "too-slow")


def test_headers_that_trickle_after_an_answer_are_408_and_closed(address: tuple[str, int]) -> None:
    with client_of(address) as client:
        ask_for_health(client)
        assert_problem(trickle(client, b"GET ", b"a"), 408, "too-slow")


def test_connection_without_a_word_is_closed_without_one(address: tuple[str, int]) -> None:
    with client_of(address) as client:
        assert answer(client) == (b"", b"")


def test_body_that_trickles_on_after_its_answer_is_cut_off(address: tuple[str, int]) -> None:
    with client_of(address) as client:
        head = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5000\r\n\r\n"
        said, body = trickle(client, head, b" ")
    assert said.startswith(b"HTTP/1.1 200 ") and b"ok" in body


@pytest.mark.parametrize(
    "nonsense",
    [
        b"nonsense\r\n\r\n",
        b"\x16\x03\x01" * 10 + b"\r\n\r\n",
    ],
    ids=["no HTTP", "TLS"],
)
def test_what_is_no_http_is_400_in_the_one_shape(address: tuple[str, int], nonsense: bytes) -> None:
    with client_of(address) as client:
        client.sendall(nonsense)
        assert_problem(answer(client), 400, "malformed-request")


def test_headers_without_an_end_are_431(address: tuple[str, int]) -> None:
    with client_of(address) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nA: " + b"a" * 200_000)
        assert_problem(answer(client), 431, "headers-too-large")


def test_chunk_without_a_length_is_400_in_the_one_shape(address: tuple[str, int]) -> None:
    with client_of(address) as client:
        client.sendall(b"PUT /assets/splats HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n")
        assert_problem(answer(client), 400, "malformed-request")


def test_more_connections_than_allowed_are_503_until_one_ends(tmp_path: Path) -> None:
    with served(tmp_path / "data", max_connections=2, header_seconds=20) as address:
        with client_of(address) as first, client_of(address) as second:
            for client in (first, second):
                ask_for_health(client)
            with client_of(address) as third:
                said = answer(third)
                assert_problem(said, 503, "busy")
                assert b"retry-after: " in said[0].lower()
        deadline = time.monotonic() + PATIENCE_SECONDS
        while httpx.get(f"http://127.0.0.1:{address[1]}/healthz").status_code != 200:
            assert time.monotonic() < deadline


def test_client_that_does_not_read_is_cut_off(tmp_path: Path) -> None:
    content = bytes(33_000_000)  # more than the buffers between us hold
    digest = hashlib.sha256(content).hexdigest()
    store = Store.open(tmp_path / "data")
    with store.files.draft(".ply") as draft:
        draft.write_bytes(content)
        store.assets.add(CheckedUpload(draft, AssetKind.SPLATS, digest, ".ply", {}, []))
    store.close()
    with served(tmp_path / "data", min_bytes_per_second=1 << 20) as address:
        path = f"/assets/sha256:{digest}/content"
        with client_of(address) as client:
            client.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            time.sleep(2)
            head, body = answer(client)
        assert head.startswith(b"HTTP/1.1 200 ") and len(body) < len(content)
        assert httpx.get(f"http://127.0.0.1:{address[1]}{path}", timeout=PATIENCE_SECONDS).content == content
