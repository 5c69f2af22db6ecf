"""Nobody may keep a connection by being slow: what clients must keep up with, over real sockets."""

from __future__ import annotations

import hashlib
import itertools
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

from service.app import create_app, job_limits
from service.connection import UNREAD_BYTES, Pace, Patience, Wait
from service.jobs.supervisor import Supervisor
from service.models import AssetKind
from service.queries.client import QueryClient
from service.settings import ServiceSettings
from service.store.assets import CheckedUpload
from service.store.owners import SERVICE
from service.store.store import Store
from tests.crash.conftest import address_of, listening, until
from tests.crash.server import NoQueries

TRIES = 10
PATIENCE_SECONDS = 60.0  # for what takes half a second; the machine may be busy
HEALTH = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
HEAD = b"PUT /assets/splats HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5000\r\n\r\n"
JSON_HEAD = (
    b"POST /lift HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 5000\r\n\r\n"
)
Served = Callable[..., AbstractContextManager[tuple[str, int]]]


@contextmanager
def served(data: Path, **settings: Any) -> Iterator[tuple[str, int]]:
    """A server in a thread: host and port. It is in no hurry, unless told to be."""
    with running(data, **settings) as server:
        yield address_of(server)


@contextmanager
def running(data: Path, queries: QueryClient | None = None, **settings: Any) -> Iterator[uvicorn.Server]:
    """That server, to look into it; without a query process, unless one is given."""
    patient = {"min_bytes_per_second": 1000, "slow_grace_seconds": 30, "header_seconds": 30, "notice_seconds": 0}
    chosen = ServiceSettings.model_validate({"data": data, "disk_floor_bytes": 0, **patient, **settings})
    store = Store.open(chosen.data)
    worker = queries or cast("QueryClient", NoQueries())
    try:
        with listening(create_app(chosen, store, Supervisor(store, job_limits(chosen)), worker), chosen) as server:
            yield server
    finally:
        store.close()


@pytest.fixture(scope="module")
def data_of_patient(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("patient") / "data"


@pytest.fixture(scope="module")
def patient(data_of_patient: Path) -> Iterator[tuple[str, int]]:
    """A server in no hurry."""
    with served(data_of_patient) as address:
        yield address


@pytest.fixture(scope="module")
def data_of_brisk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("brisk") / "data"


@pytest.fixture(scope="module")
def brisk(data_of_brisk: Path) -> Iterator[tuple[str, int]]:
    """A server that wants 1,000 bytes of a body a second, over half a second, and takes its time over headers."""
    with served(data_of_brisk, slow_grace_seconds=0.5) as address:
        yield address


@pytest.fixture(scope="module")
def curt(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, int]]:
    """A server that wants headers within half a second."""
    with served(tmp_path_factory.mktemp("curt") / "data", header_seconds=0.5) as address:
        yield address


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


def trickle(client: socket.socket, begin: bytes, byte: bytes) -> tuple[bytes, bytes]:
    """Send a beginning, then a byte at a time, until the server has had enough; what it says."""

    def drip() -> None:
        deadline = time.monotonic() + PATIENCE_SECONDS
        try:
            client.sendall(begin)
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


def trickle_anew(address: tuple[str, int], begin: bytes, byte: bytes) -> tuple[bytes, bytes]:
    """Trickle over a new connection; over another one if the clock ran out before our first byte came."""
    for _ in range(TRIES):
        with client_of(address) as client:
            said = trickle(client, begin, byte)
        if said != (b"", b""):
            return said
    raise AssertionError("closed without a word, again and again")


def assert_problem(said: tuple[bytes, bytes], status: int, kind: str) -> None:
    head, body = said
    assert head.startswith(f"HTTP/1.1 {status} ".encode()), said
    assert b"content-type: application/problem+json" in head.lower()
    assert b"connection: close" in head.lower()
    problem = json.loads(body)
    assert (problem["status"], problem["type"]) == (status, f"/problems/{kind}")
    assert problem["detail"] and problem["title"]


@pytest.mark.parametrize("head", [HEAD, JSON_HEAD], ids=["upload", "json"])
def test_body_that_trickles_or_does_not_come_is_408_and_leaves_no_draft(
    brisk: tuple[str, int], data_of_brisk: Path, head: bytes
) -> None:
    with client_of(brisk) as client:
        assert_problem(trickle(client, head, b" "), 408, "too-slow")
    with client_of(brisk) as client:
        client.sendall(head)
        assert_problem(answer(client), 408, "too-slow")
    until(lambda: not list((data_of_brisk / "tmp").iterdir()))


def test_upload_that_breaks_off_leaves_nothing(patient: tuple[str, int], data_of_patient: Path) -> None:
    with client_of(patient) as client:
        client.sendall(HEAD.replace(b"5000", b"9000000") + b"p" * 2_000_000)
        until(lambda: any((data_of_patient / "tmp").iterdir()))
    until(lambda: not any((data_of_patient / "tmp").iterdir()))
    assert httpx.get(f"http://127.0.0.1:{patient[1]}/assets").json()["assets"] == []


MOST = 10 + UNREAD_BYTES / 1000  # seconds of a reader


@pytest.mark.parametrize(
    ("wait", "steps", "over_at"),
    [
        (Wait.BODY, [(seconds, seconds * 5000) for seconds in range(0, 600, 2)], None),
        (Wait.BODY, [(seconds, seconds * 1100) for seconds in range(0, 600, 2)], None),
        (Wait.BODY, [(seconds, seconds * 900) for seconds in range(0, 22, 2)], 10),
        (Wait.BODY, [(0, 0), (10, 10**6), (19, 10**6), (20, 10**6)], 20),  # fast, and then it stalls
        (Wait.HEAD, [(0, 0), (19, 19), (20, 20)], 20),  # whatever trickles
        (Wait.READER, [(0, 0), (MOST - 1, 1), (2 * MOST - 2, 1), (2 * MOST, 1)], 2 * MOST),
        (Wait.NOTHING, [(0, 0), (10**6, 0)], None),  # work of the server is nobody's fault
    ],
)
def test_patience_ends_with_who_keeps_the_server_waiting(
    wait: Wait, steps: list[tuple[float, int]], over_at: float | None
) -> None:
    patience = Patience(Pace(bytes_per_second=1000, grace_seconds=10, head_seconds=20))
    ends = [seconds for seconds, moved in steps if patience.is_over(wait, 0, moved, 1000 + seconds)]
    assert (ends[0] if ends else None) == over_at


def test_each_request_has_its_own_time() -> None:
    patience = Patience(Pace(head_seconds=1))
    assert not any(patience.is_over(Wait.HEAD, turn, 0, turn) for turn in range(9))


def test_headers_that_trickle_are_408_and_closed(curt: tuple[str, int]) -> None:
    for begin in (b"G", b"GET / HTTP/1.1\r\nHost: localhost\r\n"):  # within a line, and within headers
        assert_problem(trickle_anew(curt, begin, b"a"), 408, "too-slow")


def test_headers_that_trickle_after_an_answer_are_408_and_closed(curt: tuple[str, int]) -> None:
    said, body = trickle_anew(curt, HEALTH + b"GET ", b"a")
    assert said.startswith(b"HTTP/1.1 200 ")
    health, _, refused = body.partition(b"HTTP/1.1 ")
    assert b"ok" in health
    head, _, problem = refused.partition(b"\r\n\r\n")
    assert_problem((b"HTTP/1.1 " + head, problem), 408, "too-slow")


def test_connection_without_a_word_is_closed_without_one(curt: tuple[str, int]) -> None:
    with client_of(curt) as client:
        assert answer(client) == (b"", b"")


def test_body_that_trickles_on_after_its_answer_is_cut_off(curt: tuple[str, int]) -> None:
    head = HEALTH[:-2] + b"Content-Length: 5000\r\n\r\n"
    said, body = trickle_anew(curt, head, b" ")
    assert said.startswith(b"HTTP/1.1 200 ") and b"ok" in body


def test_more_connections_than_allowed_are_503_until_one_ends(tmp_path: Path) -> None:
    with served(tmp_path / "data", max_connections=2, header_seconds=60) as address:
        # They come in the order in which they are made, and stay as long as nothing is asked.
        with client_of(address), client_of(address), client_of(address) as third:
            said = answer(third)
            assert_problem(said, 503, "busy")
            assert b"retry-after: " in said[0].lower()
        until(lambda: httpx.get(f"http://127.0.0.1:{address[1]}/healthz").status_code == 200)


def stored(store: Store, content: bytes) -> str:
    """The path of content that a server over a store will have."""
    digest = hashlib.sha256(content).hexdigest()
    with store.files.draft(".ply") as draft:
        draft.write_bytes(content)
        store.assets.add(SERVICE, CheckedUpload(draft, AssetKind.SPLATS, digest, ".ply", {}, []))
    return f"/assets/sha256:{digest}/content"


def test_client_that_does_not_read_is_cut_off(tmp_path: Path) -> None:
    """Both while we are held up, and once all is sent and lies in buffers."""
    contents = [bytes(size) for size in (33_000_000, 3_000_000)]
    store = Store.open(tmp_path / "data")
    paths = [stored(store, content) for content in contents]
    store.close()
    with running(tmp_path / "data", min_bytes_per_second=1 << 20, slow_grace_seconds=0.5) as server:
        address = address_of(server)
        for path, content in zip(paths, contents, strict=True):
            with socket.socket() as client:
                client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                client.settimeout(PATIENCE_SECONDS)
                client.connect(address)
                client.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
                until(lambda: server.server_state.connections)
                until(lambda: not server.server_state.connections)
                head, body = answer(client)
            assert head.startswith(b"HTTP/1.1 200 ") and len(body) < len(content)


def test_two_lengths_of_a_body_are_refused_and_the_connection_is_closed(patient: tuple[str, int]) -> None:
    with client_of(patient) as client:
        both = b"Content-Length: 4\r\nTransfer-Encoding: chunked\r\nContent-Type: application/json\r\n\r\n"
        client.sendall(b"POST /lift HTTP/1.1\r\nHost: localhost\r\n" + both + b"0\r\n\r\n" + HEALTH)
        head, body = answer(client)
    assert head.startswith(b"HTTP/1.1 422 ") and b"connection: close" in head.lower()
    assert json.loads(body)["argument"] == "Content-Length"  # and nothing comes after it


def test_body_a_few_times_too_long_is_answered(patient: tuple[str, int]) -> None:
    url = f"http://127.0.0.1:{patient[1]}/lift"
    with httpx.Client(timeout=PATIENCE_SECONDS) as client:
        for _ in range(2):  # a connection that were closed at once would often be reset before the answer is read
            said = client.post(url, content=b"0" * (12 << 20), headers={"Content-Type": "application/json"})
            assert said.status_code == 413 and "connection" not in said.headers


def test_upload_that_announces_too_much_is_refused_before_it_is_sent(tmp_path: Path) -> None:
    limits = {f"max_{kind}_bytes": 1000 for kind in AssetKind}
    with served(tmp_path / "data", **limits) as address:
        for kind, length in itertools.product(AssetKind, (1001, 10**19)):
            with client_of(address) as client:
                expects = f"Expect: 100-continue\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n"
                client.sendall(f"PUT /assets/{kind} HTTP/1.1\r\nHost: localhost\r\n{expects}".encode())
                said = answer(client)
            assert_problem(said, 413, "too-large")
            assert ("hint" in json.loads(said[1])) == (kind is AssetKind.FEATURES)


def test_answer_that_began_goes_on_whatever_comes_of_the_body(brisk: tuple[str, int]) -> None:
    begin = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5000\r\n\r\n"
    with client_of(brisk) as client:
        client.sendall(begin)
        assert client.recv(1 << 16).startswith(b"HTTP/1.1 200 ")
