"""Large arrays in memory or in unlinked mapped files, which the system can page out; and free memory.

Torch is imported where tensors are made: processes without it map memory too.
"""

from __future__ import annotations

import mmap
import os
import shutil
import sys
import tempfile
from contextlib import suppress
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING

from liftcore.errors import Unavailable

if TYPE_CHECKING:
    import torch
    from torch import Tensor

CONTROL_GROUP = Path("/sys/fs/cgroup")  # of version 2


def zeros(shape: tuple[int, ...], dtype: torch.dtype, *, name: str, in_file: bool = False) -> Tensor:
    """Return zeros on the CPU, of pages that are allocated when first written, or ``in_file`` of an unlinked file."""
    import torch

    size = prod(shape) * dtype.itemsize
    if not size:
        return torch.zeros(shape, dtype=dtype)
    if not in_file or sys.platform == "win32":  # which cannot delete mapped files: there the page file serves
        # Not numpy.zeros, which requests large pages: clearing them took longer than the solve. Not torch.zeros,
        # which writes all zeros in one thread.
        return torch.frombuffer(map_anonymous(size), dtype=torch.uint8).view(dtype).view(shape)
    check_disk(size, name)
    handle, path = tempfile.mkstemp(prefix="splatlift-")
    try:
        if sys.platform == "linux":  # macOS has no such call: there a full disk kills the process
            os.posix_fallocate(handle, 0, size)
        return torch.from_file(path, shared=True, size=prod(shape), dtype=dtype).view(shape)
    except OSError as error:
        raise _no_disk(size, name, error.strerror or str(error)) from None
    finally:
        os.close(handle)
        Path(path).unlink()


def map_anonymous(size: int, flags: int = 0) -> mmap.mmap:
    """Map ``size`` bytes of zeros, private to this process; pages are allocated when they are first written."""
    if sys.platform == "win32":
        return mmap.mmap(-1, size)
    return mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | flags)


def check_disk(size: int, name: str) -> None:
    """Check early that the disk has ``size`` free bytes."""
    if got := lack_of_disk(size):
        raise _no_disk(size, name, got)


def lack_of_disk(size: int, folder: Path | None = None) -> str:
    """Describe what a folder, or the temporary one, has instead of ``size`` free bytes on a disk; empty if free."""
    place = folder or Path(tempfile.gettempdir())
    if folder is None and _file_system(place) in ("tmpfs", "ramfs"):
        return "a temporary folder in memory"
    free = shutil.disk_usage(place).free
    return "" if free >= size else f"{free / 2**30:.1f} GiB of disk"


def _file_system(folder: Path) -> str:
    """Return the type of a folder's file system as Linux names it; empty if it is unknown."""
    kinds: dict[Path, str] = {}
    with suppress(OSError):
        for line in Path("/proc/self/mounts").read_text(encoding="utf-8", errors="replace").splitlines():
            _, place, kind, *_ = line.split(" ")
            kinds[Path(place)] = kind  # the last mount at a place hides earlier ones
    path = folder.resolve()
    return next((kinds[place] for place in (path, *path.parents) if place in kinds), "")


def _no_disk(size: int, name: str, got: str) -> Unavailable:
    return Unavailable(
        name,
        expected=f"{size / 2**30:.1f} GiB of memory for them, or of disk in {tempfile.gettempdir()}",
        got=got,
        hint="set TMPDIR to a folder with more free space, or use fewer views, splats or channels",
    )


def free_memory() -> int | None:
    """Return the bytes that this process may still allocate, by machine and control group; None if unknown."""
    limits: list[int] = []
    with suppress(OSError, ValueError):  # not Linux
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        limits += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    with suppress(OSError, ValueError):  # no control group, or one without a limit, which is "max"
        names = ("memory.max", "memory.current", "memory.stat")
        limit, usage, stat = ((CONTROL_GROUP / name).read_text(encoding="ascii") for name in names)
        counts = dict(line.split() for line in stat.splitlines())
        # The usage includes the page cache of files, which is dropped on demand: it counts as free.
        cached = sum(int(counts.get(name, 0)) for name in ("inactive_file", "active_file"))
        limits.append(max(0, int(limit) - max(0, int(usage) - cached)))
    return min(limits, default=None)
