"""Run one job in a child process: read the order, do it, and report progress as JSON lines on stdout.

Run as ``python -m service.job_child ORDER``, with a JSON file. Messages are ``{"event": "progress", ...}``,
``{"event": "plan", ...}`` and ``{"event": "beat"}``, any number of times, then one ``{"event": "done", ...}`` or
``{"event": "fault", ...}``. It writes nothing but its draft and its checkpoint, so whatever ends it leaves no half a
result behind. When its stdin closes it ends by itself, with all that it started.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from liftcore.errors import SplatliftError
from service.child import end_with_parent, fault_of, line_of, own_stdout
from service.errors import NoSpace, OverLimit
from service.models import JobKind

SECONDS_BETWEEN_BEATS = 1.0
SECONDS_BETWEEN_WORDS = 0.25
NICENESS = 10  # queries have priority: beside one, a lift gets a tenth of a core
FIRST_TO_GO = 500  # if memory runs out, the kernel ends this process rather than the server


class Reporter:
    """Write progress and other messages as JSON lines: the begin and the end of each stage, four a second between."""

    def __init__(self, out: BinaryIO) -> None:
        self._out = out
        self._stage = ""
        self._last = 0.0
        self._turn = threading.Lock()  # one message at a time

    def __call__(self, stage: str, completed: int, total: int, unit: str) -> None:
        """Report progress (`liftcore.runtime.progress.Progress`)."""
        now = time.monotonic()
        if stage == self._stage and completed < total and now - self._last < SECONDS_BETWEEN_WORDS:
            return
        self._stage, self._last = stage, now
        self.say({"event": "progress", "stage": stage, "completed": completed, "total": total, "unit": unit})

    def plan(self, plan: dict[str, Any]) -> None:
        """Report the plan of the work, as `service.models.Plan` has it."""
        self.say({"event": "plan", "plan": plan})

    def say(self, message: dict[str, Any]) -> None:
        """Write one message."""
        with self._turn:
            self._out.write(line_of(message))
            self._out.flush()

    def beat(self) -> None:
        """Send a heartbeat every second, for ever."""
        while True:
            self.say({"event": "beat"})
            time.sleep(SECONDS_BETWEEN_BEATS)


Work = Callable[[dict[str, Any], Reporter], dict[str, Any]]  # takes an order, returns the fields of its result


def work_of(kind: JobKind) -> Work:
    """Return the function for jobs of that kind, imported while heartbeats run."""
    from service import tasks

    return tasks.compare_as_ordered if kind is JobKind.TRADEOFF else tasks.lift_as_ordered


def run(order: dict[str, Any], report: Reporter) -> dict[str, Any]:
    """Do the work of an order.

    Returns:
        The last message.
    """
    kind = JobKind(order["kind"])
    order["names"][tempfile.gettempdir()] = "the server's temporary folder"
    order["names"][str(Path(order["work"]).resolve())] = "the job's folder"
    try:
        return {"event": "done", **work_of(kind)(order, report)}
    except (SplatliftError, OSError) as error:
        cause = error.__cause__ or error  # a lift in blocks wraps the error of a full folder
        if not isinstance(cause, OSError) or cause.errno not in (errno.ENOSPC, errno.EDQUOT):
            if isinstance(error, SplatliftError):
                return {"event": "fault", "fault": fault_of(error, order["names"])}
            raise
        full = NoSpace(
            kind, expected=f"room on the server's disk for a {kind}", got="a full disk",
            hint="delete assets, or jobs with their lifts, or ask the operator for room; then order it again",
        )  # fmt: skip
        return {"event": "fault", "fault": fault_of(full)}
    except MemoryError:
        error = OverLimit(kind, expected=f"a {kind} that fits this machine's memory", got="one that needs more")
        return {"event": "fault", "fault": fault_of(error)}


def main() -> None:
    """Run one job."""
    out = own_stdout()
    end_with_parent(sys.stdin.fileno())
    report = Reporter(out)
    threading.Thread(target=report.beat, daemon=True).start()
    os.nice(NICENESS)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(FIRST_TO_GO))
    report.say(run(json.loads(Path(sys.argv[1]).read_bytes()), report))


if __name__ == "__main__":
    main()
