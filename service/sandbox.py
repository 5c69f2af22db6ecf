"""Run a short task in a child process with limits of time and memory.

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
from service.errors import ServiceUnavailable

CONTEXT = multiprocessing.get_context("forkserver")
IMPORTED = [
    "service.one_thread",
    "service.sandbox",
    "service.tasks",
    "liftcore.cli.__main__",  # a task imports again the module that started the server's process
]
CONTEXT.set_forkserver_preload(IMPORTED)
TICK_SECONDS = 0.5  # delay after which the end of the server is noticed
GONE_SECONDS = 5.0  # for a task to exit after its result, and for its template to report the exit
IMPORT_SECONDS = 300.0  # for the first fork of a template, which does its imports first
FORK_SECONDS = 30.0  # for each later one
DYING_SECONDS = 1.0  # until a template that does not respond counts as ended
LONGEST_FOLDER = 70  # characters of the temporary folder, which holds the template's socket: its path may have 107
OUTPUT_FILE = "printed"  # file with the output of a task, beside its temporary files
TRACE_BYTES = 4000  # of the end of the output, for the log
CHILDREN = Path("/proc/thread-self/children")  # not every Linux has it
TEMPLATE_DIED = 255  # multiprocessing reports it in place of an unknown exit status
_TURN = threading.Lock()  # starts and ends of tasks: multiprocessing polls all tasks at each start
_FORKED = set[int]()  # process ids of templates that have forked once

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SandboxLimits:
    """Limits of one task."""

    seconds: float
    memory_bytes: int  # private memory beyond that of the imports; mapped files do not count
    ending: threading.Event  # set when the server stops, and every task with it


@dataclass(frozen=True)
class SandboxResult:
    """Last message, exit status and output of a task."""

    last: dict[str, Any]  # its result; {"event": "ready"} if it only began, {"event": "nothing"} if it did not
    returncode: int | None  # negative for a signal; None if unknown, as the template ended meanwhile
    trace: str  # the end of its output


def get_ready() -> None:
    """Start the template, which imports what tasks need, so that the first task starts sooner."""
    try:
        Path.cwd()
    except FileNotFoundError:
        os.chdir("/")  # the working directory was removed; multiprocessing and tasks need one
    if len(tempfile.gettempdir()) > LONGEST_FOLDER:
        folder, tempfile.tempdir = tempfile.tempdir, "/tmp"
        try:
            util.get_temp_dir()  # multiprocessing keeps the first folder that it made
        finally:
            tempfile.tempdir = folder
    forkserver.ensure_running()


def revive() -> bool:
    """Return True if the template lives and is not stopped, as Linux reports it; else start a new one."""
    template = _template()
    if template is not None and not is_stopped(template):
        return True
    _kill_template()
    try:
        get_ready()
    except OSError:  # the next task tries again
        log.warning("what checks uploads does not start", exc_info=True)
        return False
    return not CHILDREN.exists()


def _template() -> int | None:
    """Return the process id of this process' template; None if it is dead (a dead process has no command line)."""
    for child in children_of(os.getpid()):
        with suppress(OSError):
            if b"multiprocessing.forkserver" in Path(f"/proc/{child}/cmdline").read_bytes():
                return child
    return None


def _kill_template() -> None:
    """Kill the template, so that waits for it end and tasks go on."""
    if (template := _template()) is not None:
        with suppress(ProcessLookupError):
            os.kill(template, signal.SIGKILL)


def run_sandboxed(task: str, arguments: Sequence[str], scratch: Path, limits: SandboxLimits) -> SandboxResult | None:
    """Call a function in a child process and return its result.

    Args:
        task: the name of the function, such as ``service.tasks.check``: this process must not import what it needs.
        arguments: of the function, which gives a JSON object with an ``event``.
        scratch: the folder for its temporary files.
        limits: beyond that of time it is ended; one over the memory limit dies, or reports it.

    Returns:
        Its messages; None if it exceeded the time limit and was ended.

    Raises:
        ServiceUnavailable: the server ended meanwhile, there is no process, or it was ended with its template, twice.
    """
    for _ in range(2):
        result = _run_once(task, arguments, scratch, limits)
        if result is None or result.returncode is not None or result.last["event"] not in ("nothing", "ready"):
            return result
    raise ServiceUnavailable(
        "server", expected="a process that works on it", got="one that was ended", hint="try again soon"
    )


def _run_once(task: str, arguments: Sequence[str], scratch: Path, limits: SandboxLimits) -> SandboxResult | None:
    process, pipe = _start(limits.ending, task, list(arguments), str(scratch), limits.memory_bytes)
    with pipe:
        last = _read_last_message(pipe, limits)
    if not wait([process.sentinel], 0 if last is None else GONE_SECONDS):
        process.kill()
    while not wait([process.sentinel], GONE_SECONDS):
        _kill_template()  # it hangs: it would have reported the end
    with _TURN:
        process.join()
        status = process.exitcode
        process.close()  # this closes its lifeline, which ends a task whose template has died
    if last is None:
        _require_running(limits.ending)
        return None
    return SandboxResult(last, None if status == TEMPLATE_DIED else status, _end_of(scratch / OUTPUT_FILE))


def _require_running(ending: threading.Event) -> None:
    if ending.is_set():
        raise ServiceUnavailable("server", expected="a running server", got="one that stops", hint="send it again")


def _end_of(file_path: Path) -> str:
    """Return the end of a task's output, which may be very long."""
    if not file_path.exists():
        return ""
    with file_path.open("rb") as file:
        file.seek(max(0, file_path.stat().st_size - TRACE_BYTES))
        return file.read(TRACE_BYTES).decode(errors="replace")


def _start(ending: threading.Event, *arguments: Any) -> tuple[ForkServerProcess, Connection]:
    """Start a task; return its process and the pipe for its messages.

    Raises:
        ServiceUnavailable: the server ends, the system has no room for a process, or the template does not start.
    """
    reason = ""
    for pause in (0.0, DYING_SECONDS):  # the template may die at the first attempt
        time.sleep(pause)
        with ExitStack() as resources:
            try:
                read_end, write = os.pipe()
                near_end = resources.enter_context(Connection(read_end, writable=False))
                far_end = Connection(write, readable=False)
                task = CONTEXT.Process(target=_child_main, args=(far_end, *arguments), daemon=True)
                with far_end, _TURN:
                    _require_running(ending)
                    get_ready()
                    with _bounded(ending):
                        task.start()
                    _FORKED.update(filter(None, [_template()]))
                resources.pop_all()
                return task, near_end
            except (OSError, EOFError, RuntimeError) as error:  # RuntimeError: no room for a thread
                log.warning("a process for %s does not start", arguments[0], exc_info=True)
                reason = getattr(error, "strerror", None) or "one that ended"
    raise ServiceUnavailable("server", expected="a process that starts", got=reason, hint="try again soon")


@contextmanager
def _bounded(ending: threading.Event) -> Iterator[None]:
    """Kill the template if a fork takes too long or the server stops meanwhile."""
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


def _read_last_message(pipe: Connection, limits: SandboxLimits) -> dict[str, Any] | None:
    """Return the last message of a task; None if it must be killed."""
    messages, last = Messages(pipe.fileno()), {"event": "nothing"}
    deadline = time.monotonic() + limits.seconds
    while not limits.ending.is_set() and (remaining := deadline - time.monotonic()) > 0:
        last = [last, *messages.read(min(remaining, TICK_SECONDS))][-1]
        if not messages.open:
            return last
    return None


def _child_main(pipe: Connection, task: str, arguments: list[str], scratch: str, memory_bytes: int) -> None:
    """Run a task in its own process."""
    os.setsid()
    parent = multiprocessing.parent_process()
    assert parent is not None
    end_with_parent(parent.sentinel)
    output = os.open(Path(scratch) / OUTPUT_FILE, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.environ["TMPDIR"] = tempfile.tempdir = scratch
    module, _, name = task.rpartition(".")
    run = getattr(importlib.import_module(module), name)
    limit = memory_of("self", "VmData") + memory_bytes  # the imports take half a gigabyte with CUDA's torch
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    with os.fdopen(pipe.fileno(), "wb", closefd=False) as out:
        out.write(line_of({"event": "ready"}))
        out.flush()
        out.write(line_of(run(*arguments)))
    os._exit(0)  # skip the exit handlers of libraries
