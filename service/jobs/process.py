"""A child process of one job, as the thread that runs the job holds it."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from service.jobs.overheard import log_lines

PIECE = 1 << 16
GONE_SECONDS = 3.0  # the kernel takes a moment to end a group


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
            env=os.environ | dict(environment),
        )
        assert self._process.stdout is not None and self._process.stderr is not None
        self._overheard = log_lines(self._process.stderr, job)
        self._pipe = self._process.stdout.fileno()
        self._open = True
        self._rest = b""
        self._status: int | None = None
        os.set_blocking(self._pipe, False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.end()

    @property
    def pid(self) -> int:
        """The child's process id, which is also its group's."""
        return self._process.pid

    def listen(self, seconds: float) -> list[dict[str, Any]]:
        """What the child says; returns at its first words, at its end, or after so many seconds."""
        if not self._open:
            time.sleep(seconds)
            return []
        if not select.select([self._pipe], [], [], seconds)[0]:
            return []
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(self._pipe, PIECE):
                self._rest += piece
            self._open = False
        *lines, self._rest = self._rest.split(b"\n")  # a half line at the end is what a killed writer leaves
        return [json.loads(line) for line in lines]

    def ended(self) -> bool:
        """Whether the child itself has ended."""
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None

    def private_bytes(self) -> int:
        """Memory of the child and of all that it started, but for mapped files. 0 where Linux does not tell."""
        return sum(_private_bytes(pid) for pid in _family(self.pid))

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
            self._overheard.join(GONE_SECONDS)
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


def _private_bytes(pid: int) -> int:
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("RssAnon:"):
                return int(line.split()[1]) << 10
    return 0


def _processor_seconds(pid: int) -> float:
    with contextlib.suppress(OSError):
        behind_its_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, behind_its_name[11:13])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def _family(pid: int) -> Iterator[int]:
    """A process and what it started, as far as Linux tells; whoever ends meanwhile is left out."""
    yield pid
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():  # a process is the child of the thread that began it
            with contextlib.suppress(OSError):
                for child in (task / "children").read_text().split():
                    yield from _family(int(child))
