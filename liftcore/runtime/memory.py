"""Large arrays: in memory, or in mapped files that have no name, which the system writes and drops as it needs."""

import os
import shutil
import sys
import tempfile
from contextlib import suppress
from math import prod
from pathlib import Path

import torch
from torch import Tensor

from liftcore.errors import Unavailable
from liftcore.runtime.mapping import map_anonymous

MOUNTS = Path("/proc/self/mounts")
IN_MEMORY = ("tmpfs", "ramfs")
CONTROL_GROUPS = (  # folder, and the files of limit, use and statistics: versions 2 and 1
    ("/sys/fs/cgroup", ("memory.max", "memory.current", "memory.stat")),
    ("/sys/fs/cgroup/memory", ("memory.limit_in_bytes", "memory.usage_in_bytes", "memory.stat")),
)
FILE_PAGES = ("inactive_file", "active_file")


def zeros(shape: tuple[int, ...], dtype: torch.dtype, *, name: str, in_file: bool = False) -> Tensor:
    """Zeros on the CPU, of which no page is taken before it is written.

    Args:
        name: what errors call it. in_file: mapped from a file in the temporary folder that is gone with the tensor.
            On Windows, which deletes no file that is mapped, the page file is that file.

    Raises:
        Unavailable: the disk has no room. It is taken now, for a page without one would end the process later.
    """
    size = prod(shape) * dtype.itemsize
    if not size:
        return torch.zeros(shape, dtype=dtype)
    if not in_file or sys.platform == "win32":
        # Not numpy's, which asks for large pages: to clear those took longer than to solve. Nor torch's, which writes
        # the zeros by one thread, where all threads write soon, or nobody does.
        return torch.frombuffer(map_anonymous(size), dtype=torch.uint8).view(dtype).view(shape)
    check_disk(size, name)
    handle, path = tempfile.mkstemp(prefix="splatlift-")
    try:
        if sys.platform == "linux":  # not macOS, where a disk that fills meanwhile ends the process
            os.posix_fallocate(handle, 0, size)
        return torch.from_file(path, shared=True, size=prod(shape), dtype=dtype).view(shape)
    except OSError as error:
        raise _no_disk(size, name, error.strerror or str(error)) from None
    finally:
        os.close(handle)
        Path(path).unlink()


def check_disk(size: int, name: str) -> None:
    """See early that the disk has room for ``size`` bytes.

    Raises:
        Unavailable: it has not.
    """
    got = lack_of_disk(size)
    if got:
        raise _no_disk(size, name, got)


def lack_of_disk(size: int) -> str:
    """What the temporary folder has in place of room for ``size`` bytes on a disk; empty where there is room."""
    folder = Path(tempfile.gettempdir())
    if file_system(folder) in IN_MEMORY:
        return "a temporary folder that lies in memory itself"
    free = shutil.disk_usage(folder).free
    return "" if free >= size else f"{free / 2**30:.1f} GiB of disk"


def file_system(folder: Path, mounts: Path = MOUNTS) -> str:
    """The kind of file system that a folder lies on, as Linux names it; empty where nothing says."""
    kinds: dict[Path, str] = {}
    with suppress(OSError):
        for line in mounts.read_text(encoding="utf-8", errors="replace").splitlines():
            _, place, kind, *_ = line.split(" ")
            kinds[Path(place)] = kind  # the last one mounted there is the one seen
    own = folder.resolve()
    return next((kinds[place] for place in (own, *own.parents) if place in kinds), "")


def _no_disk(size: int, name: str, got: str) -> Unavailable:
    return Unavailable(
        name,
        expected=f"{size / 2**30:.1f} GiB of memory for them, or of disk in {tempfile.gettempdir()}",
        got=got,
        hint="set TMPDIR to a folder with more room, or try fewer views, fewer splats or fewer channels",
    )


def free_memory() -> int | None:
    """Bytes that this process may still take: of the machine, or of its control group; None where neither says."""
    found = []
    with suppress(OSError, ValueError):  # not Linux
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        found += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    for folder, names in CONTROL_GROUPS:
        with suppress(OSError, ValueError):  # a machine has one of the two, or none
            limit, used, stat = (Path(folder, name).read_text(encoding="ascii") for name in names)
            found += [group_memory(limit, used, stat)]
    return min((room for room in found if room is not None), default=None)


def group_memory(limit: str, used: str, stat: str) -> int | None:
    """Bytes that a control group has left, from the texts of its files; None where it has no limit.

    What is used counts the files that were read, which make room when memory is asked for: they are free.

    Raises:
        ValueError: the texts are not those of a control group.
    """
    if limit.strip() == "max":
        return None
    counts = dict(line.split() for line in stat.splitlines())
    names = [f"total_{name}" if f"total_{name}" in counts else name for name in FILE_PAGES]  # version 1: all below it
    cached = sum(int(counts.get(name, 0)) for name in names)
    return max(0, int(limit) - max(0, int(used) - cached))
