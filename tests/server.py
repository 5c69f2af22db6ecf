"""The service as tests start it, in a process of its own; known by HTTP, commands and the environment.

Settings have the names of `splatlift serve`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self, TypeVar

import httpx
from safetensors.numpy import load

from tests.promises.command_line import run

Result = TypeVar("Result")
ROOT = Path(__file__).parents[1]
PATIENCE_SECONDS = 900.0  # of a machine that has other things to do, kernels to compile among them
FINAL_STATES = ("succeeded", "failed", "canceled")
MARK = "SERVER_UNDER_TEST"  # in the environment of a server and of all that it starts


def until(condition: Callable[[], Result | None], seconds: float = PATIENCE_SECONDS) -> Result:
    """Wait until a condition holds: at once, but for a machine that has other things to do; return its value."""
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.02)
    return value


def wait_for_end(client: Any, job: str, *states: str) -> dict[str, Any]:
    """Poll the job at a path until it is in one of the states, or has ended; return it."""

    def final_job() -> dict[str, Any] | None:
        record = client.get(job).raise_for_status().json()
        return record if record["state"] in (*states, *FINAL_STATES) else None

    return until(final_job)


def digest_of_lift(client: Any, lift: str) -> str:
    """Return the digest of the tensors and diagnostics of the lift at a path: all that does not tell of time."""
    tensors = load(client.get(f"{lift}/features").content)
    total = hashlib.sha256()
    for name in sorted(tensors):
        total.update(f"{name} {tensors[name].dtype} {tensors[name].shape}".encode() + tensors[name].tobytes())
    total.update(json.dumps(client.get(lift).json()["diagnostics"], sort_keys=True).encode())
    return total.hexdigest()


def run_command(*arguments: str, data: Path, status: int = 0) -> str:
    """Run `splatlift ARGUMENTS --data DATA` in this process; it must end with a status; return what it prints."""
    reply = run(*arguments, "--data", data)
    assert reply.status == status, reply
    return reply.out + (reply.err if status else "")


class Server:
    """`splatlift serve` as a process, over a data directory; it may be killed and started again."""

    def __init__(self, data: Path, **settings: Any) -> None:
        self.data = data
        self._mark = uuid.uuid4().hex
        texts = {
            name: json.dumps(value) if isinstance(value, dict) else str(value)
            for name, value in {"data": data, **settings}.items()
        }
        self._environment = {f"SPLATLIFT_{name.upper()}": text for name, text in texts.items()}
        self._process: subprocess.Popen[str] | None = None
        # No connection is used twice: one that lay idle may be closed in the moment in which it is taken up again.
        self.client = httpx.Client(timeout=PATIENCE_SECONDS, limits=httpx.Limits(max_keepalive_connections=0))
        self.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        if self.is_alive():
            self.end(signal.SIGKILL)
        self.client.close()
        until(lambda: not self.processes())  # nothing outlives its server

    @property
    def pid(self) -> int:
        """Process id of the server."""
        assert self._process is not None
        return self._process.pid

    @property
    def log(self) -> Path:
        """The file with what the server says on stderr."""
        return self.data.with_name(f"{self.data.name}.log")

    def start(self) -> None:
        """Start, and wait until it listens."""
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("SPLATLIFT_")}
        environment = inherited | {"PYTHONPATH": str(ROOT), MARK: self._mark} | self._environment
        self.data.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("ab") as stderr:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "liftcore.cli", "serve", "--port", "0"],
                stdout=subprocess.PIPE, stderr=stderr, text=True, cwd=ROOT, env=environment,
            )  # fmt: skip
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        address = re.search(r'http://[^\s"]+', line)
        assert address is not None, line + self.log.read_text()
        self.client.base_url = address[0]

    def is_alive(self) -> bool:
        """Return True if it runs; a request may also be cut off while it lives."""
        return self._process is not None and self._process.poll() is None

    def end(self, number: signal.Signals) -> int:
        """Send a signal to the HTTP process, and wait until it has ended; return its exit status."""
        assert self._process is not None and self._process.stdout is not None
        self._process.send_signal(number)
        status = self._process.wait(PATIENCE_SECONDS)
        self._process.stdout.close()
        return status

    def processes(self) -> list[int]:
        """Return the ids of the server's process and of all that it started, by their environment."""
        marked_processes = f"{MARK}={self._mark}".encode()
        ids = []
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError, ValueError):
                if marked_processes in (entry / "environ").read_bytes().split(b"\0"):
                    ids.append(int(entry.name))
        return ids

    def kill_children(self) -> int:
        """SIGKILL what the server started; return the number of processes."""
        children = [pid for pid in self.processes() if pid != self.pid]
        for pid in children:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return len(children)
