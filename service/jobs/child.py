"""The process of one job: reads its order, lifts, and says how it goes in JSON lines on stdout.

Run as ``python -m service.jobs.child ORDER``, with a JSON file. Messages are ``{"event": "progress", ...}`` and
``{"event": "beat"}``, any number of times, then one ``{"event": "done", ...}`` or ``{"event": "fault", ...}``. It
writes nothing but its draft and its checkpoint, so whatever ends it leaves no half a result behind. It ends by
itself when its stdin closes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any, BinaryIO

from liftcore.artifact import save_lift
from liftcore.errors import SplatliftError
from liftcore.lift import lift
from liftcore.solve.checkpoint import Checkpoint
from liftcore.solve.settings import LiftSettings
from service.errors import OverLimit
from service.faults import fault_of

NICENESS = 10  # queries come first: beside one, a lift gets a tenth of a core
FIRST_TO_GO = 500  # when the machine runs out of memory, this process is ended rather than the server
SECONDS_BETWEEN_BEATS = 1.0
SECONDS_BETWEEN_WORDS = 0.25


class Reporter:
    """Progress as JSON lines: every new stage and every end of one, and now and then in between."""

    def __init__(self, out: BinaryIO) -> None:
        self._out = out
        self._stage = ""
        self._last = 0.0
        self._turn = threading.Lock()  # one message at a time

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        """Say how far the work is (`liftcore.progress.Progress`)."""
        now = time.monotonic()
        if stage == self._stage and done < total and now - self._last < SECONDS_BETWEEN_WORDS:
            return
        self._stage, self._last = stage, now
        self.say({"event": "progress", "stage": stage, "done": done, "total": total, "unit": unit})

    def say(self, message: dict[str, Any]) -> None:
        """Write one message."""
        with self._turn:
            self._out.write(json.dumps(message).encode() + b"\n")
            self._out.flush()

    def beat(self) -> None:
        """Say for ever that this process is alive."""
        while True:
            self.say({"event": "beat"})
            time.sleep(SECONDS_BETWEEN_BEATS)


def run(order: dict[str, Any], report: Reporter) -> dict[str, Any]:
    """Do the lift of an order and save it.

    Returns:
        The last message.
    """
    try:
        made = lift(
            Path(order["splats"]),
            Path(order["cameras"]),
            [Path(path) for path in order["features"]],
            LiftSettings.of(**order["settings"]),
            threads=order["threads"],
            progress=report,
            checkpoint=Checkpoint(Path(order["work"]), order["checkpoint_seconds"]),
        )
        output = Path(order["output"])
        save_lift(made, output)
    except SplatliftError as error:
        return {"event": "fault", "fault": fault_of(error, order["names"])}
    except MemoryError:
        error = OverLimit("lift", expected="a lift that fits this machine's memory", got="one that needs more")
        return {"event": "fault", "fault": fault_of(error)}
    return {
        "event": "done",
        "sha256": _sha256(output),
        "count": made.features.shape[0],
        "channels": made.features.shape[1],
        # Through JSON and not model_dump: what is not finite must become null before it reaches a client.
        "metadata": json.loads(made.metadata.model_dump_json()),
    }


def _sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def _end_with_parent(stdin: BinaryIO) -> None:
    stdin.read()  # returns when the server's end of the pipe closes, however the server ended
    os._exit(3)


def main() -> None:
    """Run one job."""
    # Libraries may print; the pipe is for messages only.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    stdin = os.fdopen(os.dup(0), "rb", buffering=0)
    threading.Thread(target=_end_with_parent, args=(stdin,), daemon=True).start()
    report = Reporter(out)
    threading.Thread(target=report.beat, daemon=True).start()
    os.nice(NICENESS)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(FIRST_TO_GO))
    report.say(run(json.loads(Path(sys.argv[1]).read_bytes()), report))


if __name__ == "__main__":
    main()
