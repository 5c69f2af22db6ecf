"""A short task in a process of its own, which is waited for, or ended in time.

Tasks are forks of multiprocessing's fork server, the template, which has imported what they need: that takes two
seconds, and a fork begins at once. The template computes nothing, and ends once the server and all tasks have.
"""

from __future__ import annotations

import importlib
import logging
import multiprocessing
import os
import resource
import signal
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import forkserver, util
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

from service.child import Messages, children_of, end_with_parent, is_stopped, line_of, memory_of
from service.errors import Busy

CONTEXT = multiprocessing.get_context("forkserver")
IMPORTED = [
    "service.one_thread",
    "service.errand",
    "service.tasks",
    "liftcore.cli.__main__",  # a task imports anew what the server's process began with
]
CONTEXT.set_forkserver_preload(IMPORTED)
TICK_SECONDS = 0.5  # how soon the end of the server is seen by who waits
GONE_SECONDS = 5.0  # for a task to end once it has said its result, and for its template to tell of the end
IMPORT_SECONDS = 300.0  # for the first fork of a template, which makes its imports before
FORK_SECONDS = 30.0  # for each later one
DYING_SECONDS = 1.0  # until a template that no longer answers is one that has ended
LONGEST_FOLDER = 70  # characters of the temporary folder, in which the template has its socket: a path has 107
PRINTED = "printed"  # the file for what a task prints, beside its temporary ones
TRACE_BYTES = 4000  # of its end, for the log
CHILDREN = Path("/proc/thread-self/children")  # which not every Linux has
TEMPLATE_DIED = 255  # what multiprocessing tells in place of an exit status that nobody has
_TURN = threading.Lock()  # of starts and ends of tasks: multiprocessing looks at all tasks at each start
_FORKED = set[int]()  # the templates that have forked once, by process id

log = logging.getLogger(__name__)


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
    trace: str  # the end of what it printed


def get_ready() -> None:
    """Have the template import what tasks need, so that the first waits less."""
    try:
        Path.cwd()
    except FileNotFoundError:
        os.chdir("/")  # somebody removed the directory, which multiprocessing asks for, and tasks begin in
    if len(tempfile.gettempdir()) > LONGEST_FOLDER:
        folder, tempfile.tempdir = tempfile.tempdir, "/tmp"
        try:
            util.get_temp_dir()  # multiprocessing keeps the first that it made
        finally:
            tempfile.tempdir = folder
    forkserver.ensure_running()


def revive() -> bool:
    """Return whether the template lives and is not stopped, as far as Linux tells; if not, have a new one start."""
    template = _template()
    if template is not None and not is_stopped(template):
        return True
    _kill_template()
    try:
        get_ready()
    except OSError:  # whoever has a task tries again
        log.warning("what checks uploads does not start", exc_info=True)
        return False
    return not CHILDREN.exists()


def _template() -> int | None:
    """The process id of the template that this process started; a dead one has no command line."""
    for child in children_of(os.getpid()):
        with suppress(OSError):
            if b"multiprocessing.forkserver" in Path(f"/proc/{child}/cmdline").read_bytes():
                return child
    return None


def _kill_template() -> None:
    """Kill the template: whoever waits for it then sees its end, and tasks go on."""
    if (template := _template()) is not None:
        with suppress(ProcessLookupError):
            os.kill(template, signal.SIGKILL)


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
        Busy: the server ended meanwhile, there is no process, or it was ended with its template, twice.
    """
    for _ in range(2):
        result = _run_once(task, arguments, scratch, limits)
        if result is None or result.returncode is not None or result.last["event"] not in ("nothing", "ready"):
            return result
    raise Busy("server", expected="a process that works on it", got="one that was ended", hint="try again soon")


def _run_once(task: str, arguments: Sequence[str], scratch: Path, limits: ErrandLimits) -> TaskResult | None:
    process, pipe = _start(limits.ending, task, list(arguments), str(scratch), limits.memory_bytes)
    with pipe:
        last = _read_last_message(pipe, limits)
    if not wait([process.sentinel], 0 if last is None else GONE_SECONDS):
        process.kill()
    while not wait([process.sentinel], GONE_SECONDS):
        _kill_template()  # which hangs: it would have told of the end
    with _TURN:
        process.join()
        status = process.exitcode
        process.close()  # with its lifeline, which ends one whose template is gone
    if last is None:
        _require_running(limits.ending)
        return None
    return TaskResult(last, None if status == TEMPLATE_DIED else status, _end_of(scratch / PRINTED))


def _require_running(ending: threading.Event) -> None:
    if ending.is_set():
        raise Busy("server", expected="a running server", got="one that stops", hint="send it again")


def _end_of(file_path: Path) -> str:
    """The last of what a task printed, which may be without end."""
    if not file_path.exists():
        return ""
    with file_path.open("rb") as file:
        file.seek(max(0, file_path.stat().st_size - TRACE_BYTES))
        return file.read(TRACE_BYTES).decode(errors="replace")


def _start(ending: threading.Event, *given: Any) -> tuple[ForkServerProcess, Connection]:
    """A new task, and the pipe through which it says what comes of it.

    Raises:
        Busy: the server ends, the system has no room for a process, or the template does not start.
    """
    reason = ""
    for pause in (0.0, DYING_SECONDS):  # the template may die over it
        time.sleep(pause)
        with ExitStack() as resources:
            try:
                read_end, write = os.pipe()
                near_end = resources.enter_context(Connection(read_end, writable=False))
                far_end = Connection(write, readable=False)
                task = CONTEXT.Process(target=_child_main, args=(far_end, *given), daemon=True)
                with far_end, _TURN:
                    _require_running(ending)
                    get_ready()
                    with _bounded(ending):
                        task.start()
                    _FORKED.update(filter(None, [_template()]))
                resources.pop_all()
                return task, near_end
            except (OSError, EOFError, RuntimeError) as error:  # the last: no room for a thread
                log.warning("a process for %s does not start", given[0], exc_info=True)
                reason = getattr(error, "strerror", None) or "one that ended"
    raise Busy("server", expected="a process that starts", got=reason, hint="try again soon")


@contextmanager
def _bounded(ending: threading.Event) -> Iterator[None]:
    """Kill the template where it takes too long over a fork, or the server ends meanwhile."""
    finished = threading.Event()
    deadline = time.monotonic() + (FORK_SECONDS if _template() in _FORKED else IMPORT_SECONDS)

    def watch() -> None:
        while not finished.wait(TICK_SECONDS):
            if ending.is_set() or time.monotonic() > deadline:
                _kill_template()

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        finished.set()


def _read_last_message(pipe: Connection, limits: ErrandLimits) -> dict[str, Any] | None:
    """The last that a task says until it ends; None when it must be ended."""
    messages, last = Messages(pipe.fileno()), {"event": "nothing"}
    deadline = time.monotonic() + limits.seconds
    while not limits.ending.is_set() and (remaining := deadline - time.monotonic()) > 0:
        last = [last, *messages.read(min(remaining, TICK_SECONDS))][-1]
        if not messages.open:
            return last
    return None


def _child_main(pipe: Connection, task: str, arguments: list[str], scratch: str, memory_bytes: int) -> None:
    """A task, in its own process."""
    os.setsid()
    parent = multiprocessing.parent_process()
    assert parent is not None
    end_with_parent(parent.sentinel)
    output = os.open(Path(scratch) / PRINTED, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.environ["TMPDIR"] = tempfile.tempdir = scratch
    module, _, name = task.rpartition(".")
    run = getattr(importlib.import_module(module), name)
    limit = memory_of("self", "VmData") + memory_bytes  # imports hold half a gigabyte with CUDA's torch
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    with os.fdopen(pipe.fileno(), "wb", closefd=False) as out:
        out.write(line_of({"event": "ready"}))
        out.flush()
        out.write(line_of(run(*arguments)))
    os._exit(0)  # no time for what libraries do at an exit
