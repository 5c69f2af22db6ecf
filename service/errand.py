"""A short task in a process of its own: heard to its end, or ended in time.

Its process is a fork of one that has imported what tasks need (`multiprocessing`'s fork server), and begins at once:
the imports take two seconds. That one runs nothing itself, and ends with the server.
"""

from __future__ import annotations

import importlib
import json
import logging
import multiprocessing
import os
import resource
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing import forkserver
from multiprocessing.util import get_temp_dir
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.child import die_with_parent, end_with_parent
from service.errors import Busy

if TYPE_CHECKING:
    from multiprocessing.connection import Connection, PipeConnection

    Pipe = Connection[Any, Any] | PipeConnection[Any, Any]

TICK_SECONDS = 0.5  # how soon the end of the server is seen by who waits
LONGEST_FOLDER, SHORT_FOLDER = 70, "/tmp"  # for the name of a socket, which has 107 characters at most
PRINTED = "printed"  # the file for what a task prints, beside its temporary ones
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["service.uploads.check", "service.jobs.planning"])

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ErrandLimits:
    """What one task may take."""

    seconds: float
    memory_bytes: int  # of private memory, whatever its size; mapped files, however large, cost none
    ending: threading.Event  # set when the server must end, and every task with it


@dataclass(frozen=True)
class Heard:
    """What a task said until it ended."""

    last: dict[str, Any]  # its result, {"event": "ready"} of one that began, {"event": "nothing"} of one that did not
    returncode: int | None
    trace: str  # what it printed


def get_ready() -> None:
    """Have the imports made that tasks need, so that the first one need not wait for them."""
    try:
        _ensure_forks()
    except OSError:  # a machine without room for a process; whoever has a task tries again
        log.exception("the process that tasks are forked of could not be started")


def _ensure_forks() -> None:
    """Start the process that tasks are forked of, where it does not run."""
    given = tempfile.tempdir
    if len(tempfile.gettempdir()) > LONGEST_FOLDER and os.access(SHORT_FOLDER, os.W_OK):
        tempfile.tempdir = SHORT_FOLDER
    try:
        get_temp_dir()  # remembered
    finally:
        tempfile.tempdir = given
    forkserver.ensure_running()


def run_errand(module: str, arguments: Sequence[str], scratch: Path, limits: ErrandLimits) -> Heard | None:
    """Call the ``run`` of a module in a process of its own, and wait for what it gives.

    Args:
        module: by its name, as this process must not import what it needs.
        arguments: of that function, which gives a JSON object with an ``event``.
        scratch: the folder for its temporary files.
        limits: of it. A task that meets its limit of memory dies, or says so.

    Returns:
        What it said; None when it took longer than it may, and was ended.

    Raises:
        Busy: the server ended meanwhile.
    """
    _ensure_forks()
    said, saying = FORKS.Pipe(duplex=False)
    lifeline, ours = FORKS.Pipe(duplex=False)
    given = module, list(arguments), str(scratch), limits.memory_bytes, saying, lifeline
    process = FORKS.Process(target=_work, args=given, daemon=True)
    with said, ours:
        with saying, lifeline:  # the ends of the task
            process.start()
        last = _listen(said, limits)
        if last is None:
            process.kill()
        process.join()
    returncode = process.exitcode
    process.close()
    if last is not None:
        printed = scratch / PRINTED
        return Heard(last, returncode, printed.read_text(errors="replace") if printed.exists() else "")
    if limits.ending.is_set():
        raise Busy("upload", expected="a running server", got="one that stops", hint="send it again")
    return None


def _listen(said: Pipe, limits: ErrandLimits) -> dict[str, Any] | None:
    """The last that a task says until it ends; None when it must be ended."""
    last = {"event": "nothing"}
    deadline = time.monotonic() + limits.seconds
    while not limits.ending.is_set() and (left := deadline - time.monotonic()) > 0:
        if said.poll(min(left, TICK_SECONDS)):
            try:
                last = json.loads(said.recv_bytes())
            except (EOFError, OSError):  # it ended, perhaps within a word
                return last
    return None


def _work(module: str, arguments: Sequence[str], scratch: str, memory: int, said: Pipe, lifeline: Pipe) -> None:
    """The task's own process."""
    os.setsid()
    # With it the parent would wait for this process, and not end with the server.
    os.close(forkserver._forkserver._forkserver_alive_fd)  # pyright: ignore[reportAttributeAccessIssue]
    die_with_parent()
    end_with_parent(os.dup(lifeline.fileno()))  # it may have died before
    printed = os.open(Path(scratch) / PRINTED, os.O_WRONLY | os.O_CREAT, 0o600)
    for stream in (1, 2):
        os.dup2(printed, stream)
    os.environ["TMPDIR"] = tempfile.tempdir = scratch
    run = importlib.import_module(module).run
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    _say(said, {"event": "ready"})
    _say(said, run(*arguments))


def _say(said: Pipe, message: dict[str, Any]) -> None:
    said.send_bytes(json.dumps(message).encode())  # `send` would pickle, and who reads files of strangers sends none
