"""Readiness beside a crowd of slow clients, the first answer, memory at its peak, and what a server holds after jobs.

python -m tests.gate.g17_rest [--jobs N] [--tricklers N] [--readers N]

Times are printed with their bars; they are judged by a reader, as a busy machine misses them.
"""

from __future__ import annotations

import argparse
import signal
import socket
import time
from pathlib import Path

import numpy as np

from tests.gate.running import Service, Verdicts, run_gate
from tests.gate.scenes import long_scene, scene, small_scene

WARM_UP_JOBS = 4
POOLED = 6  # descriptors of connections that a server may come to hold later; a leak has one a job
GROWTH_MB = 12  # of the HTTP process over the jobs: an allocator's; 1 MB a job is a leak
PEAK_MB = 400


def gate(options: argparse.Namespace, folder: Path, verdicts: Verdicts) -> None:
    """Crowd a server, then count what another holds."""
    with Service(folder / "crowd") as service:
        crowd(service, options, verdicts)
    with Service(folder / "leaks") as service:
        leak(service, options.jobs, verdicts)


def crowd(service: Service, options: argparse.Namespace, verdicts: Verdicts) -> None:
    """Ask /healthz and /readyz beside a lift, sockets that send a byte at a time, and readers that do not read."""
    starts = []
    for _ in range(3):
        service.end(signal.SIGTERM)
        start = time.monotonic()
        service.start()
        service.client.get("/healthz").raise_for_status()
        starts.append(time.monotonic() - start)
    print(f"time first answer after serve {np.median(starts):.1f} s, bar 3 s")
    body = service.upload(long_scene())
    large = service.upload(scene(splats=200_000, views=1, width=32, channels=8))["splats"]
    job = service.order(body)
    service.wait_for(job, "running")
    head = b"PUT /assets/splats HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000\r\n\r\nply\n"
    reading = f"GET /assets/{large}/content HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
    tricklers = [connect(service, head) for _ in range(options.tricklers)]
    readers = [connect(service, reading) for _ in range(options.readers)]
    seconds, statuses = [], set()
    for number in range(200):
        tricklers[number % len(tricklers)].sendall(b"#")
        for path in ("/healthz", "/readyz"):
            start = time.monotonic()
            statuses.add(service.client.get(path).status_code)
            seconds.append(time.monotonic() - start)
        time.sleep(0.01)
    print(f"time p99 of /healthz and /readyz {1e3 * np.quantile(seconds, 0.99):.0f} ms, bar 50 ms")
    figures = f"{options.tricklers} tricklers, {options.readers} slow readers, a lift: {statuses}"
    verdicts.check("alive and ready beside a crowd", statuses == {200}, figures)
    state = service.wait_for(job)["state"]
    verdicts.check("the lift beside it succeeds", state == "succeeded", state)
    status = service.client.put("/assets/cameras", content=small_scene()["cameras"]).status_code
    verdicts.check("an upload beside it is not kept out for good", status in (201, 429, 503), status)
    for connection in tricklers + readers:
        connection.close()
    verdicts.check_rest(service)
    peak = usage(service)["peak_mb"]
    verdicts.check(f"the HTTP process stays below {PEAK_MB} MB", peak < PEAK_MB, f"{peak} MB at its peak; goal 120")


def leak(service: Service, jobs: int, verdicts: Verdicts) -> None:
    """Upload, lift, follow, ask and delete, job after job; compare what the server holds."""
    samples, files = [], small_scene()  # made once: the order in a header of safetensors is a matter of chance
    for number in range(WARM_UP_JOBS + jobs):
        body = service.upload(files | {"cameras": files["cameras"] + b" " * (number + 1)})  # a file of its own
        job = service.order(body)
        service.client.get(f"/jobs/{job}/events").raise_for_status()
        service.client.get("/query", params={"lift": job, "text": "apple", "table": body["table"]}).raise_for_status()
        service.client.get("/query/mask", params={"lift": job, "like": "splat:1", "view": "v0"}).raise_for_status()
        service.client.delete(f"/jobs/{job}", params={"with_lift": "true"}).raise_for_status()
        service.client.delete(f"/assets/{body['cameras']}").raise_for_status()
        if number >= WARM_UP_JOBS - 1:
            time.sleep(0.5)
            samples.append(usage(service))
    growth = {
        name: int(np.median([sample[name] for sample in samples[-3:]])) - samples[0][name] for name in samples[0]
    }
    is_level = growth["descriptors"] <= POOLED and growth["threads"] <= 1 and growth["children"] <= 0
    is_level &= growth["resident_mb"] <= GROWTH_MB and growth["files"] <= 0
    verdicts.check(f"{jobs} jobs leave nothing in the server", is_level, f"{samples[0]}, growth {growth}")


def usage(service: Service) -> dict[str, int]:
    """Count what the HTTP process holds, its children, and the files of its directory."""
    root = Path(f"/proc/{service.pid}")
    status = dict(line.split(":", 1) for line in (root / "status").read_text().splitlines())
    return {
        "descriptors": len([*(root / "fd").iterdir()]),
        "threads": int(status["Threads"]),
        "resident_mb": int(status["VmRSS"].split()[0]) // 1024,
        "peak_mb": int(status["VmHWM"].split()[0]) // 1024,
        "children": len(service.children()),
        "files": len([path for path in service.data.rglob("*") if path.is_file()]),
    }


def connect(service: Service, head: bytes) -> socket.socket:
    """A connection that sent the beginning of a request, and whose buffer is small."""
    connection = socket.create_connection(("127.0.0.1", service.client.base_url.port or 80), 60)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.sendall(head)
    return connection


if __name__ == "__main__":
    run_gate(gate, __doc__, jobs=6, tricklers=200, readers=20)
