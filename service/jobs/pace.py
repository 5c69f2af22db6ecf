"""How long a stage will still take, from its pace so far."""

from __future__ import annotations

import time
from typing import Any


class StagePace:
    """Adds ``eta_s`` to the progress that a child reports."""

    def __init__(self) -> None:
        self._stage = ""
        self._begin = 0.0
        self._done_at_begin = 0

    def progress(self, message: dict[str, Any]) -> dict[str, Any]:
        """The message as `service.models.Progress` has it."""
        now = time.monotonic()
        stage, done, total = message["stage"], message["done"], message["total"]
        if stage != self._stage:
            self._stage, self._begin, self._done_at_begin = stage, now, done
        advanced = done - self._done_at_begin
        eta = (now - self._begin) / advanced * (total - done) if advanced > 0 else None
        return {
            "stage": stage,
            "done": done,
            "total": total,
            "unit": message["unit"],
            "eta_s": None if eta is None else round(eta, 2),
        }
