"""The machine that a figure was taken on; the most memory that this process took."""

import platform
import resource
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from liftcore.runtime.cores import cores
from liftcore.runtime.device import processor


def hardware() -> dict[str, Any]:
    """The machine and the versions that a figure was taken on.

    The processor has LLVM's name too, for which code is compiled: a virtual one's own name may be no more than its
    maker's, of generations a factor of two apart.
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
    """What `hardware` told, in a line."""
    return ", ".join(f"{name} {value}" for name, value in facts.items())


def peak_memory() -> int:
    """Bytes of this process at its largest.

    Not ``ru_maxrss`` where Linux says better: that one survives exec, so a child starts from its parent's size.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        lines = [line for line in status.read_text(encoding="ascii").splitlines() if line.startswith("VmHWM:")]
        if lines:
            return int(lines[0].split()[1]) * 1024
    unit = 1 if sys.platform == "darwin" else 1024  # macOS counts bytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
