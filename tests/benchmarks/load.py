"""``make load``: what clients wait for under load, as one JSON object on stdout. Talks to 127.0.0.1 only.

    python -m tests.benchmarks.load [--seconds S] [--rounds N] [--splats P]

``/healthz`` over new connections and a kept one, beside 200 sockets that trickle, 20 clients that hardly read and
a lift that runs; and rounds of 16 questions at the same moment to a large lift, first alone, then beside lifts
of another scene.
Half of the trickling sockets upload, every other one at 2 kB a second, the rest a byte at a time; a quarter trickles
headers and a quarter JSON bodies. Whoever is cut off comes back at once.
"""

import argparse
import asyncio
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http import HTTPStatus
from http.client import HTTPConnection
from itertools import count
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

import numpy as np
import torch
from safetensors.torch import save_file

from liftcore.raster.cpu.warm_up import warm_up
from service.commands.demo import Client, serving
from tests.benchmarks.base import machine
from tests.benchmarks.scenes import RoomSpec, write_bench_room

T = TypeVar("T")
HEALTH_MS, QUERY_SECONDS = 50.0, 2.0  # the most that is promised of an otherwise idle machine
OTHER = RoomSpec(200_000, 60, (640, 480), 32)  # what is lifted meanwhile; it takes a minute or more
QUESTIONS = 16  # at the same moment
PAUSE = 0.5  # seconds of a slow client
HEAD = " HTTP/1.1\r\nHost: 127.0.0.1\r\n"
UPLOAD = f"PUT /assets/splats{HEAD}Content-Length: 50000000\r\n\r\nply\n"
ORDER = f"POST /lift{HEAD}Content-Type: application/json\r\nContent-Length: 50000\r\n\r\n{{"
SLOW = {  # what a client says first, and at each pause; of each kind a quarter of the sockets
    "upload": (UPLOAD, " "),
    "steady upload": (UPLOAD, " " * 1024),
    "headers": (f"GET /healthz{HEAD}X-Slow: ", "a"),
    "body": (ORDER, " "),
}


def measure(seconds: float, rounds: int, splats: int) -> dict[str, Any]:
    """Both figures, of one server."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        words = iter(_write_words(folder / "words.safetensors", 2 * rounds * QUESTIONS + 1))
        with serving(folder / "data", f"table:{folder / 'words.safetensors'}", folder / "log") as url:
            client = Client(url)
            large = _upload(client, folder / "large", RoomSpec(splats, 4, (640, 480), 512))
            job, _ = client.lift(large, lambda _: None)
            other = _upload(client, folder / "other", OTHER)
            client.get("/query", lift=job["id"], text=next(words))
            idle = _questions(url, job["id"], words, rounds)
            quiet = probe(url, after(seconds / 4))
            stop = threading.Event()
            lifts = threading.Thread(target=_keep_lifting, args=(url, other, stop))
            lifts.start()
            while not any(job["state"] == "running" and job["plan"] for job in client.get("/jobs")["jobs"]):
                time.sleep(0.05)
            with slow_clients(url, f"/assets/{large['splats']}/content") as replies:
                slow = probe(url, after(seconds))
            loaded = _questions(url, job["id"], words, rounds)
            ran = lifts.is_alive()
            stop.set()
            lifts.join()
            client.close()
        return {
            "healthz_ms": {"quiet": quiet, "beside_slow_clients_and_a_lift": slow},
            "slow_clients": replies,
            "questions_s": {"splats": splats, "alone": idle, "beside_a_lift": loaded},
            "lifts_ran": ran,
            "drafts_left": len(list((folder / "data" / "tmp").iterdir())),
        }


def _write_words(path: Path, number: int) -> list[str]:
    rows = torch.nn.functional.normalize(torch.randn(number, 512, generator=torch.Generator().manual_seed(1)), dim=1)
    words = [f"word{k}" for k in range(number)]
    save_file({"embeddings": rows}, str(path), metadata={"words": json.dumps(words)})
    return words


def _upload(client: Client, folder: Path, size: RoomSpec) -> dict[str, Any]:
    """Write a room and upload it; the body of an order of its lift."""
    folder.mkdir()
    splats, cameras, features = (
        client.upload(kind, path)["id"]
        for kind, path in zip(("splats", "cameras", "features"), write_bench_room(folder, size), strict=True)
    )
    return {"splats": splats, "cameras": cameras, "features": [features]}


def _keep_lifting(url: str, body: dict[str, Any], stop: threading.Event) -> None:
    """Lift one after the other, each of another seed."""
    client = Client(url)
    for seed in count(1):
        if stop.is_set():
            break
        client.lift(body | {"settings": {"seed": seed}}, lambda _: None)
    client.close()


def _questions(url: str, lift: str, words: Iterator[str], rounds: int) -> dict[str, Any]:
    """Ask rounds of different questions, those of a round at the same moment; how long they took."""
    slowest, seconds, load = [], [], []
    clients = [Client(url) for _ in range(QUESTIONS)]

    def ask(client: Client, word: str) -> float:
        begin = time.perf_counter()
        client.get("/query", lift=lift, text=word)
        return time.perf_counter() - begin

    for _ in range(rounds):
        load.append(round(os.getloadavg()[0], 1))
        times = at_once([partial(ask, client, next(words)) for client in clients])
        slowest.append(round(max(times), 2))
        seconds += times
    for client in clients:
        client.close()
    return {"median": round(float(np.median(seconds)), 2), "slowest_of_each_round": slowest, "load": load}


def at_once(work: Sequence[Callable[[], T]]) -> list[T]:
    """Call all functions at the same moment, in threads of their own; return their results."""
    gate = threading.Barrier(len(work))

    def begin(call: Callable[[], T]) -> T:
        gate.wait()
        return call()

    with ThreadPoolExecutor(len(work)) as pool:
        return list(pool.map(begin, work))


def probe(url: str, over: Callable[[], bool]) -> dict[str, Any]:
    """Milliseconds of ``/healthz`` until that is over: of new connections, and (``kept_...``) of one that is kept."""
    times: dict[str, list[float]] = {"": [], "kept_": []}
    wrong, connection = 0, HTTPConnection("127.0.0.1", urlsplit(url).port, timeout=60)
    while not times[""] or not over():
        fresh = HTTPConnection("127.0.0.1", urlsplit(url).port, timeout=60)
        for name, client, headers in (("", fresh, {"Connection": "close"}), ("kept_", connection, {})):
            start = time.perf_counter()
            client.request("GET", "/healthz", headers=headers)
            answer = client.getresponse()
            answer.read()
            wrong += answer.status != HTTPStatus.OK
            times[name].append(1e3 * (time.perf_counter() - start))
        fresh.close()
        time.sleep(0.02)
    connection.close()
    figures = {
        f"{name}p{rank}": round(float(np.percentile(values, rank)), 1)
        for name, values in times.items()
        for rank in (50, 99)
    }
    return {"probes": len(times[""]), "wrong": wrong, **figures}


def after(seconds: float) -> Callable[[], bool]:
    end = time.monotonic() + seconds
    return lambda: time.monotonic() >= end


@contextlib.contextmanager
def slow_clients(url: str, path: str, sockets: int = 200, readers: int = 20) -> Iterator[dict[str, Any]]:
    """Run them in a process of their own; what they tell at their end is in the dict then."""
    command = [sys.executable, "-m", "tests.benchmarks.load", "--slow", str(urlsplit(url).port), path]
    command += [str(sockets), str(readers)]
    replies: dict[str, Any] = {}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline().strip() == "all have come"
            yield replies
            replies.update(json.loads(process.communicate("")[0]))
        finally:
            process.kill()


async def _be_slow(port: int, path: str, sockets: int, readers: int) -> None:
    """Trickle until stdin ends; then say how many connections are open, and how often each kind was cut off."""
    kinds = [name for name in SLOW for _ in range(sockets // len(SLOW))] + ["download"] * readers
    cut, live = Counter[str](), Counter[str]()
    came = [asyncio.Event() for _ in kinds]

    async def keep_coming(kind: str, first: asyncio.Event) -> None:
        begin, drop = SLOW.get(kind, (f"GET {path}{HEAD}\r\n", ""))
        while True:
            with contextlib.suppress(OSError):
                reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 12)
                live[kind] += 1
                first.set()
                try:
                    writer.write(begin.encode())
                    while not (reader.at_eof() or writer.is_closing()):
                        await asyncio.sleep(PAUSE)
                        if not drop and not await reader.read(2_000):
                            break
                        writer.write(drop.encode())
                        await writer.drain()
                finally:
                    live[kind] -= 1
                    cut[kind] += 1
                    writer.close()
            await asyncio.sleep(0.05)

    tasks = [asyncio.create_task(keep_coming(kind, first)) for kind, first in zip(kinds, came, strict=True)]
    await asyncio.gather(*(first.wait() for first in came))
    print("all have come", flush=True)
    await asyncio.to_thread(sys.stdin.read)
    print(json.dumps({"open": live, "cut_off": cut}), flush=True)
    for task in tasks:
        task.cancel()


def main() -> int:
    """Measure; 1 when a promise was missed, which a busy machine does too, or no lift ran beside."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.load", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60, help="of probing beside slow clients")
    parser.add_argument("--rounds", type=int, default=5, help="of 16 questions at once")
    parser.add_argument("--splats", type=int, default=1_000_000, help="of the lift that is asked")
    parser.add_argument("--slow", nargs=4, metavar="N", help="be the slow clients: PORT PATH SOCKETS READERS")
    options = parser.parse_args()
    if options.slow:
        port, path, sockets, readers = options.slow
        asyncio.run(_be_slow(int(port), path, int(sockets), int(readers)))
        return 0
    warm_up()
    head = machine() | {"load_before": [round(load, 1) for load in os.getloadavg()]}
    figures = measure(options.seconds, options.rounds, options.splats)
    print(json.dumps(head | figures, indent=2))
    health, queries = figures["healthz_ms"]["beside_slow_clients_and_a_lift"], figures["questions_s"]["beside_a_lift"]
    quick = (
        max(health["p99"], health["kept_p99"]) < HEALTH_MS and max(queries["slowest_of_each_round"]) < QUERY_SECONDS
    )
    return 0 if quick and health["wrong"] == figures["drafts_left"] == 0 and figures["lifts_ran"] else 1


if __name__ == "__main__":
    sys.exit(main())
