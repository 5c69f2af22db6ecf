"""Where X lies: in memory, or in a mapped file where it does not fit beside the rest."""

from __future__ import annotations

import os
import tempfile

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import Unavailable


def in_memory(splats: int, channels: int, dtype: torch.dtype) -> Tensor:
    """Zeros [P, F]: from numpy, which asks for large pages; small ones take longer to come than to be filled."""
    return torch.from_numpy(np.zeros((splats, channels), _bits(dtype))).view(dtype)


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
            raise Unavailable(
                "features",
                expected=f"{size / 2**30:.1f} GiB of memory, or of disk in {tempfile.gettempdir()}",
                got=f"{error.strerror}",
                hint="set TMPDIR to a folder with more room, or try dtype=float16 or fewer splats",
            ) from None
        return torch.from_numpy(np.memmap(file, _bits(dtype), "r+", shape=(splats, channels))).view(dtype)


def _bits(dtype: torch.dtype) -> type[np.generic]:
    """What numpy has of a type: float16 as its bits, which compiled code writes."""
    return np.uint16 if dtype == torch.float16 else np.float32
