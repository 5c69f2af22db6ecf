"""A child process of one job, as the thread that runs the job holds it."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Self

from service.child import Messages, children_of, memory_of
from service.observe import current_id, working_for

GONE_SECONDS = 3.0  # the kernel takes a moment to end a group
LONGEST = 8192  # bytes of a record of the log; what is longer without an end of line comes in pieces
MARK = "SPLATLIFT_JOB_PROCESS"  # a job's processes carry its id under this name, for who looks at a machine

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class JobLimits:
    """What jobs may take, and how their processes are watched."""

    parallel: int = 1  # jobs at the same time
    threads: int | None = None  # of a job; None shares the cores out
    seconds: float = 86_400.0  # wall time of an attempt
    memory_bytes: int | None = None  # private memory of a job's processes; None sets no limit
    lease_seconds: float = 30.0  # silence after which an attempt is lost, unless it computes
    engine: str | None = None  # who lifts in blocks; None: lifts are made in memory
    ray_address: str = "auto"  # of that cluster
    checkpoint_seconds: float = 2.0  # work that a killed lift may lose, beside the views in work


class JobProcess:
    """Started in a process group of its own, heard in JSON lines, and ended with its whole group.

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
        self._printed = log_lines(self._process.stderr, job)
        self.listen = Messages(self._process.stdout.fileno()).read
        self._status: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.end()

    @property
    def pid(self) -> int:
        """The child's process id, which is also its group's."""
        return self._process.pid

    def ended(self) -> bool:
        """Whether the child itself has ended."""
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None

    def private_bytes(self) -> int:
        """Memory of the child and of all that it started, but for mapped files. 0 where Linux does not tell."""
        return sum(memory_of(pid, "RssAnon") for pid in _family(self.pid))

    def processor_seconds(self) -> float:
        """Of the child and of all that it started and that runs still. 0 where Linux does not tell."""
        return sum(_processor_seconds(pid) for pid in _family(self.pid))

    def end(self) -> int:
        """End the whole group at once; the child's exit status, negative for a signal. No process is left after this.

        The child writes drafts and checkpoints only, and those are whole or absent, so nothing is lost by haste.
        """
        if self._status is None:
            # The leader is not reaped yet, so the number of the group is still ours.
            os.killpg(self.pid, signal.SIGKILL)
            self._status = self._process.wait()
            self._await_group()
            self._printed.join(GONE_SECONDS)
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
    """Log each line that comes through a pipe as a warning, until its other ends are closed; the thread that does.

    The records have the job's id, and that of the request that this thread works for.
    """
    request = current_id()

    def listen() -> None:
        with pipe, working_for(request):
            while line := pipe.readline(LONGEST):
                text = line.decode("utf-8", "replace").strip()
                if text:
                    log.warning("%s", text, extra={"fields": {"job": job}})

    thread = threading.Thread(target=listen, name=f"printed-{job}", daemon=True)
    thread.start()
    return thread


def _processor_seconds(pid: int) -> float:
    with contextlib.suppress(OSError):
        behind_its_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, behind_its_name[11:13])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def _family(pid: int) -> Iterator[int]:
    """A process and what it started, as far as Linux tells; whoever ends meanwhile is left out."""
    yield pid
    for child in children_of(pid):
        yield from _family(child)
