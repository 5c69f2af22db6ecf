"""Run queued jobs, each in a child process, some at the same time.

An attempt at a job is a child process, the conversation with it, and what comes of it.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Self

from liftcore.errors import SplatliftError
from service.child import Messages, children_of, fault_of, memory_of
from service.errors import NoSpace, OverLimit, ProcessDied
from service.models import FINAL_STATES, JobKind, JobState
from service.observe import current_id, working_for
from service.store.assets import kernel_of
from service.store.jobs import LOG_LINES, EventKind, JobRecord, labels_of
from service.store.lifts import FinishedLift, FinishedTradeoff
from service.store.owners import SERVICE
from service.store.store import Store

IDLE_SECONDS = 5.0  # the longest delay after a missed wake-up
TROUBLED_SECONDS = (1.0, 30.0)  # first and longest pause after an attempt that failed by an error of the server
ROOM_SECONDS = 60.0  # the longest wait for free disk before an attempt
TICK_SECONDS = 0.2  # the delay after a cancel, a stop or a limit
RETRY_SECONDS = 1.0  # between attempts to write to the database
LEASE_POLLS = 4  # polls of a silent child during its lease
BUSY_SECONDS = 0.1  # of CPU time: a silent child that used so much is alive
CHILD = (sys.executable, "-m", "service.job_child")
DRAFTS = {JobKind.LIFT: ".safetensors", JobKind.TRADEOFF: ".png"}  # suffix of a child's output
GONE_SECONDS = 3.0  # for the kernel to end a process group
LONGEST = 8192  # bytes of a log record; longer lines are split
MARK = "SPLATLIFT_JOB_PROCESS"  # environment variable with the job's id, to identify processes
TRANSIENT_ERRORS = (OSError, sqlite3.OperationalError)  # errors of the server: a full disk, a locked database

log = logging.getLogger(__name__)
process_log = logging.getLogger("service.jobs.process")  # output of job processes

Clock = Callable[[], float]  # returns seconds


class Supervisor:
    """Threads that run jobs, one each. Only they change a job after it was submitted or canceled.

    Args:
        store: that holds the jobs.
        limits: of their resources.
        command: of their processes.
        clock: by which leases are measured.
    """

    def __init__(
        self, store: Store, limits: JobLimits, *, command: Sequence[str] = CHILD, clock: Clock = time.monotonic
    ) -> None:
        self._store = store
        self._limits = limits
        self._command = command
        self._clock = clock
        self._condition = threading.Condition()
        self._rung = 0
        self._stopping = threading.Event()
        self._callback: Callable[[str, float], None] | None = None
        self._beginning = threading.Lock()
        self._left_behind = True  # jobs of an earlier server may still be marked as running
        self._threads = [
            threading.Thread(target=self._loop, name=f"supervisor-{number}", daemon=True)
            for number in range(limits.parallel)
        ]

    def start(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def on_attempt_finished(self, callback: Callable[[str, float], None]) -> None:
        """Call `callback` after each attempt, with the state of its job and the seconds that it took."""
        self._callback = callback

    def alive(self) -> bool:
        """Return True if all threads live."""
        return all(thread.is_alive() for thread in self._threads)

    def wake(self) -> None:
        """Wake a thread: there is a new job."""
        with self._condition:
            self._rung += 1
            self._condition.notify_all()

    def stop(self) -> None:
        """End the running children and requeue their jobs; return when no child is left."""
        self._stopping.set()
        self.wake()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()

    def _loop(self) -> None:
        troubled = 0  # consecutive attempts that failed by an error of the server
        while not self._stopping.is_set():
            rung = self._rung
            try:
                job = self._next()
                if job is not None:
                    troubled = 0 if self._run(job) else troubled + 1
                    self._pause(troubled)
                    continue
            except Exception:  # the thread must survive a full disk or a locked database
                log.exception("the supervisor stumbled")
            self._rest(rung)

    def _next(self) -> JobRecord | None:
        """Claim a job; before the first one, requeue those of an earlier server."""
        with self._beginning:
            if self._left_behind:
                self._store.jobs.release_all("the server died")
                self._left_behind = False
        return self._store.jobs.claim()

    def _rest(self, rung: int) -> None:
        """Wait for a wake-up after that one, for a stop, or for IDLE_SECONDS."""
        with self._condition:
            self._condition.wait_for(lambda: self._rung != rung or self._stopping.is_set(), IDLE_SECONDS)

    def _pause(self, troubled: int) -> None:
        """Wait while the server has errors: longer each time, then for free disk, though not for ever.

        A checkpoint of the next job may fill the disk.
        """
        first, longest = TROUBLED_SECONDS
        if troubled:
            self._stopping.wait(min(longest, first * 2 ** min(troubled - 1, 10)))
        until = time.monotonic() + ROOM_SECONDS
        while time.monotonic() < until and not self._stopping.is_set():
            try:
                self._store.files.require_room()
                return
            except (NoSpace, OSError):
                self._stopping.wait(first)

    def _run(self, job: JobRecord) -> bool:
        """Run a job; return True if its attempt was decided by the job itself."""
        start, attempts, kept_up = time.monotonic(), self._store.jobs, True
        with working_for(job.request_id):
            log.info("job %s, attempt %d begins", job.id, job.attempt)
            try:
                Attempt(job, self._store, self._limits, self._command, self._clock).run(self._stopping)
            except TRANSIENT_ERRORS as error:
                log.exception("job %s could not be kept up", job.id)
                kept_up, reason = False, f"the server could not keep it up: {error}"
                retry_until_committed(lambda: attempts.release(job.id, job.attempt, reason), self._stopping)
            except Exception as error:
                log.exception("job %s could not be run", job.id)
                unforeseen = ProcessDied("job", expected="a process that runs", got="an error of the server")
                fault = fault_of(error if isinstance(error, SplatliftError) else unforeseen)
                retry_until_committed(lambda: attempts.fail(job.id, job.attempt, fault), self._stopping)
            outcome, seconds = attempts.state(SERVICE, job.id) or "deleted", time.monotonic() - start
            log.info("job %s, attempt %d: %s after %.3f s", job.id, job.attempt, outcome, seconds)
        if self._callback is not None:
            self._callback(outcome, seconds)
        return kept_up


class Lease:
    """Lease of a child: it must write or compute now and then.

    Args:
        seconds: the longest time without either.
        clock: of these seconds.
    """

    def __init__(self, seconds: float, clock: Clock = time.monotonic) -> None:
        self._seconds = seconds
        self._clock = clock
        self._polled_at = clock()
        self.renew()

    def renew(self) -> None:
        """Renew the lease: the child gave a sign of life."""
        self._alive = self._clock()
        self._cpu_seconds: float | None = None  # CPU seconds when it was found silent

    def over(self, processor_seconds: Callable[[], float]) -> bool:
        """Return True if the lease is over; called several times in a lease.

        Args:
            processor_seconds: CPU time of the child. One call into a library (HDBSCAN on many splats) may keep
                all its threads from speaking.
        """
        now = self._clock()
        if now - self._polled_at > self._seconds / 2:
            self.renew()  # the server itself slept: restart the lease
        self._polled_at = now
        if now - self._alive > self._seconds / LEASE_POLLS:
            seconds = processor_seconds()
            if self._cpu_seconds is None or seconds < self._cpu_seconds:  # less if a process of the child has ended
                self._cpu_seconds = seconds
            elif seconds - self._cpu_seconds > BUSY_SECONDS:
                self.renew()
        return now - self._alive > self._seconds


class AttemptLog:
    """Reports of an attempt. If the database cannot be written now, they are written later."""

    def __init__(self, job: JobRecord, store: Store) -> None:
        self._job = job
        self._write = {
            EventKind.LOG: store.jobs.log,
            EventKind.PLAN: store.jobs.plan,
            EventKind.PROGRESS: store.jobs.advance,
        }
        self._waiting: deque[tuple[EventKind, Any]] = deque(maxlen=LOG_LINES)
        self._retry_at = 0.0

    def add(self, kind: EventKind, data: Any) -> None:
        """Keep a line of the log, the plan or the progress; of the last two the latest counts."""
        if kind is not EventKind.LOG:
            for earlier in [note for note in self._waiting if note[0] is kind]:
                self._waiting.remove(earlier)
        self._waiting.append((kind, data))
        self.write()

    def write(self) -> None:
        """Write the reports, unless a write failed a moment ago."""
        if not self._waiting or time.monotonic() < self._retry_at:
            return
        try:
            self.flush()
        except TRANSIENT_ERRORS as error:
            log.warning("the progress of job %s cannot be stored yet: %s", self._job.id, error)
            self._retry_at = time.monotonic() + RETRY_SECONDS

    def flush(self) -> None:
        """Write the reports.

        Raises:
            TRANSIENT_ERRORS: it cannot be written now, and waits on.
        """
        while self._waiting:
            kind, data = self._waiting[0]
            self._write[kind](self._job.id, self._job.attempt, data)
            self._waiting.popleft()


class Attempt:
    """One attempt at a job, in a thread of the supervisor. No other thread changes the job.

    Args:
        job: as it was claimed.
        store: that holds it.
        limits: of its resources.
        command: of the child, before the path of its order.
        clock: by which the child's lease is measured.
    """

    def __init__(self, job: JobRecord, store: Store, limits: JobLimits, command: Sequence[str], clock: Clock) -> None:
        self._job = job
        self._store = store
        self._limits = limits
        self._command = command
        self._lease = Lease(limits.lease_seconds, clock)
        self._begin = time.monotonic()
        self._notes = AttemptLog(job, store)
        self._pace = StagePace()
        self._answer: dict[str, Any] | None = None  # the last message of the child

    def run(self, stopping: threading.Event) -> None:
        """Run the child to the end of its process group; set the state that follows.

        Raises:
            TRANSIENT_ERRORS: the server could not keep it up; no process of it is left, and its state is as it was.
        """
        files = self._store.files
        with files.draft(DRAFTS[self._job.kind]) as draft, files.scratch() as scratch:
            order = scratch / "order.json"
            order.write_text(json.dumps(self._order(draft)), encoding="utf-8")
            self._log(f"attempt {self._job.attempt} begins{self._request()}{self._earlier_work()}")
            command, environment = [*self._command, str(order)], {"TMPDIR": str(scratch)}
            with JobProcess(command, environment, self._job.id) as process:
                reason = self._follow(process, stopping)
                status = process.end()
            retry_until_committed(
                lambda: self._settle(draft, reason or _describe_exit(status), stopping.is_set()), stopping
            )
        if self._store.jobs.state(SERVICE, self._job.id) in FINAL_STATES:
            files.forget_work(self._job.id)

    def _follow(self, process: JobProcess, stopping: threading.Event) -> str | SplatliftError | None:
        """Read messages until the child has ended or must end; return the reason if it must end, else None."""
        while True:
            has_ended = process.has_ended()  # before the last messages are read
            for message in process.listen(0 if has_ended else TICK_SECONDS):
                self._take(message)
            if has_ended:
                return None
            self._notes.write()
            reason = self._why_end(process)
            if reason is not None or stopping.is_set():
                return reason or "the server stops"

    def _take(self, message: dict[str, Any]) -> None:
        self._lease.renew()
        if message["event"] == "progress":
            if self._pace.begins(message):
                parts = f": {message['total']} {message['unit']}" if message["total"] > 1 else ""
                self._log(f"{message['stage']}{parts}")
            self._notes.add(EventKind.PROGRESS, self._pace.progress(message))
        elif message["event"] == "plan":
            self._notes.add(EventKind.PLAN, message["plan"])
        elif message["event"] != "beat":
            self._answer = message

    def _why_end(self, process: JobProcess) -> str | SplatliftError | None:
        limits, kind = self._limits, self._job.kind
        silent = self._lease.over(process.processor_seconds)
        if not self._is_wanted():
            return "it is canceled"
        if silent:
            return f"its process was silent for {limits.lease_seconds:g} s"
        if time.monotonic() - self._begin > limits.seconds:
            return OverLimit(
                kind, expected=f"a {kind} that takes at most {limits.seconds:g} s", got="one that takes more"
            )
        if limits.memory_bytes is not None and process.private_bytes() > limits.memory_bytes:
            return OverLimit(
                kind, expected=f"a {kind} that takes at most {limits.memory_bytes} bytes of memory",
                got="one that takes more", hint="fewer views, channels or splats take less",
            )  # fmt: skip
        return None

    def _is_wanted(self) -> bool:
        try:
            return self._store.jobs.state(SERVICE, self._job.id) is JobState.RUNNING
        except TRANSIENT_ERRORS:  # if the database cannot be read, the job cannot have been canceled
            return True

    def _settle(self, draft: Path, reason: str | SplatliftError, stopping: bool) -> None:
        """Record the result; no process of this attempt is left."""
        self._notes.flush()
        job, attempts, answer = self._job, self._store.jobs, self._answer or {"event": "none"}
        if answer["event"] == "done" and draft.exists():
            if not self._keep(draft, answer):
                attempts.lose(job.id, job.attempt, "it is canceled")
        elif answer["event"] == "fault" and answer["fault"]["kind"] == NoSpace.kind:
            attempts.lose(job.id, job.attempt, answer["fault"]["got"], answer["fault"])
        elif answer["event"] == "fault":
            attempts.fail(job.id, job.attempt, answer["fault"])
        elif isinstance(reason, SplatliftError):
            attempts.fail(job.id, job.attempt, fault_of(reason))
        elif stopping:
            attempts.release(job.id, job.attempt, "the server stops")
        else:
            log.warning("job %s, attempt %d: %s", job.id, job.attempt, reason)
            attempts.lose(job.id, job.attempt, reason)

    def _keep(self, draft: Path, answer: dict[str, Any]) -> bool:
        """Record the result and the job's success; return False if the attempt is no longer valid."""
        job, store = self._job, self._store
        if job.kind is JobKind.TRADEOFF:
            tradeoff = FinishedTradeoff(answer["document"], answer["page"], draft.read_bytes())
            return store.tradeoffs.finish(job.id, job.attempt, tradeoff)
        lift = FinishedLift(draft, answer["sha256"], answer["count"], answer["channels"], answer["metadata"])
        return store.lifts.finish(job.id, job.attempt, lift)

    def _log(self, text: str) -> None:
        self._notes.add(EventKind.LOG, text)

    def _request(self) -> str:
        return f", asked for by request {self._job.request_id}" if self._job.request_id else ""

    def _earlier_work(self) -> str:
        count = sum(1 for _ in self._store.files.work(self._job.id).rglob("*.safetensors"))
        return f", {count} files of earlier work are kept" if count else ""

    def _order(self, draft: Path) -> dict[str, Any]:
        job, files, store = self._job, self._store.files, self._store.assets
        assets = [store.get(SERVICE, name) for name in (job.splats, job.cameras, *job.features)]
        labels = [store.get(SERVICE, *label) for label in labels_of(job.parameters)]
        return {
            "kind": job.kind,
            "parameters": job.parameters,
            "splats": str(assets[0].path),
            "kernel": kernel_of(assets[0], job.settings),  # compiled kernels to load
            "cameras": str(assets[1].path),
            "features": [str(asset.path) for asset in assets[2:]],
            "labels": {str(asset.kind): str(asset.path) for asset in labels},
            "settings": job.settings,
            "threads": self._limits.threads,
            "work": str(files.work(job.id)),
            "checkpoint_seconds": self._limits.checkpoint_seconds,
            "engine": self._limits.engine,
            "ray_address": self._limits.ray_address,
            "output": str(draft),
            "file_names": {str(asset.path): asset.file_name for asset in assets},
            "names": {str(asset.path): f"{asset.kind} {asset.id}" for asset in (*assets, *labels)},
        }


class StagePace:
    """Estimate of the remaining seconds of a stage, from its speed so far."""

    def __init__(self) -> None:
        self._stage = ""
        self._begin = 0.0
        self._completed_at_begin = 0

    def begins(self, message: dict[str, Any]) -> bool:
        """Return True if a message is the first of another stage."""
        return message["stage"] != self._stage

    def progress(self, message: dict[str, Any]) -> dict[str, Any]:
        """Return the message as `service.models.Progress` has it."""
        now = time.monotonic()
        completed, total = message["completed"], message["total"]
        if self.begins(message):
            self._stage, self._begin, self._completed_at_begin = message["stage"], now, completed
        advanced = completed - self._completed_at_begin
        eta = (now - self._begin) / advanced * (total - completed) if advanced > 0 else None
        return {
            "stage": self._stage,
            "completed": completed,
            "total": total,
            "unit": message["unit"],
            "eta_s": None if eta is None else round(eta, 2),
        }


def retry_until_committed(note: Callable[[], None], stopping: threading.Event) -> None:
    """Record the end of an attempt, also after a long time with a full disk: else its job would seem to run for ever.

    A stop ends that; the next start then finds the job running, and puts it back in line.
    """
    while True:
        try:
            note()
            return
        except TRANSIENT_ERRORS as error:
            log.warning("the end of a job cannot be noted yet: %s", error)
            if stopping.is_set():
                raise
            stopping.wait(RETRY_SECONDS)


def _describe_exit(status: int) -> str:
    return f"its process ended with signal {-status}" if status < 0 else f"its process ended with status {status}"


# The child process of an attempt


@dataclass(frozen=True)
class JobLimits:
    """Limits of jobs and of their processes."""

    parallel: int = 1  # jobs at the same time
    threads: int | None = None  # of a job; None: divide the cores
    seconds: float = 86_400.0  # wall time of an attempt
    memory_bytes: int | None = None  # private memory of a job's processes; None sets no limit
    lease_seconds: float = 30.0  # silence after which an attempt is lost, unless it computes
    engine: str | None = None  # of lifts in blocks; None: lift in memory
    ray_address: str = "auto"  # of a Ray cluster
    checkpoint_seconds: float = 2.0  # work that a killed lift may lose, beside unfinished views


class JobProcess:
    """Child process of a job: it leads a process group, writes JSON lines, and ends with its group.

    What it prints on its standard error goes to the server's log, line by line. Its standard input is a lifeline: it
    closes when the server ends, however the server ends.
    """

    def __init__(self, command: Sequence[str], environment: Mapping[str, str], job: str) -> None:
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            env=os.environ | dict(environment) | {MARK: job},
        )
        assert self._process.stdout is not None and self._process.stderr is not None
        self._output = log_lines(self._process.stderr, job)
        self.listen = Messages(self._process.stdout.fileno()).read
        self._status: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.end()

    @property
    def pid(self) -> int:
        """The child's process id, also of its group."""
        return self._process.pid

    def has_ended(self) -> bool:
        """Return True if the child has ended."""
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None

    def private_bytes(self) -> int:
        """Return the memory of the child and its descendants without mapped files; 0 if Linux does not report it."""
        return sum(memory_of(pid, "RssAnon") for pid in _family(self.pid))

    def processor_seconds(self) -> float:
        """Return the CPU seconds of the child and its running descendants; 0 if Linux does not report it."""
        return sum(_processor_seconds(pid) for pid in _family(self.pid))

    def end(self) -> int:
        """Kill the whole group; return the child's exit status, negative for a signal. No process is left after this.

        The child writes drafts and checkpoints only, and those are whole or absent, so nothing is lost by haste.
        """
        if self._status is None:
            # the leader is not reaped yet, so the group's number is still valid
            os.killpg(self.pid, signal.SIGKILL)
            self._status = self._process.wait()
            self._await_group()
            self._output.join(GONE_SECONDS)
            for pipe in (self._process.stdin, self._process.stdout):
                assert pipe is not None
                pipe.close()
        return self._status

    def _await_group(self) -> None:
        deadline = time.monotonic() + GONE_SECONDS
        with contextlib.suppress(ProcessLookupError, PermissionError):
            while time.monotonic() < deadline:
                os.killpg(self.pid, 0)
                time.sleep(0.005)


def log_lines(pipe: IO[bytes], job: str) -> threading.Thread:
    """Log each line of a pipe as a warning until its other ends are closed; return the thread that does.

    The records have the job's id, and that of the request that this thread works for.
    """
    request = current_id()

    def listen() -> None:
        with pipe, working_for(request):
            while line := pipe.readline(LONGEST):
                text = line.decode("utf-8", "replace").strip()
                if text:
                    process_log.warning("%s", text, extra={"fields": {"job": job}})

    thread = threading.Thread(target=listen, name=f"printed-{job}", daemon=True)
    thread.start()
    return thread


def _processor_seconds(pid: int) -> float:
    with contextlib.suppress(OSError):
        behind_its_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, behind_its_name[11:13])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def _family(pid: int) -> Iterator[int]:
    """Yield a process and its descendants, as Linux reports them; those that end meanwhile are left out."""
    yield pid
    for child in children_of(pid):
        yield from _family(child)
