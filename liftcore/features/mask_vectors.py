"""The vectors of a view's masks, in a ``.npy`` file: row k is of mask k."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.errors import InvalidFeatures
from liftcore.io.npy import open_npy

if TYPE_CHECKING:
    from pathlib import Path

    from torch import Tensor


def mask_vectors(path: Path) -> Tensor:
    """[M, F] f16, or f32 where they are stored wider; whether they are finite is asked where packs are written.

    Raises:
        InvalidFeatures: the file is malformed, or no table of floats.
    """
    stored = open_npy(path)
    if stored.ndim != 2 or stored.dtype.kind != "f" or stored.dtype.itemsize > 8:
        raise InvalidFeatures(str(path), expected="floats [M, F]", got=f"{stored.dtype} {list(stored.shape)}")
    dtype = np.float16 if stored.dtype.itemsize == 2 else np.float32
    with np.errstate(over="ignore"):  # becomes infinite, and is refused as such where packs are written
        return torch.from_numpy(stored.astype(dtype, order="C"))
