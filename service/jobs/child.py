"""The process of one job: reads its order from stdin, lifts, and says how it goes in JSON lines on stdout.

Run as ``python -m service.jobs.child``. Messages are ``{"event": "progress", ...}``, any number of times,
then one ``{"event": "done", ...}`` or ``{"event": "fault", "fault": {...}}``. It writes nothing but its
draft, so whatever ends it leaves nothing behind.
"""

from __future__ import annotations

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
from liftcore.solve.settings import LiftSettings
from service.faults import fault_of

NICENESS = 5  # queries come first
SECONDS_BETWEEN_WORDS = 0.25


class Reporter:
    """Progress as JSON lines: every new stage and every end of one, and now and then in between."""

    def __init__(self, out: BinaryIO) -> None:
        self._out = out
        self._stage = ""
        self._last = 0.0

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        """Say how far the work is (`liftcore.progress.Progress`)."""
        now = time.monotonic()
        if stage == self._stage and done < total and now - self._last < SECONDS_BETWEEN_WORDS:
            return
        self._stage, self._last = stage, now
        self.say({"event": "progress", "stage": stage, "done": done, "total": total, "unit": unit})

    def say(self, message: dict[str, Any]) -> None:
        """Write one message."""
        self._out.write(json.dumps(message).encode() + b"\n")
        self._out.flush()


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
        )
        output = Path(order["output"])
        save_lift(made, output)
    except SplatliftError as error:
        return {"event": "fault", "fault": fault_of(error, order["names"])}
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
    os.nice(NICENESS)
    # Libraries may print; the pipe is for messages only.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    stdin = os.fdopen(os.dup(0), "rb", buffering=0)
    order = json.loads(_line(stdin))
    threading.Thread(target=_end_with_parent, args=(stdin,), daemon=True).start()
    report = Reporter(out)
    report.say(run(order, report))


def _line(stdin: BinaryIO) -> bytes:
    line = b""
    while not line.endswith(b"\n"):
        piece = stdin.read(65_536)
        if not piece:
            sys.exit(3)
        line += piece
    return line


if __name__ == "__main__":
    main()
