"""Promises of jobs whose processes die, freeze, exceed their memory or are canceled."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
import torch

import liftcore as lc
from liftcore.io.splats import write_splats
from liftcore.io.transforms import transforms_of
from liftcore.values.pack import write_pack
from service import sandbox, uploads
from service.job_child import Reporter
from service.models import AssetKind, JobState
from service.observe import JsonLines
from service.store.jobs import MAX_ATTEMPTS, EventKind
from service.store.keys import Quota
from service.store.owners import SERVICE, Owner, Scope
from service.store.store import Store
from service.supervisor import LONGEST, JobProcess, Lease
from service.tasks import lift_as_ordered
from tests.scenes import look_at, random_splats

from .conftest import Supervising, alive, order, state_of, supervised, until, wait_until_ended


def submit(store: Store, **settings: Any) -> str:
    return store.jobs.submit(SERVICE, order(store, **settings))[0]


def states(store: Store, job: str) -> list[str]:
    return [event.data["state"] for event in store.jobs.events(SERVICE, job, 0) if event.kind is EventKind.STATE]


def log_of(store: Store, job: str) -> str:
    lines = [event.data["line"] for event in store.jobs.events(SERVICE, job, 0) if event.kind is EventKind.LOG]
    return "\n".join(lines)


def pids(store: Store, job: str) -> list[int]:
    path = store.files.work(job) / "attempts"
    return [int(pid) for pid in path.read_text().split()] if path.exists() else []


@pytest.mark.parametrize(
    ("behaviour", "limit", "state", "attempt", "problem"),
    [
        ("die", {}, JobState.FAILED, MAX_ATTEMPTS, "signal 9"),
        ("die_once", {}, JobState.SUCCEEDED, 2, None),
        ("hang", {"seconds": 0.5}, JobState.FAILED, 1, "0.5 s"),
        ("eat", {"memory_bytes": 200 << 20}, JobState.FAILED, 1, "memory"),
        ("feed", {"memory_bytes": 200 << 20}, JobState.FAILED, 1, "memory"),
    ],
)
def test_job_has_three_attempts_and_one_within_its_limits(
    store: Store,
    supervising: Supervising,
    behaviour: str,
    limit: dict[str, Any],
    state: JobState,
    attempt: int,
    problem: str | None,
) -> None:
    job = submit(store)
    with supervising(behaviour, **limit):
        record = wait_until_ended(store, job)
    assert (record.state, record.attempt) == (state, attempt)
    assert states(store, job) == ["queued", *["running", "queued"] * (attempt - 1), "running", state]
    if problem is None:
        until(lambda: not store.files.work(job).exists())  # what it went on from is removed
    else:
        assert record.problem is not None and record.problem["kind"] == ("over-limit" if limit else "crashed")
        assert problem in record.problem["expected"] + record.problem["got"]


class StoppedTime:
    """A clock that goes on while a process is stopped, and only then: on a busy machine nothing is late."""

    def __init__(self, stopped_children: Callable[[], list[int]]) -> None:
        self._stopped_children = stopped_children
        self._seconds = 0.0

    def __call__(self) -> float:
        if any(state_of(pid) == "T" for pid in self._stopped_children()):
            self._seconds += 1.0
        return self._seconds


def test_child_that_is_stopped_past_its_lease_is_fenced(store: Store, supervising: Supervising) -> None:
    job = submit(store)
    with supervising("stop_once", clock=StoppedTime(lambda: pids(store, job)), lease_seconds=10.0):
        until(lambda: pids(store, job))
        stale = pids(store, job)[0]
        record = wait_until_ended(store, job)
        assert not alive(stale)  # there is nothing left to continue
        with pytest.raises(ProcessLookupError):
            os.kill(stale, signal.SIGCONT)
    assert (record.state, record.attempt) == (JobState.SUCCEEDED, 2)
    assert "silent" in log_of(store, job)


class Watch:
    """A clock that a test sets, and a processor whose time it tells."""

    now = cpu_seconds = 0.0

    def is_over(self, lease: Lease, *, after: float, computed: float = 0.0) -> bool:
        """Return True if the lease is over, polled four times a second."""
        for _ in range(int(after * 4)):
            self.now += 0.25
            self.cpu_seconds += computed / (after * 4)
            if lease.over(lambda: self.cpu_seconds):
                return True
        return False


def test_lease_ends_with_a_silence_in_which_nothing_was_computed() -> None:
    watch = Watch()
    lease = Lease(30.0, lambda: watch.now)
    assert not watch.is_over(lease, after=29)
    lease.renew()
    assert not watch.is_over(lease, after=30)
    assert watch.is_over(lease, after=1)
    lease.renew()
    assert not watch.is_over(lease, after=300, computed=10.0)
    watch.cpu_seconds = 1.0  # what had taken the rest has ended
    assert not watch.is_over(lease, after=40, computed=5.0)
    assert watch.is_over(lease, after=60)
    lease.renew()
    watch.now += 3600  # as after a sleep of the server
    assert not lease.over(lambda: watch.cpu_seconds)
    assert not watch.is_over(lease, after=30) and watch.is_over(lease, after=1)


def test_plan_outlives_its_attempt_and_a_stale_attempt_tells_nothing(store: Store) -> None:
    job = submit(store)
    assert store.jobs.claim() is not None
    store.jobs.plan(job, 1, {"summary": []})
    store.jobs.lose(job, 1, "it was silent")
    assert store.jobs.claim() is not None
    assert store.jobs.get(SERVICE, job).plan == {"summary": []}  # until this one has planned
    store.jobs.advance(job, 1, {"stage": "old"})
    store.jobs.plan(job, 1, {"summary": ["old"]})
    store.jobs.log(job, 1, "old")
    record = store.jobs.get(SERVICE, job)
    assert (record.attempt, record.progress, record.plan) == (2, None, {"summary": []})
    assert "old" not in log_of(store, job)


def test_canceled_job_has_no_live_process(store: Store, supervising: Supervising) -> None:
    job = submit(store)
    with supervising("hang"):
        grandchild = store.files.work(job) / "grandchild"
        until(lambda: grandchild.exists() and grandchild.read_text())
        processes = [*pids(store, job), int(grandchild.read_text())]
        assert all(alive(pid) for pid in processes)
        assert store.jobs.cancel(SERVICE, job)
        until(lambda: store.jobs.get(SERVICE, job).state is JobState.CANCELED)
        assert not any(alive(pid) for pid in processes)
        assert not store.jobs.cancel(SERVICE, job)  # again does no harm
    assert states(store, job) == ["queued", "running", "canceling", "canceled"]


def test_job_interrupted_by_a_stop_goes_on_where_the_data_directory_is_next(tmp_path: Path) -> None:
    with closing(Store.open(tmp_path / "data")) as store:
        job = submit(store)
        with supervised(store, "hang"):
            until(lambda: pids(store, job))
        assert store.jobs.get(SERVICE, job).state is JobState.QUEUED
        assert not any(alive(pid) for pid in pids(store, job))
    with closing(Store.open((tmp_path / "data").rename(tmp_path / "moved"))) as store:
        with supervised(store, "answer"):
            record = wait_until_ended(store, job)
        assert (record.state, record.attempt) == (JobState.SUCCEEDED, 2)
        path = store.lifts.get(SERVICE, job).path
        assert path.is_relative_to(tmp_path / "moved") and path.exists()


OCCUPATIONS = {
    "listens": "own.wait()",
    "is deaf": "sum(range(10**15))  # in one call of C",
    "is stopped": "os.kill(os.getpid(), signal.SIGSTOP)",
}


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a process must listen to notice it")
@pytest.mark.parametrize("occupation", OCCUPATIONS)
def test_job_process_and_what_it_started_end_with_their_server(occupation: str) -> None:
    code = f"""if True:
        import os, signal, subprocess, sys
        from service.child import end_with_parent
        own = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"])
        end_with_parent(0)
        print(own.pid, flush=True)
        {OCCUPATIONS[occupation]}
    """
    command = [sys.executable, "-c", code]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
    assert child.stdin is not None and child.stdout is not None
    grandchild = int(child.stdout.readline())
    assert alive(grandchild)
    child.stdin.close()  # as when the server is killed
    child.stdout.close()
    assert child.wait() == -signal.SIGKILL
    until(lambda: not alive(grandchild))


DEAF = """
import os, pathlib

def run(output):
    pathlib.Path(output).write_text(str(os.getpid()))
    sum(range(10**15))  # in one call of C
"""
OUTLIVING = """
import os, pathlib, time

def run(output):
    template = os.getppid()
    pathlib.Path(output).write_text(str(template))
    while os.getppid() == template:
        time.sleep(0.01)
    return {"event": "valid"}
"""


@contextlib.contextmanager
def sandbox_of(content: str, folder: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """Yield a server that runs this module's task in the sandbox, and the number that the task wrote."""
    (folder / "task.py").write_text(content)
    output = folder / "output"
    code = f"""if True:
        import pathlib, threading
        from service.sandbox import SandboxLimits, run_sandboxed
        limits = SandboxLimits(600, 8 << 30, threading.Event())
        print(run_sandboxed("task.run", [{str(output)!r}], pathlib.Path({str(folder)!r}), limits).last["event"])
    """
    environment = {"PYTHONPATH": f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    with subprocess.Popen(
        [sys.executable, "-c", code], env=os.environ | environment, stdout=subprocess.PIPE, text=True
    ) as server:
        try:
            until(lambda: output.exists() and output.read_text() != "")
            yield server, int(output.read_text())
        finally:
            server.kill()


@pytest.mark.skipif(sys.platform != "linux", reason="asks the kernel of Linux for it")
def test_check_that_cannot_listen_ends_when_its_server_is_killed(tmp_path: Path) -> None:
    with sandbox_of(DEAF, tmp_path) as (server, check):
        assert alive(check)
        server.kill()
        server.wait()
        try:
            until(lambda: not alive(check))
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(check, signal.SIGKILL)


def test_check_whose_template_is_killed_goes_on_and_is_heard(tmp_path: Path) -> None:
    with sandbox_of(OUTLIVING, tmp_path) as (server, template):
        os.kill(template, signal.SIGKILL)
        assert server.stdout is not None and server.stdout.read() == "valid\n"


@pytest.mark.parametrize(("size", "memory_bytes"), [(1 << 20, 1040 << 20), (1 << 40, 8 << 30)])
def test_check_may_take_memory_by_the_size_of_its_upload(
    size: int, memory_bytes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def note_limits(module: str, arguments: list[str], scratch: Path, limits: sandbox.SandboxLimits) -> NoReturn:
        raise OSError(f"may take {limits.memory_bytes}")

    with (tmp_path / "upload").open("wb") as handle:
        handle.truncate(size)
    monkeypatch.setattr(uploads, "run_sandboxed", note_limits)
    with pytest.raises(OSError, match=f"may take {memory_bytes}$"):
        uploads.check(
            AssetKind.SPLATS, tmp_path / "upload", tmp_path, sandbox.SandboxLimits(1.0, 8 << 30, threading.Event())
        )


def claim(store: Store) -> str | None:
    job = store.jobs.claim()
    return None if job is None else job.id


@pytest.mark.parametrize("expired", [True, False])
def test_queued_jobs_of_a_key_that_ended_are_canceled_with_a_reason(expired: bool, store: Store) -> None:
    key, _ = store.keys.create("a", frozenset({Scope.WRITE}), Quota())
    owner, other = Owner(key.id, sees_all=False), submit(store)
    running, waiting = (store.jobs.submit(owner, order(store, owner))[0] for _ in range(2))
    assert [claim(store), claim(store)] == [other, running]
    if expired:
        with store.database.write() as connection:
            connection.execute("UPDATE keys SET expires = ?", (time.time() - 1,))
    else:
        store.keys.revoke(key.id)
        assert store.jobs.get(SERVICE, waiting).state is JobState.CANCELED  # at once, by whichever process
    assert claim(store) is None
    record = store.jobs.get(SERVICE, waiting)
    assert record.state is JobState.CANCELED and record.problem is not None and record.problem["argument"] == "key"
    assert store.jobs.get(SERVICE, running).state is JobState.RUNNING  # what has begun goes on


# What a job prints is part of the server's log, however it is printed


class Slow(logging.StreamHandler[io.StringIO]):
    """A log that takes its time, as on a busy disk."""

    def emit(self, record: logging.LogRecord) -> None:
        time.sleep(0.02)
        super().emit(record)


@pytest.fixture
def job_log() -> Iterator[io.StringIO]:
    """The server's log of what jobs print."""
    stream, logger = io.StringIO(), logging.getLogger("service.jobs.process")
    handler = Slow(stream)
    handler.setFormatter(JsonLines())
    logger.addHandler(handler)
    yield stream
    logger.removeHandler(handler)


def test_every_line_that_a_job_prints_is_a_record_with_its_job_and_request(
    store: Store, supervising: Supervising, job_log: io.StringIO, capfd: pytest.CaptureFixture[str]
) -> None:
    job = store.jobs.submit(SERVICE, replace(order(store), request_id="the-order"))[0]
    with supervising("print_much"):
        wait_until_ended(store, job)
    records = [json.loads(line) for line in job_log.getvalue().splitlines()]
    assert {(record["job"], record["request_id"], record["level"]) for record in records} == {
        (job, "the-order", "warning")
    }
    messages = [record["message"] for record in records]
    assert messages.count('a warning with "quotes" and \ufffd') == 3  # once an attempt: none is lost, however it ends
    assert messages.count("RuntimeError: unforeseen") == 3
    long = [message for message in messages if message.strip("x") == ""]
    assert max(map(len, long)) == LONGEST and sum(map(len, long)) == 3 * 100_000
    assert "unforeseen" not in capfd.readouterr().err  # and nothing of it goes past the log


def test_long_answer_is_heard_in_time_that_grows_with_its_length() -> None:
    """An answer of 48 MB: copied anew with each of its pieces it would be 17 GB."""
    program = "import sys, time; sys.stdout.write('{\"said\": \"' + 'x' * (48 << 20) + '\"}\\n{\"sai')"
    messages: list[dict[str, Any]] = []
    start = time.process_time()
    with JobProcess([sys.executable, "-S", "-c", program], {}, "0" * 32) as process:
        while not (has_ended := process.has_ended()) or not messages:
            messages += process.listen(0 if has_ended else 0.2)
        messages += process.listen(0)
    assert [len(message["said"]) for message in messages] == [48 << 20]  # the half line at its end is none
    assert time.process_time() - start < 2.0


# A job in blocks goes on from finished ones


ROOT = Path(__file__).parents[2]
VIEWS = 20  # three blocks
KILLED_JOB = """if True:
    import io, json, os, signal, sys
    from service.job_child import Reporter
    from service.tasks import lift_as_ordered

    class Deadly(Reporter):
        def __call__(self, stage, done, total, unit):
            if (stage, done) == ("geometry", 16):
                os.kill(os.getpid(), signal.SIGKILL)

    lift_as_ordered(json.loads(sys.argv[1]), Deadly(io.BytesIO()))
"""


def order_of(folder: Path, **settings: Any) -> dict[str, Any]:
    """A scene of twenty views as files, and the order of its lift on the local engine."""
    rng = np.random.default_rng(2)
    names = [f"v{number:02}" for number in range(VIEWS)]
    cameras = {name: look_at(name, rng.normal((0, 0, -4), 1), 32, 24, 30.0) for name in names}
    write_splats(folder / "s.ply", random_splats(3, 2000, spread=2.0))
    (folder / "c.json").write_text(json.dumps(transforms_of(cameras)))
    maps = {name: lc.Regions(rng.integers(-1, 6, (1, 12, 16)), np.eye(6, dtype=np.float32)) for name in names}
    write_pack(folder / "f.safetensors", maps, {})
    files = {str(folder / name): name for name in ("s.ply", "c.json", "f.safetensors")}
    splats, cameras_file, pack = files
    return {
        "splats": splats, "cameras": cameras_file, "features": [pack], "settings": settings, "threads": 1,
        "work": str(folder / "work"), "checkpoint_seconds": 0, "engine": "local", "ray_address": None,
        "output": str(folder / "lift.safetensors"), "file_names": files, "names": files,
    }  # fmt: skip


def test_job_in_blocks_that_is_killed_goes_on_from_them(tmp_path: Path) -> None:
    order = order_of(tmp_path, preset="row-sum")
    (tmp_path / "work").mkdir()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    killed_process = subprocess.run(
        [sys.executable, "-c", KILLED_JOB, json.dumps(order)], env=environment, check=False
    )
    assert killed_process.returncode == -signal.SIGKILL and not Path(order["output"]).exists()
    blocks = {path: path.stat().st_mtime_ns for path in (tmp_path / "work").rglob("view-*.safetensors")}
    assert len(blocks) >= 16
    reports = io.BytesIO()
    answer = lift_as_ordered(order, Reporter(reports))
    assert {path: path.stat().st_mtime_ns for path in blocks} == blocks
    stages = {json.loads(line).get("stage") for line in reports.getvalue().splitlines()}
    assert {"geometry", "solve", "save"} <= stages and answer["count"] == 2000
    expected = lc.lift(lc.read_splats(order["splats"]), lc.read_cameras(order["cameras"]),
                    lc.read_features(*order["features"]), preset="row-sum")  # fmt: skip
    assert torch.equal(lc.load_lift(order["output"]).features, expected.features)


def test_job_of_an_engine_is_lifted_in_blocks_by_the_default_too(tmp_path: Path) -> None:
    order = order_of(tmp_path, preset="default")
    (tmp_path / "work").mkdir()
    lift_as_ordered(order, Reporter(io.BytesIO()))
    assert lc.load_lift(order["output"]).confidence is not None
    assert list((tmp_path / "work").rglob("rows-*.safetensors"))


def test_lift_in_a_data_directory_behind_a_link_names_its_inputs_as_clients_do(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "data").symlink_to("disk")
    order = order_of(tmp_path / "data", preset="row-sum")
    (tmp_path / "data" / "work").mkdir()
    metadata = lift_as_ordered(order, Reporter(io.BytesIO()))["metadata"]
    files = (metadata["splats"], metadata["cameras"], *metadata["features"])
    assert [file["path"] for file in files] == ["s.ply", "c.json", "f.safetensors"]
    store = Store.open(tmp_path / "data")  # so that errors, too, have paths that are known
    assert store.files.root == tmp_path / "disk"
    store.close()
