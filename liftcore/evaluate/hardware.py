"""The machine of a measurement, and the peak memory of this process."""

import platform
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch

from liftcore.runtime.cores import cores
from liftcore.runtime.device import processor

COPIED, SIDE, TRIES = 1 << 25, 1 << 10, 5  # float32 that are copied, of a matrix's side, and times that each is done


def hardware() -> dict[str, Any]:
    """Describe the machine and the versions of a measurement.

    The CPU is named by LLVM's target too: a virtual machine may name the maker alone, whose generations differ by a
    factor of two in speed.
    """
    import numba
    from llvmlite.binding import get_host_cpu_name

    return {
        "cpu": f"{processor()} ({get_host_cpu_name()})",
        "cores": cores(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numba": numba.__version__,
        "numpy": np.__version__,
    }


def machine_speed(threads: int | None = None) -> dict[str, float]:
    """Measure bytes read and written a second by all threads, and float32 operations a second: the best of TRIES.

    Args:
        threads: None uses the cores that this process may use.
    """
    count = threads or cores()
    ends = [(at * COPIED // count, (at + 1) * COPIED // count) for at in range(count)]
    source, target = np.ones(COPIED, np.float32), np.zeros(COPIED, np.float32)

    def copy(first: int, last: int) -> None:
        np.copyto(target[first:last], source[first:last])

    left, right = torch.rand(2, SIDE, SIDE, dtype=torch.float32)
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with ThreadPoolExecutor(count) as pool:
            copying = min(_seconds(lambda: list(pool.map(copy, *zip(*ends, strict=True)))) for _ in range(TRIES))
        multiplying = min(_seconds(lambda: left @ right) for _ in range(TRIES))
    finally:
        torch.set_num_threads(before)
    return {"memory_bytes_per_s": 2 * source.nbytes / copying, "float32_flops": 2 * SIDE**3 / multiplying}


def _seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def machine_line(facts: Mapping[str, Any]) -> str:
    """Format the facts of `hardware` as one line."""
    return ", ".join(f"{name} {value}" for name, value in facts.items())


def peak_memory() -> int | None:
    """Return the peak memory of this process in bytes; None on Windows.

    On Linux from /proc: ``ru_maxrss`` survives exec, so that a child starts with its parent's size.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        lines = [line for line in status.read_text(encoding="ascii").splitlines() if line.startswith("VmHWM:")]
        if lines:
            return int(lines[0].split()[1]) * 1024
    if sys.platform == "win32":
        return None
    import resource

    unit = 1 if sys.platform == "darwin" else 1024  # macOS counts bytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
