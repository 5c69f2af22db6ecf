"""Huber's loss in place of squares: the closed form of weights that lie far less on what is far away.

The closed form is the smallest ``sum_jm W_jm |x_j - e_m|^2``. With Huber's loss it is, splat by splat, that of::

    sum_jm W_jm rho(|x_j - e_m|),    rho(d) = d^2 / 2 up to delta, then delta (d - delta / 2)

which is convex. Its smallest is found by reweighting (IRLS; Huber, *Robust Statistics*, 1981): the closed form of
``W'_jm = W_jm min(1, delta / d_jm)``, with the distances d of the step before, never raises the sum. delta is the
scene's mean distance at the first closed form, ``sum W d / sum W``, so that nothing depends on how long features are.
"""

import math

import numpy as np
import torch
from torch import Tensor

from liftcore.device import CPU
from liftcore.jit import vectorised
from liftcore.one_thread import one_thread
from liftcore.progress import Progress, silent
from liftcore.solve.closed_form import morton_codes
from liftcore.solve.codebook import Codebook
from liftcore.solve.memory import zeros
from liftcore.solve.weights import BLOCK_ENTRIES, BLOCK_ROWS, MEMORY_LIMIT, RegionWeights, row_blocks, run_each

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
) -> Tensor:
    """What each entry of W is multiplied with, [nnz] f32 in 0..1, for its closed form to be that of Huber's loss.

    Args:
        W: of all views by rows of codebooks, on the CPU. means: [P, 3] of the splats; neighbours go together.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    rows = torch.nonzero(W.indptr.diff())[:, 0]
    rows = rows if means is None else rows[torch.argsort(morton_codes(means[rows]))]
    blocks = row_blocks(W.indptr.diff()[rows].numpy(), BLOCK_ROWS, BLOCK_ENTRIES)
    longest = max((float(own.max()) for own in codebook.lengths if own.numel()), default=0.0)
    # Squares of very long and short rows have no place in float32, nor has the scale of what it hardly holds itself.
    scale = 2.0 ** min(-round(math.log2(longest)), MOST_SCALE) if longest > 0 else 1.0
    in_file = 8 * W.weight.shape[0] > MEMORY_LIMIT
    factors, delta = zeros(tuple(W.weight.shape), torch.float32, name="weights", in_file=in_file), 0.0
    factors += 1.0
    for step in range(STEPS):
        squares = zeros(tuple(W.weight.shape), torch.float32, name="weights", in_file=in_file)
        for columns in codebook.slices():
            table = codebook.values(columns, CPU.place).mul_(scale).numpy()
            arrays = [part.numpy() for part in (W.indptr, W.region, W.weight, factors, squares)]
            run_each(add_squares, [(rows[first:last].numpy(), *arrays, table) for first, last in blocks], threads)
        distances = squares.sqrt_()
        parts = [slice(first, first + BLOCK_ENTRIES) for first in range(0, squares.shape[0], BLOCK_ENTRIES)]
        if step == 0:
            moved = sum(float(W.weight[own].double() @ distances[own].double()) for own in parts)
            delta = moved / (float(W.row_sums().sum()) or 1.0)
        for own in parts:
            factors[own] = torch.where(distances[own] > delta, delta / distances[own], 1.0)
        progress("loss", step + 1, STEPS, "steps")
    return factors


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
