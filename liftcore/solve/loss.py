"""Huber's loss in place of squares: the closed form of weights that lie far less on what is far away.

The closed form is the smallest ``sum_jm W_jm |x_j - e_m|^2``. With Huber's loss it is, splat by splat, that of::

    sum_jm W_jm rho(|x_j - e_m|),    rho(d) = d^2 / 2 up to delta, then delta (d - delta / 2)

which is convex. Its smallest is found by reweighting (IRLS; Huber, *Robust Statistics*, 1981): the closed form of
``W'_jm = W_jm min(1, delta / d_jm)``, with the distances d of the step before, never raises the sum. delta is the
scene's mean distance at the first closed form, ``sum W d / sum W``, so that nothing depends on how long features are.

**How it splits.** delta is a sum over splats, taken by pieces; all else is a function of a splat's row of W.
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
from liftcore.solve.sums import PieceSums, added, piece_sums
from liftcore.values.region_weights import (
    BLOCK_ENTRIES,
    BLOCK_ROWS,
    MEMORY_LIMIT,
    RegionWeights,
    row_blocks,
    run_each,
)

STEPS = 3  # of reweighting, which hardly move features further
MOST_SCALE = 126  # the power of two


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
    """What each entry of W is multiplied with, [nnz] f32 in 0..1, for its closed form to be that of Huber's loss.

    Args:
        W: of all views by rows of codebooks, on the CPU; of all splats, or of a block of them where delta is known.
        means: [n, 3] of the splats; neighbours go together.
        threads: None takes the cores that this process may use. The number changes no bit.
        delta: of the scene; None: of these splats.
    """
    distances = RegionDistances(W, codebook, means, threads)
    factors = zeros(tuple(W.weight.shape), torch.float32, name="weights", in_file=distances.in_file)
    factors += 1.0
    for step in range(STEPS):
        found = distances.after(factors)
        if delta is None:
            delta = mean_distance(added(distances.sums(found), (2, 1)))
        for first in range(0, found.shape[0], BLOCK_ENTRIES):
            own = slice(first, first + BLOCK_ENTRIES)
            factors[own] = torch.where(found[own] > delta, delta / found[own], 1.0)
        progress("loss", step + 1, STEPS, "steps")
    return factors


def mean_distance(sums: np.ndarray) -> float:
    """delta, from the sums [2, 1] f64 of all splats (`RegionDistances.sums`)."""
    return float(sums[0, 0]) / (float(sums[1, 0]) or 1.0)


class RegionDistances:
    """``|x_j - e_m|`` of the entries of a block of splats, times a power of two that the codebook gives.

    Args: as `huber_factors` has them.
    """

    def __init__(self, W: RegionWeights, codebook: Codebook, means: Tensor | None, threads: int | None) -> None:
        self.W, self.codebook, self.threads = W, codebook, threads
        self.in_file = 8 * W.weight.shape[0] > MEMORY_LIMIT
        rows = torch.nonzero(W.indptr.diff())[:, 0]
        self.rows = rows if means is None else rows[torch.argsort(morton_codes(means[rows]))]
        self.blocks = row_blocks(W.indptr.diff()[self.rows].numpy(), BLOCK_ROWS, BLOCK_ENTRIES)
        longest = max((float(own.max()) for own in codebook.lengths if own.numel()), default=0.0)
        # Squares of very long and short rows have no place in float32, nor has the scale of what it hardly holds.
        self.scale = 2.0 ** min(-round(math.log2(longest)), MOST_SCALE) if longest > 0 else 1.0

    def after(self, factors: Tensor) -> Tensor:
        """[nnz] f32, with x_j of the closed form of W times these factors [nnz] f32."""
        W = self.W
        squares = zeros(tuple(W.weight.shape), torch.float32, name="weights", in_file=self.in_file)
        arrays = [part.numpy() for part in (W.indptr, W.region, W.weight, factors, squares)]
        for columns in self.codebook.slices():
            table = self.codebook.values(columns, CPU.place).mul_(self.scale).numpy()
            blocks = [(self.rows[first:last].numpy(), *arrays, table) for first, last in self.blocks]
            run_each(add_squares, blocks, self.threads)
        return squares.sqrt_()

    def sums(self, distances: Tensor) -> Iterator[PieceSums]:
        """``W d`` and ``W`` at every piece of the block, [2, 1]."""
        indptr, weight, moved = (part.numpy() for part in (self.W.indptr, self.W.weight, distances))

        def add(first: int, last: int, table: np.ndarray) -> None:
            add_distances(first, last, indptr, weight, moved, table)

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
