"""Huber's loss instead of squares: a closed form with smaller weights for distant regions.

The closed form minimises ``sum_jm W_jm |x_j - e_m|^2``. With Huber's loss, splat by splat, it minimises::

    sum_jm W_jm rho(|x_j - e_m|),    rho(d) = d^2 / 2 up to delta, then delta (d - delta / 2)

which is convex. It is minimised by reweighting (IRLS; Huber, *Robust Statistics*, 1981): the closed form of
``W'_jm = W_jm min(1, delta / d_jm)``, with the distances d of the step before, never increases the sum. delta is the
scene's mean distance at the first closed form, ``sum W d / sum W``, so the result is independent of the features'
scale.

**Blocks of splats.** delta is a sum over splats, by pieces; all else is a function of a splat's row of W.
"""

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from liftcore.runtime.device import CPU
from liftcore.runtime.jit import kernel, vectorised
from liftcore.runtime.memory import zeros
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, silent
from liftcore.solve.closed_form import morton_codes
from liftcore.solve.codebook import Codebook
from liftcore.solve.sums import PieceSums, piece_sums, sum_pieces
from liftcore.values.region_weights import (
    BLOCK_ENTRIES,
    BLOCK_ROWS,
    MEMORY_LIMIT,
    RegionWeights,
    row_blocks,
    run_each,
)

STEPS = 3  # of reweighting; more hardly change features
MOST_SCALE = 126  # largest exponent of the power of two


@one_thread()
def huber_factors(
    W: RegionWeights,
    codebook: Codebook,
    progress: Progress = silent,
    *,
    means: Tensor | None = None,
    threads: int | None = None,
    delta: float | None = None,
) -> Tensor:
    """Return the factor of each entry of W, [nnz] f32 in 0..1, for the closed form of Huber's loss.

    Args:
        W: of all views by rows of codebooks, on the CPU; of all splats, or of a block of them if delta is given.
        means: [n, 3] of the splats; neighbours are processed together.
        threads: None uses the cores that this process may use. The result is bitwise identical for any number.
        delta: of the scene; None: of these splats.
    """
    distances = RegionDistances(W, codebook, means, threads)
    factors = zeros(tuple(W.weight.shape), torch.float32, name="weights", in_file=distances.in_file)
    factors += 1.0
    for step in range(STEPS):
        lengths = distances.after(factors)
        if delta is None:
            delta = mean_distance(sum_pieces(distances.sums(lengths), (2, 1)))
        for first in range(0, lengths.shape[0], BLOCK_ENTRIES):
            block = slice(first, first + BLOCK_ENTRIES)
            factors[block] = torch.where(lengths[block] > delta, delta / lengths[block], 1.0)
        progress("loss", step + 1, STEPS, "steps")
    return factors


def mean_distance(sums: np.ndarray) -> float:
    """Return delta, from the sums [2, 1] f64 of all splats (`RegionDistances.sums`)."""
    return float(sums[0, 0]) / (float(sums[1, 0]) or 1.0)


class RegionDistances:
    """``|x_j - e_m|`` of the entries of a block of splats, times a power of two that depends on the codebook.

    Args: those of `huber_factors`.
    """

    def __init__(self, W: RegionWeights, codebook: Codebook, means: Tensor | None, threads: int | None) -> None:
        self.W, self.codebook, self.threads = W, codebook, threads
        self.in_file = 8 * W.weight.shape[0] > MEMORY_LIMIT
        rows = torch.nonzero(W.indptr.diff())[:, 0]
        self.rows = rows if means is None else rows[torch.argsort(morton_codes(means[rows]))]
        self.blocks = row_blocks(W.indptr.diff()[self.rows].numpy(), BLOCK_ROWS, BLOCK_ENTRIES)
        longest = max((float(lengths.max()) for lengths in codebook.lengths if lengths.numel()), default=0.0)
        # Squares of very long and very short rows overflow or underflow float32; the scale itself must not.
        self.scale = 2.0 ** min(-round(math.log2(longest)), MOST_SCALE) if longest > 0 else 1.0

    def after(self, factors: Tensor) -> Tensor:
        """Return distances [nnz] f32 with x_j of the closed form of W times these factors [nnz] f32."""
        W = self.W
        squares = zeros(tuple(W.weight.shape), torch.float32, name="weights", in_file=self.in_file)
        arrays = [part.numpy() for part in (W.indptr, W.region, W.weight, factors, squares)]
        for columns in self.codebook.slices():
            table = self.codebook.values(columns, CPU.place).mul_(self.scale).numpy()
            blocks = [(self.rows[first:last].numpy(), *arrays, table) for first, last in self.blocks]
            run_each(add_squares, blocks, self.threads)
        return squares.sqrt_()

    def sums(self, distances: Tensor) -> Iterator[PieceSums]:
        """Yield the sums of ``W d`` and ``W`` of every piece of the block, [2, 1]."""
        indptr, weight, lengths = (part.numpy() for part in (self.W.indptr, self.W.weight, distances))

        def add(first: int, last: int, table: np.ndarray) -> None:
            add_distances(first, last, indptr, weight, lengths, table)

        return piece_sums(add, indptr.size - 1, (2, 1), self.threads)


@kernel
def add_distances(first, last, indptr, weight, distances, sums):
    """Add ``W d`` and ``W`` of rows ``first..last``."""
    for k in range(indptr[first], indptr[last]):
        sums[0, 0] += weight[k] * np.float64(distances[k])
        sums[1, 0] += weight[k]


@vectorised
def add_squares(rows, indptr, region, weight, factors, squares, table):
    """Add ``|x_j - e_m|^2`` of the entries of some rows over the channels of the table [M, C] f32, x_j their mean."""
    width = table.shape[1]
    mean = np.empty(width)
    for row in rows:
        total, mean[:] = 0.0, 0.0
        for k in range(indptr[row], indptr[row + 1]):
            share = np.float64(weight[k]) * factors[k]
            total += share
            for c in range(width):
                mean[c] += share * table[region[k], c]
        inverse = 1.0 / total if total > 0 else 0.0
        for c in range(width):
            mean[c] *= inverse
        for k in range(indptr[row], indptr[row + 1]):
            square = np.float32(0.0)
            for c in range(width):
                away = np.float32(table[region[k], c] - mean[c])
                square += away * away
            squares[k] += square
