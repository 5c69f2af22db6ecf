"""/healthz beside clients that trickle, clients that hardly read, and a running lift."""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests.crash.loops import scene_files, stored

from .busy_service import PATIENCE_SECONDS, ROOT, BusyService, lifting, put_blob, serving
from .tricklers import ALL_CAME

BETWEEN_SECONDS = 0.02  # probes
ASK = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n"
BLOB_BYTES = 64 << 20


def slow_loop(*, sockets: int, readers: int, seconds: float, beside: dict[str, int]) -> dict[str, Any]:
    """Probe /healthz over new connections while others are slow and a lift runs.

    Args:
        sockets: that trickle; ``readers`` come on top.
        readers: of a download of 64 MiB.
        seconds: how long to probe.
        beside: of the scene that is lifted meanwhile: ``views``, ``splats``, ``width``.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        other = stored(folder / "data", scene_files(folder, **beside))
        path = put_blob(folder / "data", BLOB_BYTES)
        with serving(folder / "data") as service, lifting(service, other):
            service.await_lift()
            found = beside_slow_clients(service, path, sockets=sockets, readers=readers, seconds=seconds)
        return {**found, "drafts_left": drafts_left(folder / "data")}  # now that the lift has ended, too


def beside_slow_clients(
    service: BusyService, path: str, *, sockets: int, readers: int, seconds: float
) -> dict[str, Any]:
    """Probe /healthz for a quarter of the time without them, then beside them; a lift runs already."""
    quiet = _probe(service, seconds / 4)
    with _tricklers(service, path, sockets, readers) as told:
        ran = service.lifting()
        load = [os.getloadavg()[0]]
        slow = _probe(service, seconds)
        load.append(os.getloadavg()[0])
        ran = ran and service.lifting()
    return {
        "sockets": sockets,
        "readers": readers,
        "without_them_ms": quiet,
        "beside_them_ms": slow,
        "clients": told,
        "a_lift_ran": ran,
        "load": [round(value, 1) for value in load],
    }


def drafts_left(data: Path) -> int:
    """What lies in a data directory whose server has ended, and should not."""
    return len(list((data / "tmp").iterdir()))


@contextlib.contextmanager
def _tricklers(service: BusyService, path: str, sockets: int, readers: int) -> Iterator[dict[str, Any]]:
    """Run them, from when all have come; what they tell at their end is in the dict then."""
    command = [sys.executable, "-m", "tests.load.tricklers", str(service.port), path, str(sockets), str(readers)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    told: dict[str, Any] = {}
    assert process.stdout is not None
    try:
        came, _, _ = select.select([process.stdout], [], [], PATIENCE_SECONDS)
        assert came and process.stdout.readline() == f"{ALL_CAME}\n", "not all clients came"
        yield told
        told.update(json.loads(process.communicate("", timeout=PATIENCE_SECONDS)[0]))
    finally:
        with process:  # which closes the pipes, and waits
            process.kill()


def _probe(service: BusyService, seconds: float) -> dict[str, Any]:
    times, wrong = [], 0
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        begun = time.perf_counter()
        wrong += not _healthy(service.port)
        times.append(1e3 * (time.perf_counter() - begun))
        time.sleep(BETWEEN_SECONDS)
    p50, p99 = np.percentile(times, [50, 99])
    return {
        "probes": len(times),
        "wrong": wrong,
        "p50": round(float(p50), 1),
        "p99": round(float(p99), 1),
        "max": round(max(times), 1),
    }


def _healthy(port: int) -> bool:
    said = b""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as client:
        client.sendall(ASK)
        while piece := client.recv(1 << 12):
            said += piece
    return said.startswith(b"HTTP/1.1 200 ")
