"""The one kind of child process, for checks, plans, jobs and queries: orders go in, JSON lines come out.

A child leads a process group. It holds the reading end of a pipe, its lifeline: when the server ends, however it
ends, the kernel ends the group. A spare child has imported what it needs before its order comes. The child of a check
or a query becomes the spare again after its answer; that of a job is ended with all that it started.
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib
import json
import logging
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, BinaryIO, NamedTuple

from liftcore.errors import SplatliftError
from service.errors import FULL, Busy, Fault, InvalidRequest, NoSpace, OutOfTime, ProcessDied, fault_of

TASKS = "service.tasks"  # what a spare child has imported
TICK_SECONDS = 0.2  # until a cancel, a stop or a limit is noticed
STOPPED_SECONDS = 2.0  # after which a stopped process (SIGSTOP) is given up
STOPPED = "its process was stopped"
GONE_SECONDS = 3.0  # for the kernel to end a process group
ORDERS = 100  # of a child, then a fresh one takes its place: what libraries keep does not add up
TRIES = 3  # of an order that a request waits for, whose process is killed
LINE_BYTES = 8192  # of what a process prints, in one record of the log
NICENESS = 10  # of jobs, as queries have priority: beside one, a lift gets a tenth of a core
Message = dict[str, Any]

log = logging.getLogger(__name__)


def log_lines(pipe: IO[bytes], name: str) -> None:
    """Log each line that a process prints, in a thread, until it has ended."""

    def listen() -> None:
        with pipe:
            while line := pipe.readline(LINE_BYTES):
                if text := line.decode("utf-8", "replace").strip():
                    log.warning("%s: %s", name, text)

    threading.Thread(target=listen, name=f"lines-of-{name}", daemon=True).start()


class Ending(NamedTuple):
    """How an order ended: the last message, with a ``result`` or a ``fault``, or the reason why there is none."""

    last: Message | None
    reason: str = ""
    was_killed: bool = False  # from outside: the order need not be to blame
    was_late: bool = False  # it took more seconds than it may


class Child:
    """A child process, from the server's side: it leads a group. Any thread may `end` it."""

    def __init__(self, module: str, *arguments: str, **environment: str) -> None:
        lifeline, self._lifeline = os.pipe()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, str(lifeline), *arguments],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, pass_fds=[lifeline],
                start_new_session=True, env=os.environ | environment,
            )  # fmt: skip
            arm(lifeline, self._process.pid)  # else it would live through its imports
        finally:
            os.close(lifeline)
        assert self._process.stdin is not None and self._process.stdout is not None
        assert self._process.stderr is not None
        self.input, self.output = self._process.stdin, self._process.stdout
        log_lines(self._process.stderr, module)
        self._ending = threading.Lock()
        self.orders = 0

    def messages(self, order: Message) -> Iterator[Message]:
        """Send an order; yield what the child says, up to its last message or its end."""
        self.orders += 1
        with contextlib.suppress(BrokenPipeError):  # it died as a spare
            self.input.write(json.dumps(order).encode() + b"\n")
            self.input.flush()
        for line in self.output:
            if not line.endswith(b"\n"):  # a killed child may leave half a line
                return
            message = json.loads(line)
            yield message
            if is_last(message):
                return

    def is_alive(self) -> bool:
        """Return True if it has neither ended nor been stopped."""
        return self._process.poll() is None and not self.is_stopped()

    def is_stopped(self) -> bool:
        """Return True if it was stopped (SIGSTOP), as Linux reports it: it lives and does not respond."""
        with contextlib.suppress(OSError):
            state = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()[0]
            return state in ("T", "t")
        return False

    @contextlib.contextmanager
    def watched(self, why_end: Callable[[], str]) -> Iterator[list[str]]:
        """End it in the block once there is a reason, or it stays stopped; yield a list that gets the reason."""
        reasons, is_done, stopped_since = list[str](), threading.Event(), math.inf

        def watch() -> None:
            nonlocal stopped_since
            while not reasons and not is_done.wait(TICK_SECONDS):
                now = time.monotonic()
                stopped_since = min(stopped_since, now) if self.is_stopped() else math.inf
                reason = STOPPED if now - stopped_since > STOPPED_SECONDS else why_end()
                if reason:
                    reasons.append(reason)
                    self.end()

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield reasons
        finally:
            is_done.set()
            watcher.join()

    def end(self) -> int:
        """Kill the group; return the status, negative for a signal. No process of it is left after this.

        The child writes drafts and checkpoints only, and those are whole or absent, so nothing is lost by haste.
        """
        with self._ending:
            if self._process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
                deadline = time.monotonic() + GONE_SECONDS
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    while time.monotonic() < deadline:
                        os.killpg(self._process.pid, 0)
                        time.sleep(0.005)
            if self._lifeline >= 0:
                os.close(self._lifeline)
                self._lifeline = -1
        return self._process.returncode or 0

    def close(self) -> None:
        """Close its pipes, after its end."""
        for pipe in (self.input, self.output):
            with contextlib.suppress(BrokenPipeError):
                pipe.close()


def is_last(message: Message) -> bool:
    """Return True for the message after which an order is done."""
    return "result" in message or "fault" in message


class Children:
    """Starts children with so many threads, of a module that calls `do_orders`, and keeps one spare."""

    def __init__(
        self, threads: int = 1, module: str = "service.process", *arguments: str, orders: float = ORDERS,
        **environment: str,
    ) -> None:  # fmt: skip
        self.stopping, self.starts = threading.Event(), 0
        self._command, self._orders = (module, *arguments), orders
        self._environment = environment | {"OMP_NUM_THREADS": f"{threads}", "OPENBLAS_NUM_THREADS": f"{threads}"}
        self._lock, self._running = threading.Lock(), set[Child]()
        self._spare: Child | None = self._start()

    def _start(self) -> Child:
        self.starts += 1
        return Child(*self._command, **self._environment)

    def count(self) -> int:
        """Return the number of children that work."""
        return len(self._running)

    def is_ready(self) -> bool:
        """Return True if the spare lives, or is at a check; else start a new one."""
        with self._lock:
            is_ready = bool(self._running) if self._spare is None else self._spare.is_alive()
        if not is_ready:
            self._keep(None)
        return is_ready

    def run(
        self, order: Message, seconds: float, take: Callable[[Message], None] = lambda _: None,
        why_end: Callable[[], str] = lambda: "", *, reusable: bool = False,
    ) -> Ending:  # fmt: skip
        """Run an order, `take` its messages, and return how it ended: by itself, a limit of seconds, or a reason.

        A child that is not reusable is ended with its group.
        """
        child, last = self._take(), None
        if not reusable:
            self._keep(None)  # for checks beside it, and for the next job
        deadline, late = time.monotonic() + seconds, f"it took more than {seconds:g} s"

        def reason_now() -> str:
            if self.stopping.is_set():
                return "the server stops"
            return late if time.monotonic() > deadline else why_end()

        reasons = list[str]()
        try:
            with child.watched(reason_now) as reasons:
                for message in child.messages(order):
                    if is_last(message):
                        last = message
                    else:
                        take(message)
        finally:
            if last is not None and reusable and not reasons and child.orders < self._orders:
                self._keep(child)
                status = 0
            else:
                status = child.end()
                child.close()
                self._keep(None)
            with self._lock:
                self._running.discard(child)
        if last is not None:
            return Ending(last)
        ending = f"signal {-status}" if status < 0 else f"status {status}"
        was_killed = reasons == [STOPPED] or (not reasons and status == -signal.SIGKILL)
        return Ending(None, "".join(reasons) or f"its process ended with {ending}", was_killed, reasons == [late])

    def result_of(self, order: Message, seconds: float, argument: str) -> Message:
        """Return the result of an order that a request waits for. After a kill from outside it is sent again.

        All tries together have the seconds.
        """
        deadline = time.monotonic() + seconds
        ending = self.run(order, seconds, reusable=True)
        for _ in range(TRIES - 1):
            if ending.was_killed and (left := deadline - time.monotonic()) > 0:
                ending = self.run(order, left, reusable=True)
        if ending.last is not None:
            if "fault" in ending.last:
                raise Fault(ending.last["fault"])
            return ending.last["result"]
        if self.stopping.is_set() or ending.was_killed:
            raise Busy(
                argument, expected="a process that works on it", got="one that was ended", hint="send it again"
            )
        error = OutOfTime if ending.was_late else InvalidRequest
        raise error(
            argument, expected="a file that its reader can take", got=ending.reason,
            hint="it may be broken, or need more memory or time than an upload may take",
        )  # fmt: skip

    def stop(self) -> None:
        """End every child."""
        self.stopping.set()
        with self._lock:
            children, spare, self._spare = [*self._running], self._spare, None
        for child in children:  # `run` closes them
            child.end()
        if spare is not None:
            spare.end()
            spare.close()

    def _take(self) -> Child:
        """Return the spare, or a new child while none lives."""
        with self._lock:
            if self.stopping.is_set():
                raise Busy("server", expected="a running server", got="one that stops", hint="send it again")
            child, self._spare = self._spare, None
            if child is not None and not child.is_alive():
                child.end()
                child.close()
                child = None
            try:
                child = child or self._start()
            except OSError as error:
                got = f"none: {error.strerror}"
                raise Busy("server", expected="room for a process", got=got, hint="send it again") from None
            self._running.add(child)
        return child

    def _keep(self, child: Child | None) -> None:
        """Make a child, or a new one, the spare; end it if there is one."""
        with self._lock:
            if not self.stopping.is_set() and (self._spare is None or not self._spare.is_alive()):
                dead, self._spare = self._spare, child
                with contextlib.suppress(OSError):  # no room for a process: the next order tries again
                    self._spare = child or self._start()
                child = dead
        if child is not None:
            child.end()
            child.close()


# The child's side


def arm(lifeline: int, group: int) -> None:
    """Let the kernel end a process group when the writing end of a pipe closes, even within a call that blocks."""
    fcntl.fcntl(lifeline, fcntl.F_SETOWN, -group)
    fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)


def end_with_parent(lifeline: int) -> None:
    """End this process, and the group that it leads, when the other end of its lifeline closes."""
    arm(lifeline, os.getpid())

    def wait() -> None:  # the pipe may have closed before
        os.read(lifeline, 1)
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=wait, daemon=True).start()


def own_stdout() -> BinaryIO:
    """Return the pipe to the server, for messages only; what libraries print goes to stderr from now on."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return out


class Reporter:
    """Write messages as JSON lines; of progress the begin and the end of each stage, four a second between."""

    def __init__(self, out: BinaryIO) -> None:
        self._out, self._turn, self._stage, self._at = out, threading.Lock(), "", 0.0

    def __call__(self, stage: str, completed: int, total: int, unit: str) -> None:
        """Report progress (`liftcore.runtime.progress.Progress`)."""
        now = time.monotonic()
        if stage == self._stage and completed < total and now - self._at < 0.25:
            return
        self._stage, self._at = stage, now
        self.say({"progress": {"stage": stage, "completed": completed, "total": total, "unit": unit}})

    def say(self, message: Message) -> None:
        """Write one message."""
        with self._turn:
            self._out.write(json.dumps(message).encode() + b"\n")
            self._out.flush()


def limit_memory(count: int | None) -> None:
    """Limit private memory to what this process has now, of its imports, and so many bytes; None: no limit."""
    hard = limit = resource.getrlimit(resource.RLIMIT_DATA)[1]
    if count is not None:
        lines = Path("/proc/self/status").read_text().splitlines()
        limit = count + next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmData:"))
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


def run(tasks: Any, order: Message, report: Reporter) -> Message:
    """Do the work of an order by the task of its name; return its last message."""
    os.environ["TMPDIR"] = tempfile.tempdir = order["scratch"]
    names = order["names"] | {order["scratch"]: "the server's temporary folder"}
    try:
        limit_memory(order.get("memory"))
        return {"result": getattr(tasks, order["task"])(order, report)}
    except MemoryError:
        return {"fault": fault_of(InvalidRequest(order["kind"], expected="one that fits the memory", got="more"))}
    except Exception as error:
        cause = error.__cause__ or error  # a lift in blocks wraps the error of a full folder
        if isinstance(cause, OSError) and cause.errno in FULL:
            hint = "delete assets or lifts, or ask the operator for room; then send it again"
            return {"fault": fault_of(NoSpace("data", expected="room on the disk", got="a full disk", hint=hint))}
        if isinstance(error, SplatliftError):
            return {"fault": fault_of(error, names)}
        if order["kind"] != "query":
            raise
        traceback.print_exc()  # to the server's log; what is open stays for other questions
        return {"fault": fault_of(ProcessDied("query", expected="an answer", got="an error of the server"))}


def do_orders(open_tasks: Callable[[], Any]) -> None:
    """Import what tasks need, then do orders until the server has ended: by a module, or the methods of an object."""
    end_with_parent(int(sys.argv[1]))
    report = Reporter(own_stdout())
    with contextlib.suppress(OSError):  # if memory runs out, the kernel ends this process rather than the server
        Path("/proc/self/oom_score_adj").write_text("500")
    tasks = open_tasks()
    for line in sys.stdin.buffer:
        report.say({})  # it began: what dies before this died as a spare
        report.say(run(tasks, json.loads(line), report))
    os._exit(0)  # skip the exit handlers of libraries


if __name__ == "__main__":
    do_orders(lambda: importlib.import_module(TASKS))
