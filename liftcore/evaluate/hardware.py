"""The machine of a measurement, and the peak memory of this process."""

import platform
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from liftcore.runtime.cores import cores
from liftcore.runtime.device import processor


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
