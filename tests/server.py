"""The service as tests start it: an application in this process, known by HTTP alone."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from fastapi.testclient import TestClient

from service.app import assemble
from service.settings import ServiceSettings
from service.store.store import Store

ADDRESS = "http://127.0.0.1"
PATIENCE_SECONDS = 900.0  # of a machine that has other things to do, kernels to compile among them
FINAL_STATES = ("succeeded", "failed", "canceled")


class Client(Protocol):
    """Common interface of httpx's client and the test client."""

    def get(self, url: str, /) -> Any:
        """Return the response to a GET."""
        ...


@contextmanager
def serving(data: Path, **settings: Any) -> Iterator[TestClient]:
    """Yield a client of the application over a data directory; settings are those of `splatlift serve`."""
    options = ServiceSettings.model_validate({"data": data, **settings})
    store = Store.open(options.data, floor_bytes=options.disk_floor_bytes)
    try:
        with TestClient(assemble(options, store), ADDRESS, raise_server_exceptions=False) as client:
            yield client
    finally:
        store.close()


def wait_for_end(client: Client, job: str) -> dict[str, Any]:
    """Poll the job at a path until it has ended; return it."""
    deadline = time.monotonic() + PATIENCE_SECONDS
    while time.monotonic() < deadline:
        record = client.get(job).json()
        if record["state"] in FINAL_STATES:
            return record
        time.sleep(0.1)
    raise AssertionError(f"{job} did not end within {PATIENCE_SECONDS:g} s")
