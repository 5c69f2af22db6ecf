"""Where X lies: in memory, or in a mapped file where it does not fit beside the rest."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.errors import Unavailable

if TYPE_CHECKING:
    from torch import Tensor

FeatureRoom = Callable[[int, int, torch.dtype], "Tensor"]  # splats, channels, type: zeros [P, F] wherever they lie


def in_memory(splats: int, channels: int, dtype: torch.dtype) -> Tensor:
    """Zeros [P, F]: torch's, for numpy asks for large pages, and to clear those took longer than to solve."""
    return torch.zeros(splats, channels, dtype=dtype)


def in_file(splats: int, channels: int, dtype: torch.dtype) -> Tensor:
    """Zeros [P, F] mapped from a file without a name in the temporary folder: the system writes and drops its pages.

    Raises:
        Unavailable: the disk has no room. It is taken now, for a page without one would end the process later.
    """
    size = splats * channels * dtype.itemsize
    with tempfile.TemporaryFile(prefix="splatlift-features-") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            raise _no_disk(size, str(error.strerror)) from None
        return torch.from_numpy(np.memmap(file, _bits(dtype), "r+", shape=(splats, channels))).view(dtype)


def check_disk(size: int) -> None:
    """See early that the disk has room for ``size`` bytes.

    Raises:
        Unavailable: it has not.
    """
    free = shutil.disk_usage(tempfile.gettempdir()).free
    if free < size:
        raise _no_disk(size, f"{free / 2**30:.1f} GiB of disk")


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
