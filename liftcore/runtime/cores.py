"""The number of processor cores that this process may use."""

import os
import sys


def cores() -> int:
    """Count the cores that this process may run on: those of its affinity where the system has one (Linux, and not
    macOS or Windows), else those of the machine; at least 1."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
