"""A server process with the query worker and real lifts running, over a data directory that is filled beforehand."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import torch
from safetensors.torch import save_file

from liftcore.io.lift_file import load_lift
from service.store.assets import CheckedUpload
from service.store.jobs import JobOrder
from service.store.lifts import FinishedLift
from service.store.store import Store
from service.wire import AssetKind
from tests.benchmarks.query_bench import write_random_lift

ROOT = Path(__file__).parents[2]
VIEW = (320, 240)  # of the scene that is queried
LIFTS = 100  # orders that wait in line, so that one is always running
PATIENCE_SECONDS = 300.0  # for what takes some seconds; the machine may be busy


@dataclass(frozen=True)
class BusyService:
    """Where it is, and what it holds."""

    address: str
    pid: int

    @property
    def port(self) -> int:
        """Where it listens on 127.0.0.1."""
        return int(self.address.rpartition(":")[2])

    def lifting(self) -> bool:
        """Whether a lift runs, or the next one is about to."""
        return bool(self._unfinished())

    def await_lift(self) -> None:
        """Wait until a lift is past its start, and uses the cores."""
        deadline = time.monotonic() + PATIENCE_SECONDS
        while jobs := self._unfinished():
            if any(job["state"] == "running" and job["plan"] for job in jobs):  # and then it walks
                return
            assert time.monotonic() < deadline, "no lift came to its walk"
            time.sleep(0.05)
        raise AssertionError("all lifts have ended")

    def cpu_seconds(self) -> float:
        """Processor time of the server and of its query worker, which do not do the lifting."""
        workers = [pid for pid in _children(self.pid) if b"service.queries.worker" in _command(pid)]
        assert workers, "there is no query worker"
        return sum(map(_cpu_seconds, (self.pid, *workers)))

    def _unfinished(self) -> list[dict[str, Any]]:
        jobs = httpx.get(f"{self.address}/jobs", timeout=PATIENCE_SECONDS, verify=False).json()["jobs"]
        return [job for job in jobs if job["state"] in ("queued", "running")]


@contextlib.contextmanager
def serving(data: Path, table: Path | None = None, **settings: Any) -> Iterator[BusyService]:
    """Run the service over a data directory."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("SPLATLIFT_")}
    environment = own | {"PYTHONPATH": str(ROOT), "SPLATLIFT_DATA": str(data), "SPLATLIFT_PORT": "0"}
    environment |= {f"SPLATLIFT_{name.upper()}": str(value) for name, value in settings.items()}
    if table is not None:
        environment["SPLATLIFT_ENCODER"] = f"table:{table}"
    process = subprocess.Popen(
        [sys.executable, "-m", "service"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,  # a line for each request
        text=True,
        cwd=ROOT,
        env=environment,
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert line.startswith("listening on "), line
        yield BusyService(line.split()[-1], process.pid)
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(PATIENCE_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


def write_words(path: Path, count: int, channels: int) -> list[str]:
    """A table of random unit vectors; its words."""
    generator = torch.Generator().manual_seed(1)
    rows = torch.nn.functional.normalize(torch.randn(count, channels, generator=generator), dim=1)
    words = [f"word{number}" for number in range(count)]
    save_file({"embeddings": rows}, str(path), metadata={"words": json.dumps(words)})
    return words


def put_blob(data: Path, size: int) -> str:
    """An asset of so many bytes for those who read slowly; its path."""
    content = os.urandom(1 << 20) * (size >> 20)
    store = Store.open(data)
    asset = _add(store, AssetKind.SPLATS, content, ".ply", {})
    store.close()
    return f"/assets/{asset}/content"


def put_random_lift(data: Path, folder: Path, splats: int, channels: int) -> str:
    """A finished lift of random unit features, made by code; its id."""
    lift = write_random_lift(folder, splats, channels, VIEW)
    made = load_lift(lift).metadata
    store = Store.open(data)
    scene = {"names": list(made.views), "channels": channels, "kernel": "3dgs"}
    ids = [
        _add(store, AssetKind.SPLATS, (folder / "splats.ply").read_bytes(), ".ply", scene),
        _add(store, AssetKind.CAMERAS, (folder / "cameras.json").read_bytes(), ".json", scene),
        _add(store, AssetKind.FEATURES, b"of no pack", ".safetensors", scene),
    ]
    job, _ = store.jobs.submit(JobOrder(ids[0], ids[1], (ids[2],), {}))
    claimed = store.attempts.claim(60)
    assert claimed is not None
    metadata = made.model_dump(mode="json")
    digest = hashlib.sha256(job.encode()).hexdigest()  # of no use here, and reading a gigabyte takes its time
    with store.files.draft(".safetensors") as draft:
        lift.rename(draft)
        assert store.lifts.finish(job, claimed.attempt, FinishedLift(draft, digest, splats, channels, metadata))
    store.close()
    return job


@contextlib.contextmanager
def lifting(service: BusyService, body: dict[str, Any], lifts: int = LIFTS) -> Iterator[None]:
    """Keep a lift running, one after the other, each of another seed."""
    with httpx.Client(base_url=service.address, timeout=60, verify=False) as client:
        for seed in range(lifts):
            reply = client.post("/lift", json=body | {"settings": {"seed": seed}})
            assert reply.status_code == 202, reply.text
    yield
    # The server ends its running lift when it is told to stop; what waits in line goes with the data directory.


def in_threads(work: Any, count: int) -> list[Any]:
    """The results of ``work(k)`` for k below ``count``, all begun at the same moment."""
    gate = threading.Barrier(count)
    results: list[Any] = [None] * count

    def run(number: int) -> None:
        gate.wait()
        results[number] = work(number)

    threads = [threading.Thread(target=run, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return results


def _children(pid: int) -> list[int]:
    """Of all its threads: a process is the child of the thread that began it."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # a thread that has ended
            found += map(int, (task / "children").read_text().split())
    return found


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:  # it has ended
        return b""


def _cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _add(store: Store, kind: AssetKind, content: bytes, suffix: str, counts: dict[str, Any]) -> str:
    with store.files.draft(suffix) as draft:
        draft.write_bytes(content)
        checked = CheckedUpload(draft, kind, hashlib.sha256(content).hexdigest(), suffix, counts, [])
        return store.assets.add(checked)[0].id
