"""The number of processor cores that this process may use."""

import os
import sys


def cores() -> int:
    """Return the number of cores that this process may use, at least 1: off Linux, all of the machine."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
