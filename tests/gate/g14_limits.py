"""Children that take too long, hang or eat memory: each ends at its limit, and the HTTP process goes on.

python -m tests.gate.g14_limits
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import time
from pathlib import Path

from tests.gate.running import Service, Verdicts, run_gate
from tests.gate.scenes import long_scene, scene, small_scene

JOB_TIME, CHECK_MEMORY, CHECK_TIME = "job_seconds", "check_memory_bytes", "check_seconds"  # settings of the service
MIB = 1 << 20
IMPORT_SECONDS = 20.0  # in which a new spare imports, and then rests


def gate(_: argparse.Namespace, folder: Path, verdicts: Verdicts) -> None:
    """Meet each limit on a server of its own."""
    with Service(folder / "time", **{JOB_TIME: 1}) as service:
        work = scene(splats=60_000, views=40, width=480, channels=64)  # of a minute
        record = service.wait_for(service.order(service.upload(work)))
        problem = record["problem"] or {}
        is_failed = record["state"] == "failed" and "s" in problem.get("detail", "")
        detail = problem.get("detail", record["state"])
        verdicts.check("a job over its limit fails, and says so (s)", is_failed, detail)
        deadline = time.monotonic() + IMPORT_SECONDS
        while at_work := [pid for pid in service.children() if is_computing(pid)]:
            if time.monotonic() > deadline:
                break
        verdicts.check("no process of it computes on", not at_work, len(at_work))
        verdicts.check_rest(service)
    with Service(folder / "hang", **{JOB_TIME: 120}) as service:
        job = service.order(service.upload(long_scene()))
        service.wait_for(job, "running")
        time.sleep(1)
        hanging = service.children()
        send_signal(hanging, signal.SIGSTOP)
        state = service.wait_for(job)["state"]
        verdicts.check("a job whose processes hang ends", state in ("succeeded", "failed"), state)
        send_signal(hanging, signal.SIGCONT)  # what serves questions may have been among them
        record = service.wait_for(service.order(service.upload(small_scene())))
        verdicts.check("the next job succeeds", record["state"] == "succeeded", record["state"])
    large = scene(splats=600_000, views=1, width=32, channels=8)["splats"]
    for word, settings in {"memory": {CHECK_MEMORY: 16 * MIB}, "s": {CHECK_TIME: 0.05}}.items():
        with Service(folder / f"check-{word}", **settings) as service:
            reply = service.client.put("/assets/splats", content=large)
            detail = reply.json().get("detail", "")
            is_refused = reply.status_code == 422 and word in detail
            figures = f"{reply.status_code}: {detail[:90]}"
            verdicts.check(f"a check over its limit is refused, and says so ({word})", is_refused, figures)
            verdicts.check_rest(service)


def send_signal(pids: set[int], number: signal.Signals) -> None:
    """Send a signal to each that still lives."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


def is_computing(pid: int) -> bool:
    """Return True if a process takes processor time within a second."""
    path = Path(f"/proc/{pid}/stat")
    try:
        ticks = [path.read_text().rpartition(")")[2].split()[11:13]]
        time.sleep(1)
        ticks.append(path.read_text().rpartition(")")[2].split()[11:13])
    except OSError:
        return False
    return int(ticks[1][0]) + int(ticks[1][1]) - int(ticks[0][0]) - int(ticks[0][1]) > 50


if __name__ == "__main__":
    run_gate(gate, __doc__)
