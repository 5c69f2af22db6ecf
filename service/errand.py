"""A short task in a process of its own, which is waited for, or ended in time.

Tasks are forks of multiprocessing's fork server, the template, which has imported what they need: that takes two
seconds, and a fork begins at once. The template computes nothing, and ends once the server and all tasks have.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import forkserver, util
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

from service.child import Messages, children_of, end_with_parent, is_stopped, line_of, memory_of
from service.errors import Busy

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [
        "service.one_thread",
        "service.errand",
        "service.tasks",
        "liftcore.cli.__main__",  # a task imports anew what the server's process began with
    ]
)
TICK_SECONDS = 0.5  # how soon the end of the server is seen by who waits
GONE_SECONDS = 5.0  # for a task to end once it has said its result
LONGEST_FOLDER = 70  # characters of the temporary folder, in which the template has its socket: a path has 107
PRINTED = "printed"  # the file for what a task prints, beside its temporary ones
TEMPLATE_DIED = 255  # what multiprocessing tells in place of an exit status that nobody has
_TURN = threading.Lock()  # of starts and ends of tasks: multiprocessing looks at all tasks at each start


@dataclass(frozen=True)
class ErrandLimits:
    """What one task may take."""

    seconds: float
    memory_bytes: int  # of private memory beside what the imports hold; mapped files, however large, cost none
    ending: threading.Event  # set when the server must end, and every task with it


@dataclass(frozen=True)
class TaskResult:
    """What a task said until it ended."""

    last: dict[str, Any]  # its result; {"event": "ready"} of one that began, {"event": "nothing"} of one that did not
    returncode: int | None  # negative for a signal; None when nobody knows, as the template ended meanwhile
    trace: str  # what it printed


def get_ready() -> None:
    """Have the template import what tasks need, so that the first waits less."""
    if len(tempfile.gettempdir()) > LONGEST_FOLDER:
        own, tempfile.tempdir = tempfile.tempdir, "/tmp"
        try:
            util.get_temp_dir()  # multiprocessing keeps the first that it made
        finally:
            tempfile.tempdir = own
    forkserver.ensure_running()


def revive() -> bool:
    """Return whether the template lives and is not stopped, as far as Linux tells; if not, have a new one start."""
    template = _template()
    if template is not None and not is_stopped(template):
        return True
    if template is not None:
        os.kill(template, signal.SIGKILL)  # whoever waits for it, and has the turn, then sees its end
    get_ready()
    return sys.platform != "linux"


def _template() -> int | None:
    """The process id of the template that this process started; a dead one has no command line."""
    for child in children_of(os.getpid()):
        with suppress(OSError):
            if b"multiprocessing.forkserver" in Path(f"/proc/{child}/cmdline").read_bytes():
                return child
    return None


def run_errand(task: str, arguments: Sequence[str], scratch: Path, limits: ErrandLimits) -> TaskResult | None:
    """Call a function in a process of its own, and wait for what it gives.

    Args:
        task: the name of the function, such as ``service.tasks.check``: this process must not import what it needs.
        arguments: of the function, which gives a JSON object with an ``event``.
        scratch: the folder for its temporary files.
        limits: beyond that of time it is ended; one that meets that of memory dies, or says so.

    Returns:
        What it said; None when it took longer than it may, and was ended.

    Raises:
        Busy: the server ended meanwhile, or there is no process.
    """
    process, pipe = _start(task, list(arguments), str(scratch), limits.memory_bytes)
    with pipe:
        last = _read_last_message(pipe, limits)
    if last is not None:
        wait([process.sentinel], GONE_SECONDS)
    with _TURN:
        if process.is_alive():
            process.kill()
        process.join()
        status = process.exitcode
        process.close()  # with its lifeline, which ends one whose template is gone
    if limits.ending.is_set() and last is None:
        raise Busy("upload", expected="a running server", got="one that stops", hint="send it again")
    if last is None:
        return None
    printed = scratch / PRINTED
    trace = printed.read_text(errors="replace") if printed.exists() else ""
    return TaskResult(last, None if status == TEMPLATE_DIED else status, trace)


def _start(*given: Any) -> tuple[ForkServerProcess, Connection]:
    """A new task, and the pipe through which it says what comes of it.

    Raises:
        Busy: the system has no room for a process, or the template does not start.
    """
    for _ in range(2):  # the template may have died while idle
        read, write = os.pipe()
        ours, theirs = Connection(read, writable=False), Connection(write, readable=False)
        task = CONTEXT.Process(target=_child_main, args=(theirs, *given), daemon=True)
        try:
            with theirs, _TURN:
                get_ready()
                task.start()
            return task, ours
        except (OSError, EOFError):
            ours.close()
    raise Busy("upload", expected="room for a process", got="none", hint="try again soon")


def _read_last_message(pipe: Connection, limits: ErrandLimits) -> dict[str, Any] | None:
    """The last that a task says until it ends; None when it must be ended."""
    messages, last = Messages(pipe.fileno()), {"event": "nothing"}
    deadline = time.monotonic() + limits.seconds
    while not limits.ending.is_set() and (left := deadline - time.monotonic()) > 0:
        last = [last, *messages.read(min(left, TICK_SECONDS))][-1]
        if not messages.open:
            return last
    return None


def _child_main(pipe: Connection, task: str, arguments: list[str], scratch: str, memory_bytes: int) -> None:
    """A task, in its own process."""
    os.setsid()
    parent = multiprocessing.parent_process()
    assert parent is not None
    end_with_parent(parent.sentinel)
    printed = os.open(Path(scratch) / PRINTED, os.O_WRONLY | os.O_CREAT, 0o600)
    for stream in (1, 2):
        os.dup2(printed, stream)
    os.environ["TMPDIR"] = tempfile.tempdir = scratch
    module, _, name = task.rpartition(".")
    run = getattr(importlib.import_module(module), name)
    most = memory_of("self", "VmData") + memory_bytes  # imports hold half a gigabyte with CUDA's torch
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    with os.fdopen(pipe.fileno(), "wb", closefd=False) as out:
        out.write(line_of({"event": "ready"}))
        out.flush()
        out.write(line_of(run(*arguments)))
    os._exit(0)  # no time for what libraries do at an exit
