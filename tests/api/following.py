"""Following a job to its end."""

from __future__ import annotations

import time
from typing import Any, Protocol

PATIENCE_SECONDS = 900.0  # of a machine that has other things to do, kernels to compile among them


class Client(Protocol):
    """Common interface of httpx's client and the test client."""

    def get(self, url: str, /) -> Any:
        """The response to a GET."""
        ...


def wait_for_end(client: Client, job: str) -> dict[str, Any]:
    """Poll a job until it has ended; the job."""
    deadline = time.monotonic() + PATIENCE_SECONDS
    while time.monotonic() < deadline:
        record = client.get(job).json()
        if record["state"] in ("succeeded", "failed", "canceled"):
            return record
        time.sleep(0.1)
    raise AssertionError(f"{job} did not end within {PATIENCE_SECONDS:g} s")
