"""Memory and latency of the HTTP process under loads that are made to fill it.

    python -m tests.benchmarks.memory [--names N] [--jobs N]

Prints a table, a row a load: the most that the process held (VmHWM, so all since its start), and milliseconds of
``/healthz`` over new connections meanwhile. Each load has a server of its own, without a query process, over the same
data directory: cameras, a lift and jobs made straight in the store. Status 1 when a promise of docs/service.md was
missed, which a busy machine does too. Talks to 127.0.0.1 only.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import httpx

from service.models import AssetKind
from service.store.assets import CheckedUpload
from service.store.jobs import JobOrder
from service.store.lifts import FinishedLift
from service.store.owners import SERVICE
from service.store.store import Store
from tests.benchmarks.base import machine
from tests.benchmarks.load import at_once, probe
from tests.crash.service_process import ServiceProcess

LIMIT_MB, HEALTH_MS = 400.0, 50.0
NAME_BYTES = 490
Load = Callable[[str], None]


def fill(data: Path, names: int, jobs: int) -> tuple[str, str]:
    """Store cameras with so many long names, a lift of them all, and so many jobs; the paths of the first two."""
    store = Store.open(data)
    long = [f"{'a' * NAME_BYTES}{number:08}" for number in range(names)]
    ids = {kind: add(store, kind, long) for kind in (AssetKind.SPLATS, AssetKind.CAMERAS, AssetKind.FEATURES)}
    order = JobOrder(ids[AssetKind.SPLATS], ids[AssetKind.CAMERAS], (ids[AssetKind.FEATURES],), {"preset": "row-sum"})
    lift = store.jobs.submit(SERVICE, order)[0]
    job = store.jobs.claim()
    assert job is not None
    metadata = {"version": "0", "settings": {}, "encoder": "e", "text_space": "t", "diagnostics": {}, "timings": {}}
    with store.files.draft(".safetensors") as draft:
        draft.write_bytes(b"lift")
        store.lifts.finish(lift, job.attempt, FinishedLift(draft, "0" * 64, 1, 1, metadata | {"views": long}))
    with store.database.write() as connection:
        connection.execute(
            "INSERT INTO jobs (id, kind, state, attempt, splats, cameras, settings, created, ended)"
            " WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < ?)"
            " SELECT printf('%032x', i), 'lift', 'canceled', 1, ?, ?, '{\"preset\": \"row-sum\"}', i, i FROM n",
            (jobs, order.splats, order.cameras),
        )
    store.close()
    return f"/assets/{order.cameras}", f"/lifts/{lift}"


def add(store: Store, kind: AssetKind, names: list[str]) -> str:
    """An asset whose bytes nobody reads; its id."""
    with store.files.draft(".bin") as draft:
        draft.write_bytes(kind.encode())
        digest = f"{list(AssetKind).index(kind):064x}"
        upload = CheckedUpload(draft, kind, digest, ".bin", {"names": names, "views": len(names), "channels": 1}, [])
        return store.assets.add(SERVICE, upload)[0].id


def parallel_load(count: int, ask: Callable[[httpx.Client, int], object]) -> Load:
    """So many clients that ask and read at the same moment, each twice."""

    def run(url: str) -> None:
        with ExitStack() as stack:
            clients = [stack.enter_context(httpx.Client(base_url=url, timeout=600)) for _ in range(count)]

            def twice(number: int) -> None:
                for _ in range(2):
                    ask(clients[number], number)

            at_once([partial(twice, number) for number in range(count)])

    return run


def never_read(paths: tuple[str, ...], count: int = 80, seconds: float = 20.0, pipelined: int = 20) -> Load:
    """So many clients that ask again and again over their connection and read nothing."""

    def run(url: str) -> None:
        with ExitStack() as stack:
            for number in range(count):
                client = stack.enter_context(socket.socket())
                client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                client.connect(("127.0.0.1", urlsplit(url).port or 80))
                path = paths[number % len(paths)]
                client.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode() * pipelined)
            time.sleep(seconds)

    return run


def of_a_megabyte(client: httpx.Client, number: int) -> None:
    """An order whose settings are as long as a body may be."""
    settings = {f"name{number}-{k}": "x" * 9 for k in range(30_000)}
    body = json.dumps({"splats": "s", "cameras": "c", "features": ["f"], "settings": settings})[: (1 << 20) - 2] + "}"
    client.post("/lift", content=body, headers={"Content-Type": "application/json"})


def wrong_and_large(client: httpx.Client, number: int) -> None:
    """Bodies of up to a megabyte, each to another route: of vectors, settings, words, or no JSON."""
    settings = {f"name{k}": "x" * 9 for k in range(40_000)}
    bodies = [
        json.dumps({"text": ["a"], "like": [[0.123456] * 4096] * 28}), json.dumps({"words": ["a word"] * 90_000}),
        json.dumps({"splats": "s", "cameras": "c", "features": ["f"], "settings": settings}), "[" * 900_000,
        f"[{'1,' * 60_000}1]", "\xff" * 500_000, "x" * (4 << 20),
    ]  # fmt: skip
    routes = ("/query", "/lift", "/query/segment", "/query/what", "/render", "/lift/plan", "/tradeoff", "/query/mask")
    for place, body in enumerate(bodies):
        route = routes[(number + place) % len(routes)]
        client.post(route, content=body, headers={"Content-Type": "application/json"})


def loads(asset: str, lift: str) -> dict[str, Load]:
    """The loads by name."""
    scores = f"/query/scores?like=splat:0&lift={lift.removeprefix('/lifts/')}"
    return {
        "nothing": lambda url: time.sleep(5),
        "40 at once: GET /assets/ID": parallel_load(40, lambda client, _: client.get(asset)),
        "40 at once: pages of its names": parallel_load(
            40, lambda client, n: client.get(f"{asset}/names?cursor={n}000")
        ),
        "40 at once: GET /lifts/ID and /lifts": parallel_load(40, lambda ask, _: (ask.get(lift), ask.get("/lifts"))),
        "80 clients that do not read": never_read(("/jobs", asset, f"{asset}/names", lift, "/lifts")),
        "80 that do not read 32 MB of scores": never_read((scores,), pipelined=1),
        "32 orders with settings of 1 MB": parallel_load(32, of_a_megabyte),
        "8 at once: wrong and large bodies": parallel_load(8, wrong_and_large),
        "8 at once: GET /jobs whole": parallel_load(8, lambda client, _: client.get("/jobs")),
    }


def measure(data: Path, load: Load) -> tuple[float, dict[str, float]]:
    """Megabytes that a server held at most under a load, and what a probe of it found."""
    with ServiceProcess(data) as service:
        url = str(service.client.base_url)
        clients = multiprocessing.get_context("fork").Process(target=load, args=(url,))  # beside who probes
        clients.start()
        latencies = probe(url, lambda: not clients.is_alive())
        clients.join()
        return high_water(service.pid), latencies


def high_water(pid: int) -> float:
    """The most memory that a process ever held, in MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM"))


def main() -> int:
    """Measure; 1 when a promise was missed."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.memory", description=__doc__)
    parser.add_argument("--names", type=int, default=99_999, help="long names of views")
    parser.add_argument("--jobs", type=int, default=50_000, help="that have ended")
    options = parser.parse_args()
    print(f"{', '.join(machine().values())}, load {os.getloadavg()[0]:.1f}\n")
    print("| load | MB at most | /healthz p50 ms | p99 ms | probes |\n|---|---|---|---|---|")
    passed = True
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        for name, load in loads(*fill(data, options.names, options.jobs)).items():
            peak, figures = measure(data, load)
            print(f"| {name} | {peak:.0f} | {figures['p50']} | {figures['p99']} | {figures['probes']} |", flush=True)
            passed = passed and peak < LIMIT_MB and figures["p99"] < HEALTH_MS and not figures["wrong"]
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
