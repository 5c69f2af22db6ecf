"""What the operator allows a job."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class JobLimits:
    """What jobs may take, and how their processes are watched."""

    parallel: int = 1  # jobs at the same time
    threads: int | None = None  # of a job; None shares the cores out
    seconds: float = 86_400.0  # wall time of an attempt
    memory_bytes: int | None = None  # private memory of a job's processes; None sets no limit
    lease_seconds: float = 30.0  # silence after which an attempt is lost
    checkpoint_seconds: float = 2.0  # work that a killed lift may lose, beside the views in work
