"""A short task in a process of its own: heard to its end, or ended in time.

Tasks are forks of one process, the template, which has made the imports that they need: these take two seconds, and a
fork begins at once. It runs nothing itself, has what it is asked through a socket, and ends when the server's end of
that closes; tasks end with it.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import json
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

from service.child import die_with_parent, end_with_parent, is_stopped, line_of, memory_of
from service.errors import Busy

IMPORTED = ("service.uploads.check", "service.uploads.renaming", "service.jobs.planning")  # by the template
TICK_SECONDS = 0.5  # how soon the end of the server is seen by who waits
PATIENCE_SECONDS = 300.0  # for the template's imports
FORK_SECONDS = 30.0  # for a fork, once it has made them; a template that takes longer is ended
PIECE = 1 << 16
PRINTED = "printed"  # the file for what a task prints, beside its temporary ones


@dataclass(frozen=True)
class ErrandLimits:
    """What one task may take."""

    seconds: float
    memory_bytes: int  # of private memory beside what the imports hold; mapped files, however large, cost none
    ending: threading.Event  # set when the server must end, and every task with it


@dataclass(frozen=True)
class Heard:
    """What a task said until it ended."""

    last: dict[str, Any]  # its result; {"event": "ready"} of one that began, {"event": "nothing"} of one that did not
    returncode: int | None  # negative for a signal; None when the template ended before it
    trace: str  # what it printed


@dataclass(frozen=True)
class _Task:
    """A fork, and our ends of its pipes."""

    pid: int
    said: int  # what it says, to its end
    status: int  # its exit status, from the template
    lifeline: int  # which it ends with


class _Template:
    """The process that tasks are forked from. Any thread may ask."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._line: socket.socket | None = None

    def start(self) -> socket.socket:
        """Start it where it does not run; the line to it."""
        if self._line is not None and self._process is not None and self._process.poll() is None:
            return self._line
        self._end()
        ours, theirs = socket.socketpair()
        with theirs:
            command = [sys.executable, "-m", "service.errand", str(theirs.fileno()), *IMPORTED]
            null, passed = subprocess.DEVNULL, [theirs.fileno()]
            # One thread: the limit on memory counts the stack and the buffers of each, and cores may be many.
            alone = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
            try:
                self._process = subprocess.Popen(
                    command, stdin=null, stdout=null, pass_fds=passed, start_new_session=True, env=alone
                )
            except OSError:
                ours.close()
                raise
        ours.settimeout(PATIENCE_SECONDS)  # until it has made its imports
        self._line = ours
        return ours

    def get_ready(self) -> None:
        """Have it import what tasks need, so that the first one need not wait for that."""
        with self._turn, contextlib.suppress(OSError):  # without room for a process: whoever has a task tries again
            self.start()

    def revive(self) -> bool:
        """Whether it lives, and is not stopped; when it is not so, it is ended, and a new one starts."""
        process = self._process
        if process is not None and process.poll() is None and not is_stopped(process.pid):
            return True
        if process is not None:
            process.kill()  # whoever waits for it, and has the turn, then sees its end
        self.get_ready()
        return False

    def end(self) -> None:
        """End it, and all tasks."""
        with self._turn:
            self._end()

    def _end(self) -> None:
        process, self._process = self._process, None
        if self._line is not None:
            self._line.close()
            self._line = None
        if process is not None:
            process.kill()
            process.wait()

    def fork(self, request: dict[str, Any]) -> _Task:
        """A new task.

        Raises:
            Busy: the system has no room for a process, or the template does not start.
        """
        with contextlib.ExitStack() as theirs, contextlib.ExitStack() as ours:
            ends = []
            for reads in (True, True, False):  # what we do with ours: said, status, lifeline
                read, write = os.pipe()
                ours.callback(os.close, read if reads else write)
                theirs.callback(os.close, write if reads else read)
                ends.append((read, write) if reads else (write, read))
            given = [end for _, end in ends]
            with self._turn:
                pid = self._ask(request, given) or self._ask(request, given)  # it may have died while idle
            if not pid:
                raise Busy("upload", expected="a process that starts", got="one that ended", hint="try again soon")
            if pid < 0:
                raise Busy("upload", expected="room for a process", got="none", hint="try again soon")
            ours.pop_all()
        return _Task(pid, *(end for end, _ in ends))

    def _ask(self, request: dict[str, Any], files: list[int]) -> int:
        """The number of a new process; 0 when the template is gone."""
        try:
            line = self.start()
            socket.send_fds(line, [json.dumps(request).encode() + b"\n"], files)
            reply = line.recv(64)
            line.settimeout(FORK_SECONDS)
        except OSError:
            reply = b""
        if not reply:
            self._end()
        return int(reply or 0)


_TEMPLATE = _Template()
atexit.register(_TEMPLATE.end)
get_ready, revive = _TEMPLATE.get_ready, _TEMPLATE.revive


def run_errand(module: str, arguments: Sequence[str], scratch: Path, limits: ErrandLimits) -> Heard | None:
    """Call the ``run`` of a module in a process of its own, and wait for what it gives.

    Args:
        module: by its name, as this process must not import what it needs.
        arguments: of that function, which gives a JSON object with an ``event``.
        scratch: the folder for its temporary files.
        limits: beyond that of time it is ended; one that meets that of memory dies, or says so.

    Returns:
        What it said; None when it took longer than it may, and was ended.

    Raises:
        Busy: the server ended meanwhile, or there is no process.
    """
    request = {
        "module": module, "arguments": list(arguments), "scratch": str(scratch), "memory": limits.memory_bytes,
    }  # fmt: skip
    heard = _heard(request, limits)
    if heard is not None and heard.returncode is None and heard.last["event"] in ("nothing", "ready"):
        heard = _heard(request, limits)  # the template was ended, and the task with it: no fault of the file's
        if heard is not None and heard.returncode is None and heard.last["event"] == "ready":
            heard = replace(heard, last={"event": "nothing"})
    if heard is None and limits.ending.is_set():
        raise Busy("upload", expected="a running server", got="one that stops", hint="send it again")
    return heard


def _heard(request: dict[str, Any], limits: ErrandLimits) -> Heard | None:
    task = _TEMPLATE.fork(request)
    try:
        last = _listen(task.said, limits)
        if last is None and not _readable(task.status):  # else it has ended, and the number may be another's
            with contextlib.suppress(ProcessLookupError):
                os.kill(task.pid, signal.SIGKILL)
        status = os.read(task.status, 64)  # once it has ended
    finally:
        for end in (task.said, task.status, task.lifeline):
            os.close(end)
    if last is None:
        return None
    printed = Path(request["scratch"]) / PRINTED
    trace = printed.read_text(errors="replace") if printed.exists() else ""
    return Heard(last, int(status) if status else None, trace)


def _listen(said: int, limits: ErrandLimits) -> dict[str, Any] | None:
    """The last that a task says until it ends; None when it must be ended."""
    heard = bytearray()
    deadline = time.monotonic() + limits.seconds
    while not limits.ending.is_set() and (left := deadline - time.monotonic()) > 0:
        if not _readable(said, min(left, TICK_SECONDS)):
            continue
        piece = os.read(said, PIECE)
        if not piece:
            lines = heard.split(b"\n")[:-1]  # a half line at the end is what a killed writer leaves
            return json.loads(lines[-1]) if lines else {"event": "nothing"}
        heard += piece
    return None


def _readable(pipe: int, seconds: float = 0.0) -> bool:
    """Whether there is something to read of a pipe, or it is closed, within so many seconds."""
    poll = select.poll()  # not select(), which takes no file of a number above 1023
    poll.register(pipe, select.POLLIN)
    return bool(poll.poll(1000 * seconds))


def main() -> None:
    """Be the template: ``python -m service.errand SOCKET MODULE...``."""
    line = socket.socket(fileno=int(sys.argv[1]))
    for module in sys.argv[2:]:
        importlib.import_module(module)
    wake, bell = os.pipe()
    os.set_blocking(bell, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(bell)
    statuses: dict[int, int] = {}  # of each task that runs, the pipe for its exit status
    while True:
        ready = select.select([line, wake], [], [])[0]
        if wake in ready:
            os.read(wake, PIECE)
            _reap(statuses)
        if line in ready:
            request, files = _received(line)
            if request is None:
                return  # the server is gone
            said, status, lifeline = files
            try:
                pid = os.fork()
            except OSError:
                pid = -1
            if pid == 0:
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                for end in (line.detach(), wake, bell, status, *statuses.values()):
                    os.close(end)
                _work(request, said, lifeline)
            if pid > 0:
                statuses[pid] = os.dup(status)
            for end in files:
                os.close(end)
            with contextlib.suppress(BrokenPipeError):
                line.sendall(str(pid).encode())


def _received(line: socket.socket) -> tuple[dict[str, Any] | None, list[int]]:
    """A request, and a task's ends of its pipes; None when the other end is closed."""
    message, files = b"", list[int]()
    while not message.endswith(b"\n"):
        piece, more, _, _ = socket.recv_fds(line, PIECE, 3)
        if not piece:
            return None, []
        message += piece
        files += more
    return json.loads(message), files


def _reap(statuses: dict[int, int]) -> None:
    """Tell the exit status of each task that has ended."""
    for pid in list(statuses):
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            pipe = statuses.pop(pid)
            with contextlib.suppress(BrokenPipeError):
                os.write(pipe, str(os.waitstatus_to_exitcode(status)).encode())
            os.close(pipe)


def _work(request: dict[str, Any], said: int, lifeline: int) -> NoReturn:
    """A task, in its own process."""
    status = 1
    try:
        os.setsid()
        die_with_parent()
        end_with_parent(lifeline)  # it may have died before
        printed = os.open(Path(request["scratch"]) / PRINTED, os.O_WRONLY | os.O_CREAT, 0o600)
        for stream in (1, 2):
            os.dup2(printed, stream)
        os.environ["TMPDIR"] = tempfile.tempdir = request["scratch"]
        run = importlib.import_module(request["module"]).run
        most = memory_of("self", "VmData") + request["memory"]  # imports hold half a gigabyte with CUDA's torch
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
        _say(said, {"event": "ready"})
        _say(said, run(*request["arguments"]))
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def _say(said: int, message: dict[str, Any]) -> None:
    line = memoryview(line_of(message))
    while line:
        line = line[os.write(said, line) :]


if __name__ == "__main__":
    main()
