"""Processes that outlived their server: found by a mark in their environment, and ended."""

from __future__ import annotations

import contextlib
import os
import select
import signal
from collections.abc import Iterable
from pathlib import Path

MARK = "SPLATLIFT_JOB_PROCESS"  # a job's processes carry its id under this name
GONE_SECONDS = 5.0
MOST_LOOKS = 10


def mark(job: str) -> dict[str, str]:
    """The mark as environment variables; what a process starts inherits it."""
    return {MARK: job}


def end_leftovers(jobs: Iterable[str]) -> int:
    """End all processes of these jobs, and wait until they are gone; how many there were. Linux only, else 0."""
    marks = {f"{MARK}={job}".encode() for job in jobs}
    if not marks or not Path("/proc/self/environ").exists():
        return 0
    ended = 0
    for _ in range(MOST_LOOKS):
        handles = [handle for pid in _processes() if (handle := _killed(pid, marks)) is not None]
        for handle in handles:
            select.select([handle], [], [], GONE_SECONDS)  # readable once the process has ended
            os.close(handle)
        ended += len(handles)
        if not handles:
            break  # and not before: one that we killed may have started another after we looked
    return ended


def _processes() -> list[int]:
    return [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdecimal()]


def _killed(pid: int, marks: set[bytes]) -> int | None:
    """A handle on the process when it carried a mark and was killed; with it we signal what we looked at."""
    with contextlib.suppress(OSError):
        handle = os.pidfd_open(pid)
        try:
            if marks & set(Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")):
                signal.pidfd_send_signal(handle, signal.SIGKILL)
                kept, handle = handle, -1
                return kept
        finally:
            if handle >= 0:
                os.close(handle)
    return None
