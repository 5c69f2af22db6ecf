"""What a job's process says: JSON lines on its stdout, for the server that started it."""

from __future__ import annotations

import json
import threading
import time
from typing import Any, BinaryIO

SECONDS_BETWEEN_BEATS = 1.0
SECONDS_BETWEEN_WORDS = 0.25


class Reporter:
    """Progress as JSON lines: every new stage and every end of one, and now and then in between. And what else
    there is to say, a line each.
    """

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

    def plan(self, plan: dict[str, Any]) -> None:
        """Say what the work is going to be, as `service.models.Plan` has it."""
        self.say({"event": "plan", "plan": plan})

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
