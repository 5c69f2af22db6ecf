"""Which channels are solved at a time: slices of all, a reduced basis, or random projections.

All three are linear maps of feature vectors, so a least-squares solution in them is the map of the solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.one_thread import one_thread

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

BLOCK = 32  # channels solved at a time: what a raster does in one pass, and memory for a few [P, 32] f32
_ROWS = 1 << 14  # rows widened to float32 at a time
_EXTRA = 8  # directions that the iteration carries beyond those asked for
_ROUNDS = 12  # of the subspace iteration
_FLOAT16_MAX = 65_504.0


@dataclass(frozen=True)
class Channels:
    """A block of channels: ``rows [n, F] -> rows axes [n, C]``, with axes orthonormal or a slice of the identity."""

    begin: int  # of the slice, or of the columns of axes
    end: int
    axes: Tensor | None  # [F, K] f32; None takes the channels as they are

    def project(self, rows: Tensor) -> np.ndarray:
        """[n, F] f16 or f32 -> [n, C] f32."""
        result = torch.empty(rows.shape[0], self.end - self.begin)
        axes = None if self.axes is None else self.axes[:, self.begin : self.end].contiguous()
        with one_thread():
            for first in range(0, rows.shape[0], _ROWS):
                part = rows[first : first + _ROWS]
                block = part[:, self.begin : self.end].float() if axes is None else part.float() @ axes
                result[first : first + _ROWS] = block
        return result.numpy()

    def add(self, features: Tensor, step: np.ndarray) -> Tensor:
        """Add ``step`` [P, C] f32, put back into all channels, to the features [P, F]; gives them.

        They are changed in place, unless float16 cannot hold the result: then a float32 copy is.
        """
        if features.dtype == torch.float16 and float(np.abs(step).max(initial=0)) > _FLOAT16_MAX / 4:
            features = features.float()
        axes = None if self.axes is None else self.axes[:, self.begin : self.end].T.contiguous()
        with one_thread():
            for first in range(0, features.shape[0], _ROWS):
                part = torch.from_numpy(step[first : first + _ROWS])
                target = features[first : first + _ROWS]
                if axes is None:
                    target = target[:, self.begin : self.end]
                target += (part if axes is None else part @ axes).to(features.dtype)
        return features


def blocks(channels: int, axes: Tensor | None = None) -> list[Channels]:
    """All channels, or all columns of ``axes`` [F, K], in blocks of one pass of the raster."""
    total = channels if axes is None else axes.shape[1]
    return [Channels(begin, min(begin + BLOCK, total), axes) for begin in range(0, total, BLOCK)]


def codebook_axes(codebooks: Sequence[Tensor], count: int) -> Tensor:
    """The ``count`` directions [F, count] f32 that hold most of the squares of all codebook rows.

    A block power iteration from a fixed start. The rows are not centred, so their mean is held too; every solution
    is a combination of them, and with ``count`` at their rank nothing is left out.
    """
    channels = codebooks[0].shape[1]
    generator = torch.Generator().manual_seed(0)
    width = min(channels, count + _EXTRA)
    axes = torch.randn(channels, width, generator=generator, dtype=torch.float64)
    longest = max(max((float(book.abs().max()) for book in codebooks if book.numel()), default=0.0), 1e-300)
    with one_thread():
        for _ in range(_ROUNDS):
            axes = torch.linalg.qr(_gram_times(codebooks, axes, longest)).Q
        image = _gram_times(codebooks, axes, longest)
        values, vectors = torch.linalg.eigh(axes.T @ image)
        order = torch.argsort(values, descending=True, stable=True)[:count]
        return (axes @ vectors[:, order]).float()


def random_axes(channels: int, count: int, seed: int) -> Tensor:
    """Gaussian projections [F, count] f32 that keep squared lengths in the mean (Johnson-Lindenstrauss)."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(channels, count, generator=generator) / count**0.5


def _gram_times(codebooks: Sequence[Tensor], axes: Tensor, scale: float) -> Tensor:
    """``sum_v E_v^T E_v axes / scale^2``."""
    total = torch.zeros_like(axes)
    for book in codebooks:
        for first in range(0, book.shape[0], _ROWS):
            rows = book[first : first + _ROWS].double() / scale
            total += rows.T @ (rows @ axes)
    return total
