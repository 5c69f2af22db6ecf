"""Where X lies: in memory, or in a mapped file where it does not fit beside the rest."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.errors import Unavailable

if TYPE_CHECKING:
    from torch import Tensor

MOUNTS = Path("/proc/self/mounts")
IN_MEMORY = ("tmpfs", "ramfs")

# Splats, channels, type: [P, F], not filled, wherever it lies.
FeatureRoom = Callable[[int, int, torch.dtype], "Tensor"]


def in_memory(splats: int, channels: int, dtype: torch.dtype) -> Tensor:
    """Room [P, F]: torch's, for numpy asks for large pages, and to clear those took longer than to solve.

    Not zeros: one thread would touch every page where all threads write them soon.
    """
    return torch.empty(splats, channels, dtype=dtype)


def room_within(limit: int | None) -> FeatureRoom:
    """Room in memory for up to ``limit`` bytes, in a file beyond; None for no limit."""

    def room(splats: int, channels: int, dtype: torch.dtype) -> Tensor:
        fits = limit is None or splats * channels * dtype.itemsize <= limit
        return in_memory(splats, channels, dtype) if fits else in_file(splats, channels, dtype)

    return room


def in_file(splats: int, channels: int, dtype: torch.dtype) -> Tensor:
    """Room [P, F] mapped from a file without a name in the temporary folder: the system writes and drops its pages.

    Raises:
        Unavailable: the disk has no room. It is taken now, for a page without one would end the process later.
    """
    size = splats * channels * dtype.itemsize
    check_disk(size)
    with tempfile.TemporaryFile(prefix="splatlift-features-") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            raise _no_disk(size, str(error.strerror)) from None
        return torch.from_numpy(np.memmap(file, _bits(dtype), "r+", shape=(splats, channels))).view(dtype)


def check_disk(size: int) -> None:
    """See early that the disk has room for ``size`` bytes of features.

    Raises:
        Unavailable: it has not.
    """
    got = lack_of_disk(size)
    if got:
        raise _no_disk(size, got)


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


def _no_disk(size: int, got: str) -> Unavailable:
    return Unavailable(
        "features",
        expected=f"{size / 2**30:.1f} GiB of memory for them, or of disk in {tempfile.gettempdir()}",
        got=got,
        hint="set TMPDIR to a folder with more room, or try dtype=float16, fewer splats or fewer channels",
    )


def _bits(dtype: torch.dtype) -> type[np.generic]:
    """What numpy has of a type: float16 as its bits, which compiled code writes."""
    return np.uint16 if dtype == torch.float16 else np.float32
