"""The last bytes of an answer are watched as the first are: who does not read them holds no connection."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest
import uvicorn
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from service.connection import watched
from service.limits import Pace

PATIENCE_SECONDS = 30.0
SMALL = 4096  # bytes of the buffers of each socket, so that the rest of an answer stays with the server
REST = 60_000  # bytes of an answer: below the mark at which the server is told that nobody reads


async def answering(scope: Scope, receive: Receive, send: Send) -> None:
    """As many bytes as one write takes."""
    headers = {"Connection": "close"} if scope["path"] == "/last" else {}
    await Response(b"x" * REST, headers=headers)(scope, receive, send)


@dataclass(frozen=True)
class Running:
    """A server and where it listens."""

    server: uvicorn.Server
    address: tuple[str, int]

    @property
    def open(self) -> int:
        """Connections that the server holds."""
        return len(self.server.server_state.connections)

    def connect(self) -> socket.socket:
        """A client with small buffers."""
        client = socket.socket()
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SMALL)
        client.settimeout(PATIENCE_SECONDS)
        client.connect(self.address)
        return client


def until(true: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_SECONDS
    while not true():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


@pytest.fixture
def running() -> Iterator[Running]:
    """A server that gives a client 1.1 s to read something: a busy machine may keep a thread waiting for a while."""
    listener = socket.create_server(("127.0.0.1", 0))
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SMALL)
    pace = Pace(bytes_per_second=1 << 20, grace_seconds=1.0, head_seconds=1.0)
    config = uvicorn.Config(
        answering, http=watched(pace, 10), ws="none", lifespan="off", log_level="critical",
        timeout_graceful_shutdown=1, timeout_keep_alive=1,
    )  # fmt: skip
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        until(lambda: server.started, "the server does not start")
        yield Running(server, listener.getsockname())
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


@pytest.mark.parametrize(
    "asked",
    [
        b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /last HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\nnonsense\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" * 3,
    ],
    ids=["kept alive", "closed", "refused", "three"],
)
def test_who_does_not_read_the_rest_of_an_answer_is_cut_off(running: Running, asked: bytes) -> None:
    with running.connect() as client:
        client.sendall(asked)
        until(lambda: running.server.server_state.total_requests > 0, "no answer")
        until(lambda: running.open == 0, "the connection stays")


def test_who_reads_slowly_gets_all_of_an_answer(running: Running) -> None:
    with running.connect() as client:
        client.sendall(b"GET /last HTTP/1.1\r\nHost: localhost\r\n\r\n")
        said, begun = b"", time.monotonic()
        while piece := client.recv(1000):
            said += piece
            time.sleep(0.03)
    assert time.monotonic() - begun > 1.5  # longer than a client may read nothing
    assert len(said.partition(b"\r\n\r\n")[2]) == REST
