"""Sandboxed tasks while their template hangs or dies, or the server stops: every wait ends, no file is blamed."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest

from service import sandbox
from service.errors import ServiceUnavailable
from service.sandbox import SandboxLimits, SandboxResult, run_sandboxed

from .service_process import template_of

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the template is found by what Linux tells")

TASKS = """
import os, pathlib, signal

def answer():
    return {"event": "valid"}

def stop_template():
    os.kill(os.getppid(), signal.SIGSTOP)
    return {"event": "valid"}

def die_with_template(count, times):
    with open(count, "a+") as file:
        file.write("x")
        file.flush()
        if file.tell() > int(times):
            return {"event": "valid"}
    os.kill(os.getppid(), signal.SIGKILL)
    os.kill(os.getpid(), signal.SIGKILL)

def talk():
    print("x" * 100_000 + "the last word", flush=True)
    return {"event": "valid"}
"""

Run = Callable[..., SandboxResult | None]


def kill_template() -> None:
    """Kill the template, if there is one, and wait until the system has it as dead: without a command line."""
    with suppress(AssertionError, OSError):
        os.kill(template := template_of(os.getpid()), signal.SIGKILL)
        while Path(f"/proc/{template}/cmdline").read_bytes():
            time.sleep(0.01)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """Run one of TASKS in forks of a template that has nothing to import."""
    (tmp_path / "tasks_of_test.py").write_text(TASKS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sandbox, "GONE_SECONDS", 0.3)
    sandbox.CONTEXT.set_forkserver_preload([])
    kill_template()

    def run_task(task: str, *arguments: str, ending: threading.Event | None = None) -> SandboxResult | None:
        limits = SandboxLimits(60.0, 8 << 30, ending or threading.Event())
        return run_sandboxed(f"tasks_of_test.{task}", arguments, tmp_path, limits)

    yield run_task
    sandbox.CONTEXT.set_forkserver_preload(sandbox.IMPORTED)
    kill_template()


def event(result: SandboxResult | None) -> str:
    assert result is not None
    return result.last["event"]


def test_template_that_hangs_is_replaced(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    assert event(run("answer")) == "valid"
    os.kill(hung := template_of(os.getpid()), signal.SIGSTOP)
    monkeypatch.setattr(sandbox, "FORK_SECONDS", 0.1)
    assert event(run("answer")) == "valid"
    assert template_of(os.getpid()) != hung


def test_task_whose_template_hangs_before_its_end_is_heard(run: Run) -> None:
    assert event(run("stop_template")) == "valid"
    assert event(run("answer")) == "valid"


def test_server_ends_while_its_template_hangs(run: Run) -> None:
    assert event(run("answer")) == "valid"
    os.kill(template_of(os.getpid()), signal.SIGSTOP)
    ending = threading.Event()
    with ThreadPoolExecutor(2) as threads:
        waiting = [threads.submit(run, "answer", ending=ending) for _ in range(2)]
        time.sleep(0.3)
        assert not any(task.done() for task in waiting)
        ending.set()
        for task in waiting:
            with pytest.raises(ServiceUnavailable, match="one that stops"):
                task.result(sandbox.FORK_SECONDS / 2)


def test_task_that_dies_with_its_template_is_tried_once_more(run: Run, tmp_path: Path) -> None:
    assert event(run("die_with_template", str(tmp_path / "once"), "1")) == "valid"
    with pytest.raises(ServiceUnavailable):
        run("die_with_template", str(tmp_path / "twice"), "2")


def test_task_runs_where_the_working_directory_is_gone(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder := tmp_path / "gone").mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    assert event(run("answer")) == "valid"


def test_error_of_a_process_that_does_not_start_has_the_reason(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> None:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(sandbox, "get_ready", full)
    monkeypatch.setattr(sandbox, "DYING_SECONDS", 0.0)
    kill_template()
    assert not sandbox.revive()  # nor does the server fail at its start, or a probe
    with pytest.raises(ServiceUnavailable, match="Too many open files"):
        run("answer")


def test_of_what_a_task_prints_the_end_is_read(run: Run) -> None:
    result = run("talk")
    assert result is not None and result.trace.endswith("xthe last word\n")
    assert len(result.trace) < 10_000


def test_template_that_the_system_does_not_tell_of_is_taken_to_live(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sandbox, "children_of", lambda process: [])
    monkeypatch.setattr(sandbox, "CHILDREN", tmp_path / "none")
    assert sandbox.revive()
