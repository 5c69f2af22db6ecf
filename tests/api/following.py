"""Following a job to its end."""

from __future__ import annotations

import time
from typing import Any

import httpx

PATIENCE_SECONDS = 180.0


def ended(client: httpx.Client, job: str) -> dict[str, Any]:
    """Poll a job until it has ended; the job."""
    deadline = time.monotonic() + PATIENCE_SECONDS
    while time.monotonic() < deadline:
        found = client.get(job).json()
        if found["state"] in ("succeeded", "failed"):
            return found
        time.sleep(0.1)
    raise AssertionError(f"{job} did not end within {PATIENCE_SECONDS:g} s")
