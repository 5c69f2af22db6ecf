"""One peer in a process of its own: what its first lift costs beyond the second, and how much memory a lift takes.

python -m tests.benchmarks.peers.child NAME < size.json
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from liftcore.evaluate.hardware import peak_memory
from tests.benchmarks.peers.everybody import PEERS, TINY
from tests.benchmarks.peers.work import Size, room

if TYPE_CHECKING:
    from collections.abc import Mapping

HIGH_WATER = Path("/proc/self/clear_refs")  # writing 5 makes the largest size so far the present one (Linux)


def alone(name: str, size: Size, *, cold: bool = False) -> dict[str, float]:
    """The figures of a peer's own process; ``cold`` gives it an empty cache of compiled kernels.

    Returns:
        first_s and again_s: the first and the second lift of TINY. before_bytes and peak_bytes: the process before
        the lift of ``size``, with all inputs, and at its largest during it.
    """
    command = [sys.executable, "-m", "tests.benchmarks.peers.child", name]
    with tempfile.TemporaryDirectory(prefix="splatlift-cold-") as empty:
        own = {"XDG_CACHE_HOME": empty} if cold else {}
        kept = {key: value for key, value in os.environ.items() if not (cold and key == "NUMBA_CACHE_DIR")}
        done = subprocess.run(
            command, input=json.dumps(asdict(size)), env=kept | own, capture_output=True, text=True, check=True
        )
    return json.loads(done.stdout)


def measured(name: str, document: Mapping[str, int]) -> dict[str, float]:
    """What ``alone`` gives, of this process."""
    peer = next(peer for peer in PEERS if peer.name == name)
    threads = len(os.sched_getaffinity(0))
    tiny, seconds = room(TINY, threads), []
    for _ in range(2):
        start = time.perf_counter()
        peer.lift(tiny)
        seconds.append(time.perf_counter() - start)
    work = room(Size(**document), threads)
    if HIGH_WATER.exists():
        HIGH_WATER.write_text("5", encoding="ascii")
    before = peak_memory()
    peer.lift(work)
    peak = max(before, peak_memory())  # Linux adds pages up in batches, so the later figure can be a little smaller
    return {"first_s": seconds[0], "again_s": seconds[1], "before_bytes": before, "peak_bytes": peak}


if __name__ == "__main__":
    print(json.dumps(measured(sys.argv[1], json.load(sys.stdin))))
