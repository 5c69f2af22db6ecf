"""A server process with stand-ins as a client and a killer see it."""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path
from typing import Any

import httpx

from service.child import children_of
from service.supervisor import MARK
from tests.server import Server, digest_of_lift, wait_for_end


class ServiceProcess(Server):
    """Runs ``tests.crash.server`` over a data directory; may be killed and started again."""

    def __init__(self, data: Path, *options: str) -> None:
        super().__init__(data, command=("-m", "tests.crash.server", str(data)), options=options)

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
        return wait_for_end(self.client, f"/jobs/{job}")

    def times_succeeded(self, job: str) -> int:
        """Return the number of the job's events with the state succeeded."""
        story = self.client.get(f"/jobs/{job}/events").text
        return story.count('"state":"succeeded"')

    def digest(self, job: str) -> str:
        """The digest of a lift's tensors and diagnostics: all that does not tell of time."""
        return digest_of_lift(self.client, f"/lifts/{job}")


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
