"""The machine that a figure was taken on, and what of its memory this process took."""

import os
import platform
import resource
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from liftcore.device import processor


def hardware() -> dict[str, Any]:
    """The machine and the versions that a figure was taken on.

    The processor has LLVM's name too, for which code is compiled: a virtual one's own name may be no more than its
    maker's, of generations a factor of two apart.
    """
    import numba
    from llvmlite.binding import get_host_cpu_name

    return {
        "cpu": f"{processor()} ({get_host_cpu_name()})",
        "cores": len(os.sched_getaffinity(0)),
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
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


PAUSE = 0.003  # seconds between two looks at memory


@dataclass
class Most:
    """The most bytes of all looks; None where nothing tells them, as Linux alone does."""

    bytes: int | None = None

    def take(self, found: int | None) -> None:
        """Another look."""
        if found is not None:
            self.bytes = max(self.bytes or 0, found)


def anonymous_bytes(process: int | str = "self") -> int | None:
    """What a process holds now that is no file's; None where it has ended, or nothing tells.

    Mapped files count as resident, though the system takes their pages back.
    """
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("RssAnon:")), None)


@contextmanager
def watched() -> Iterator[Most]:
    """The most that this process holds while the block runs."""
    most, ended = Most(), threading.Event()

    def look() -> None:
        while not ended.wait(PAUSE):
            most.take(anonymous_bytes())

    watch = threading.Thread(target=look, daemon=True)
    most.take(anonymous_bytes())
    watch.start()
    try:
        yield most
    finally:
        most.take(anonymous_bytes())
        ended.set()
        watch.join()
