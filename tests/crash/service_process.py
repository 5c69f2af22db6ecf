"""A server process as a client and a killer see it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Self

import httpx
from safetensors.numpy import load

from service.child import children_of
from service.supervisor import MARK

ROOT = Path(__file__).parents[2]
PATIENCE_SECONDS = 1800.0  # of a machine that has other things to do: no promise is about time here
FINAL_STATES = ("succeeded", "failed", "canceled")


class ServiceProcess:
    """Runs ``tests.crash.server`` over a data directory; may be killed and started again."""

    def __init__(self, data: Path, *options: str) -> None:
        self._data = data
        self._process: subprocess.Popen[str] | None = None
        # No connection is used twice: one that lay idle may be closed in the moment in which it is taken up again.
        self.client = httpx.Client(timeout=PATIENCE_SECONDS, limits=httpx.Limits(max_keepalive_connections=0))
        self.start(*options)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.kill()
        self.client.close()

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def start(self, *options: str) -> None:
        """Start, and wait until it listens."""
        command = [sys.executable, "-m", "tests.crash.server", str(self._data), *options]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment)
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line.startswith("listening on "), line
        self.client.base_url = line.split()[-1]

    def kill(self) -> None:
        """SIGKILL, and wait for the end."""
        assert self._process is not None and self._process.stdout is not None
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()

    def has_died(self) -> bool:
        """Return True if it has died; a request may also be cut off while it lives."""
        assert self._process is not None
        return self._process.poll() is not None

    def wait(self) -> int:
        """Wait until it has died by itself."""
        assert self._process is not None and self._process.stdout is not None
        status = self._process.wait(PATIENCE_SECONDS)
        self._process.stdout.close()
        return status

    def order(self, body: dict[str, Any], key: str, route: str = "/lift") -> str | None:
        """Order a lift, or what the route is for; the job's id, None when the server died over it."""
        try:
            reply = self.client.post(route, json=body, headers={"Idempotency-Key": key})
        except httpx.TransportError:
            return None
        assert reply.status_code in (200, 202), reply.text
        return reply.json()["id"]

    def job(self, job: str) -> dict[str, Any]:
        """The job as it is now."""
        return self.client.get(f"/jobs/{job}").json()

    def wait_until_ended(self, job: str) -> dict[str, Any]:
        """The job once it has ended."""
        deadline = time.monotonic() + PATIENCE_SECONDS
        while (job_document := self.job(job))["state"] not in FINAL_STATES:
            assert time.monotonic() < deadline, job_document
            time.sleep(0.05)
        return job_document

    def times_succeeded(self, job: str) -> int:
        """Return the number of the job's events with the state succeeded."""
        story = self.client.get(f"/jobs/{job}/events").text
        return story.count('"state":"succeeded"')

    def digest(self, job: str) -> str:
        """The digest of a lift's tensors and diagnostics: all that does not tell of time."""
        tensors = load(self.client.get(f"/lifts/{job}/features").content)
        total = hashlib.sha256()
        for name in sorted(tensors):
            total.update(f"{name} {tensors[name].dtype} {tensors[name].shape}".encode() + tensors[name].tobytes())
        diagnostics = self.client.get(f"/lifts/{job}").json()["diagnostics"]
        total.update(json.dumps(diagnostics, sort_keys=True).encode())
        return total.hexdigest()


def processes_of(job: str) -> list[int]:
    """The processes that carry the mark of a job."""
    processes = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            if f"{MARK}={job}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                processes.append(int(entry.name))
    return processes


def template_of(server: int) -> int:
    """The process that a server's checks are forked from."""
    for child in children_of(server):
        with contextlib.suppress(OSError):
            if b"multiprocessing.forkserver" in Path(f"/proc/{child}/cmdline").read_bytes():
                return child
    raise AssertionError("none runs")


def kill_processes_of(job: str) -> int:
    """SIGKILL them; how many there were."""
    processes = processes_of(job)
    for pid in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return len(processes)


def usage(pid: int) -> dict[str, int]:
    """File descriptors, threads and resident kilobytes of a process."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return {
        "descriptors": len(list(Path(f"/proc/{pid}/fd").iterdir())),
        "threads": int(status["Threads"]),
        "resident_kb": int(status["VmRSS"].split()[0]),
    }
