"""Children and the query process: orders, limits, kills from outside, and nothing that is left."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.errors import Busy, Fault, InvalidRequest, OutOfTime, TimedOut
from service.process import Children
from service.query_client import QueryClient
from tests.promises.bad_files import BAD_FILES, BadFile
from tests.server import until
from tests.tiny_scene import cameras_document, cameras_json, ply, splat_rows

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def children() -> Iterator[Children]:
    children = Children()
    yield children
    children.stop()
    assert not running()


def running() -> list[int]:
    """Return the ids of child processes of this one that run service.process or service.query_worker."""
    ids = []
    for task in Path("/proc/self/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # a thread or a child that ends meanwhile
            for child in (task / "children").read_text().split():
                command = Path(f"/proc/{child}/cmdline").read_bytes()
                if b"service.process" in command or b"service.query_worker" in command:
                    ids.append(int(child))
    return ids


def check_of(folder: Path, kind: str, content: bytes, **more: Any) -> dict[str, Any]:
    """Return the order of the check of a file."""
    file = folder / "upload"
    file.write_bytes(content)
    return {
        "task": "check",
        "kind": kind,
        "file": str(file),
        "scratch": str(folder),
        "names": {str(file): kind},
    } | more


def check_cameras(children: Children, folder: Path) -> None:
    """Check good cameras in a child, which takes them."""
    result = children.result_of(check_of(folder, "cameras", cameras_json()), 600, "cameras")
    assert (result["suffix"], result["counts"]["views"]) == (".json", 3)


def kill(signal_number: int) -> None:
    for process in running():
        os.kill(process, signal_number)


def test_child_of_a_check_is_used_again(children: Children, tmp_path: Path) -> None:
    for _ in range(3):
        check_cameras(children, tmp_path)
    before = running()
    with pytest.raises(Fault) as error:
        children.result_of(check_of(tmp_path, "cameras", b"{"), 600, "cameras")
    assert error.value.fault["status"] == 422 and str(tmp_path) not in json.dumps(error.value.fault)
    assert running() == before


def test_order_beyond_its_time_or_memory_is_refused(children: Children, tmp_path: Path) -> None:
    order = check_of(tmp_path, "splats", ply(np.repeat(splat_rows(), 20_000, axis=0)))
    with pytest.raises(OutOfTime, match="it took more than"):
        children.result_of(order, 0.0, "splats")
    with pytest.raises((Fault, InvalidRequest)):
        children.result_of(order | {"memory": 1 << 20}, 600, "splats")
    check_cameras(children, tmp_path)


def test_children_that_are_killed_or_stopped_are_replaced(children: Children, tmp_path: Path) -> None:
    for signal_number in (signal.SIGKILL, signal.SIGSTOP):
        until(children.is_ready)
        kill(signal_number)
        check_cameras(children, tmp_path)


def test_reason_ends_an_order_with_its_group(children: Children, tmp_path: Path) -> None:
    until(children.is_ready)
    began = time.monotonic()
    order = check_of(tmp_path, "cameras", cameras_json())
    ending = children.run(order, 600, why_end=lambda: "it is canceled")
    if ending.last is None:  # the check may have been faster than the first look
        assert ending.reason == "it is canceled"
    assert time.monotonic() - began < 300 and children.count() == 0


def names_in_emoji() -> bytes:
    """Return cameras that a reader takes, with longer names than a reply has."""
    frame = cameras_document()["frames"][0]
    frames = [frame | {"file_path": str(number) + "\U0001f600" * 490} for number in range(10_000)]
    return json.dumps(cameras_document() | {"frames": frames}).encode()


BOMBS = [row for row in BAD_FILES if row.bomb and row.kind in ("splats", "cameras")]
BOMBS.append(BadFile("cameras", "10,000 names in emoji", names_in_emoji, ""))


@pytest.mark.parametrize("row", BOMBS, ids=lambda row: row.name)
def test_bomb_is_refused_with_reasons(children: Children, tmp_path: Path, row: BadFile) -> None:
    with pytest.raises(Fault) as error:
        children.result_of(check_of(tmp_path, row.kind, row.data(), memory=1 << 30), 600, row.kind)
    fault = error.value.fault
    assert fault["status"] == 422 and fault["expected"] and fault["got"] and len(json.dumps(fault)) < 5000


# The query process


REQUEST = {
    "task": "reply", "kind": "query", "scratch": "/nowhere", "draft": "/nowhere/draft", "head": {},
    "operation": "query", "lift": "/nowhere/lift", "splats": "/nowhere/splats", "cameras": "/nowhere/cameras",
    "kernel": "3dgs", "world": {}, "names": {"/nowhere": "the data"}, "encoder": None, "encoder_version": None,
    "query": {"like": ["splat:1"]}, "view": None, "top": 1, "links": {},
}  # fmt: skip


@pytest.fixture(scope="module")
def queries() -> Iterator[QueryClient]:
    client = QueryClient("lvis", 600)
    yield client
    client.stop()


def fault_of_request(queries: QueryClient) -> dict[str, Any]:
    with pytest.raises(Fault) as error:
        queries.call(REQUEST)
    return error.value.fault


@pytest.mark.parametrize(
    "change", [{"lift": None}, {"splats": 1}, {"kernel": "none"}, {"encoder": "lvis", "lift": []}]
)
def test_unforeseen_error_fails_its_question_alone(queries: QueryClient, change: dict[str, Any]) -> None:
    fault = fault_of_request(queries)
    process = running()
    with pytest.raises(Fault) as error:
        queries.call(REQUEST | change)
    assert (error.value.fault["status"], error.value.fault["type"]) == (500, "/problems/crashed")
    assert fault_of_request(queries) == fault
    assert running() == process  # the same one answers


def test_query_process_that_is_killed_is_replaced(queries: QueryClient) -> None:
    fault = fault_of_request(queries)
    assert fault["status"] in (404, 422) and "/nowhere/lift" not in json.dumps(fault)
    kill(signal.SIGKILL)
    assert fault_of_request(queries) == fault
    thread = threading.Thread(target=lambda: (time.sleep(0.05), kill(signal.SIGKILL)))
    thread.start()
    assert fault_of_request(queries) == fault  # killed while it answers: the next one does
    thread.join()
    until(queries.is_ready)


def test_query_beyond_its_time_is_refused() -> None:
    client = QueryClient("lvis", 0.0)
    with pytest.raises(TimedOut):
        client.call(REQUEST)
    client.stop()


def test_calls_beyond_the_line_or_after_the_stop_are_refused(queries: QueryClient) -> None:
    outcomes = list[type[BaseException] | None]()

    def ask() -> None:
        try:
            queries.call(REQUEST)
        except (Fault, Busy) as error:
            outcomes.append(type(error))

    kill(signal.SIGSTOP)  # nobody is answered until it is replaced
    threads = [threading.Thread(target=ask) for _ in range(30)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(outcomes) <= {Fault, Busy} and Fault in outcomes
    queries.stop()
    with pytest.raises(Busy):
        queries.call(REQUEST)
