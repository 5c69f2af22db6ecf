"""A child process of one job, as the supervisor holds it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

GRACE_SECONDS = 3.0


class JobProcess:
    """Started with an order, read for messages, and ended with its whole process group."""

    def __init__(self, order: dict[str, Any], scratch: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "service.jobs.child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            env=os.environ | {"TMPDIR": str(scratch)},
        )
        # The number of a group is ours only until its leader is reaped, so signals and the reaping exclude
        # each other.
        self._reaping = threading.Lock()
        self._reaped = threading.Event()
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it died at once; the missing messages tell
            self._process.stdin.write(json.dumps(order).encode() + b"\n")
            self._process.stdin.flush()

    @property
    def pid(self) -> int:
        """The child's process id, which is also its group's."""
        return self._process.pid

    def messages(self) -> Iterator[dict[str, Any]]:
        """What the child says, until it closes its end."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.endswith(b"\n"):  # a half line is what a killed writer leaves
                yield json.loads(line)

    def wait(self) -> int:
        """The exit status; negative for the signal that ended it. Nothing of the group is left after this."""
        os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT)
        with self._reaping:
            os.killpg(self._process.pid, signal.SIGKILL)  # what the child itself may have started
            status = self._process.wait()
            self._reaped.set()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(BrokenPipeError):  # an order that was never read
                pipe.close()
        return status

    def stop(self) -> None:
        """End the process group: politely, then not. Another thread waits for the end."""
        self._signal(signal.SIGTERM)
        if not self._reaped.wait(GRACE_SECONDS):
            self._signal(signal.SIGKILL)

    def kill(self) -> None:
        """End the process group at once."""
        self._signal(signal.SIGKILL)

    def _signal(self, number: signal.Signals) -> None:
        with self._reaping:
            if not self._reaped.is_set():
                os.killpg(self._process.pid, number)
