"""Turns at the query process: one time for each call, shared fairly, and none for a client that left."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from liftcore.errors import SplatliftError
from service.errors import Busy, ClientLeft, TimedOut, TooMany
from service.queries import client
from service.queries.client import Asker, Frame, QueryClient, QueryLimits
from tests.crash.conftest import address_of, until
from tests.crash.server import NoQueries

from .guarded import guarded
from .test_slow_clients import running

# Answers a request once the file that it names is there, and writes down which it answers and what waits behind it.
STAND_IN = """
import json, sys, time
from pathlib import Path
from service.queries.client import Frame, write_frame
folder = Path(sys.argv[1])
for line in sys.stdin.buffer:
    first, *others = json.loads(line)
    with (folder / "asked").open("a") as log:
        print(json.dumps([first["name"], [other["name"] for other in others]]), file=log)
    while not (folder / first["after"]).exists():
        time.sleep(0.005)
    write_frame(sys.stdout.buffer, Frame({"name": first["name"]}))
"""
Start = Callable[..., QueryClient]


class Calls:
    """Calls in threads of their own, and what came of each by its name."""

    def __init__(self, worker: QueryClient) -> None:
        self.worker, self.came = worker, dict[str, str]()
        self._threads: list[threading.Thread] = []

    def begin(self, name: str, asker: Asker, after: str = "open") -> None:
        """Call, and return once it waits or is asked."""
        known, asked = self.worker.waiting, {"operation": "query", "name": name, "after": after}

        def run() -> None:
            try:
                self.came[name] = self.worker.call(asked, asker).header["name"]
            except SplatliftError as error:
                self.came[name] = error.kind

        self._threads.append(threading.Thread(target=run))
        self._threads[-1].start()
        until(lambda: self.worker.waiting > known or name in self.came or self.worker._busy_with is not None)

    def end(self) -> None:
        """Wait for all of them."""
        for thread in self._threads:
            thread.join()


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Start]:
    """Start workers that stand in for the query process."""
    original, started = client.subprocess.Popen, list[QueryClient]()
    (tmp_path / "at once").touch()

    def run(command: list[str], **how: Any) -> Any:
        return original([command[0], "-c", STAND_IN, str(tmp_path)], **how)

    def begin(*, seconds: float = 120.0, of_a_key: int | None = None, waiting: int = 16) -> QueryClient:
        limits = QueryLimits(waiting, seconds, scenes=1, cache_bytes=0, encoder="lvis", of_a_key=of_a_key)
        started.append(QueryClient(limits))
        started[-1].start()
        return started[-1]

    monkeypatch.setattr(client.subprocess, "Popen", run)
    yield begin
    (tmp_path / "open").touch()
    for worker in started:
        worker.stop()


def asked(folder: Path) -> list[tuple[str, list[str]]]:
    """The calls that were asked, with those that were told to wait behind each."""
    return [tuple(json.loads(line)) for line in (folder / "asked").read_text().splitlines()]


def test_keys_take_turns_however_many_calls_one_has(start: Start, tmp_path: Path) -> None:
    calls, anna, bob = Calls(start()), Asker("anna"), Asker("bob")
    for name in ("a0", "a1", "a2", "a3"):
        calls.begin(name, anna)
    for name in ("b0", "b1"):
        calls.begin(name, bob)
    until(lambda: calls.worker.waiting == 5)
    (tmp_path / "open").touch()
    calls.end()
    assert [first for first, _ in asked(tmp_path)] == ["a0", "b0", "a1", "b1", "a2", "a3"]
    assert sorted(asked(tmp_path)[1][1]) == ["a1", "a2", "a3", "b1"]  # so that one pass answers all of them
    assert calls.came == {name: name for name in ("a0", "a1", "a2", "a3", "b0", "b1")}


def test_call_whose_client_left_is_not_asked(start: Start, tmp_path: Path) -> None:
    calls, stays, leaves = Calls(start()), Asker(), Asker()
    calls.begin("first", stays)
    calls.begin("gone", leaves)
    calls.worker.leave(leaves)
    until(lambda: "gone" in calls.came)  # at once, while the first is still asked
    assert calls.came == {"gone": ClientLeft.kind}
    calls.begin("last", stays)
    (tmp_path / "open").touch()
    calls.end()
    assert asked(tmp_path) == [("first", []), ("last", [])] and calls.came["last"] == "last"


@pytest.mark.parametrize(("of_a_key", "waiting", "share"), [(2, 16, 2), (16, 4, 3)])
def test_key_has_a_share_of_the_places(start: Start, of_a_key: int, waiting: int, share: int) -> None:
    calls = Calls(start(of_a_key=of_a_key, waiting=waiting))
    for number in range(share + 1):
        calls.begin(f"a{number}", Asker("anna"))
    until(lambda: calls.came == {f"a{share}": TooMany.kind})
    calls.begin("b", Asker("bob"))
    assert "b" not in calls.came
    for number in range(waiting - share):
        calls.begin(f"c{number}", Asker(f"carl{number}"))
    until(lambda: len(calls.came) == 2)
    assert Busy.kind in calls.came.values()  # beyond all places
    until(lambda: calls.worker.waiting == waiting - 1)


def test_every_call_has_one_time_for_waiting_and_answer(start: Start, tmp_path: Path) -> None:
    worker = start(seconds=4.0)  # a process begins within it, on a busy machine too
    calls = Calls(worker)
    for name in ("never", "behind"):
        calls.begin(name, Asker(), after="never")
    calls.end()
    assert calls.came["never"] == TimedOut.kind and calls.came["behind"] in (TimedOut.kind, Busy.kind)
    assert worker.call({"operation": "query", "name": "next", "after": "at once"}) == Frame({"name": "next"})


def test_process_that_reads_nothing_holds_the_turn_no_longer(start: Start) -> None:
    worker = start(seconds=4.0)
    request = {"operation": "query", "name": "x", "after": "at once"}
    worker.call(request)
    process = worker._process
    assert process is not None
    os.kill(process.pid, signal.SIGSTOP)
    with pytest.raises(TimedOut):
        worker.call(request | {"padding": "x" * 1_000_000})  # more than a pipe holds
    assert worker.call(request) == Frame({"name": "x"})


def test_stop_answers_who_waits(start: Start) -> None:
    calls = Calls(start())
    for name in ("asked", "waits"):
        calls.begin(name, Asker())
    calls.worker.stop()
    calls.end()
    assert set(calls.came.values()) == {Busy.kind}


class Patient(NoQueries):
    """Stands in for the query process: a call waits until its client has left."""

    def __init__(self) -> None:
        self.askers: list[Asker] = []

    def call(self, request: dict[str, Any], asker: Asker) -> Frame:
        self.askers.append(asker)
        until(lambda: asker.left)
        raise ClientLeft("query", expected="a client that waits", got="one that left")

    def leave(self, asker: Asker) -> None:
        asker.left = True


@pytest.mark.parametrize("method", ["GET", "POST"])
def test_closed_connection_is_a_client_that_left(tmp_path: Path, method: str) -> None:
    with guarded(tmp_path / "data") as house:
        lift, secret = house.done, house.secrets["alice"]
    body = json.dumps({"text": ["x"], "lift": lift})
    path = f"/query/scores?text=x&lift={lift}" if method == "GET" else "/query/scores"
    head = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {secret}\r\n"
    sent = {"GET": "\r\n", "POST": f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n{body}"}
    queries = Patient()
    chosen = {"text_spaces": {"t": "lvis"}}
    with running(tmp_path / "data", queries=cast("QueryClient", queries), **chosen) as server:
        with socket.create_connection(address_of(server), timeout=60) as connection:
            connection.sendall((head + sent[method]).encode())
            until(lambda: queries.askers)
            assert not queries.askers[0].left and queries.askers[0].key == house.ids["alice"]
        until(lambda: queries.askers[0].left)
        until(lambda: not server.server_state.connections)
