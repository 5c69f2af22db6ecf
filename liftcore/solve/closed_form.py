"""The closed form: ``x_j = sum_v W_v[j] E_v / sum W[j]`` (paper Eq. 6, App. Tikhonov for squared weights).

`liftcore.solve.shared_rows` computes the sums: one thread adds a row in a fixed order, so the result is bitwise
identical for any number of threads.

Weights are divided by their sum before the product with the codebook. So a mean cannot overflow if its inputs do not,
and faint splats keep their precision. At most LONG terms of a splat are added one by one in float32; more terms are
added in pieces of LONG, as a plain float32 sum of ten million equal terms is wrong in its first digit.
"""

import numpy as np
import torch
from torch import Tensor

from liftcore.solve.codebook import Codebook
from liftcore.solve.shared_rows import flat_table, sum_rows
from liftcore.values.region_weights import BLOCK_ENTRIES, BLOCK_ROWS, RegionWeights, row_blocks, run_each


def solve_rows(
    X: Tensor,
    W: RegionWeights,
    codebook: Codebook,
    *,
    sums: Tensor | None = None,
    means: Tensor | None = None,
    threads: int | None = None,
) -> None:
    """Write ``D^-1 W E`` to the rows of X [P, F] f16 or f32 of splats that have weights.

    Args:
        W: of all views, with a row for every splat of X, on the CPU. sums: [P] f64, of its rows, if they are known.
        means: [P, 3] f32, centres of the splats: neighbours read the same codebook rows, so they are solved in one
            block. None solves in the order of the rows.
    """
    rows, sums = torch.nonzero(W.indptr.diff())[:, 0], W.row_sums() if sums is None else sums
    if means is not None:
        rows = rows[torch.argsort(morton_codes(means[rows]))]
    scales = torch.where(sums > 0, 1.0 / sums, 0.0).numpy()
    indptr, region, weight = (part.numpy() for part in (W.indptr, W.region, W.weight))
    blocks = row_blocks(W.indptr.diff()[rows].numpy(), BLOCK_ROWS, BLOCK_ENTRIES)
    for channels in codebook.slices():
        table, width = flat_table(codebook.values(channels)), channels.stop - channels.start

        def solve_block(
            first: int, last: int, table: np.ndarray = table, width: int = width, channels: slice = channels
        ) -> None:
            block_rows = rows[first:last]
            block_means = np.empty((last - first, width), np.float32)
            sum_rows(*[block_rows.numpy(), indptr, region, weight, scales, table, width, block_means])
            X[:, channels].index_copy_(0, block_rows, torch.from_numpy(block_means).to(X.dtype))

        run_each(solve_block, blocks, threads)


def morton_codes(points: Tensor, bounds: Tensor | None = None) -> Tensor:
    """Return positions [n] i64 along a space-filling curve that keeps neighbours close (Morton, 1966).

    Args:
        points: [n, 3] f32, finite, any frame and unit; quantised to 2^21 cells per axis between the bounds.
        bounds: [2, 3], minimum and maximum; None: of the points.
    """
    codes = torch.zeros(points.shape[0], dtype=torch.int64, device=points.device)
    for axis, values in enumerate(points.double().T if codes.numel() else ()):
        low, high = values.aminmax() if bounds is None else bounds[:, axis].double()
        cells = ((values - low) * ((2**21 - 1) / (high - low) if high > low else 0.0)).long()
        for shift, mask in (  # spreads 21 bits, two zeros before each
            (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
        ):  # fmt: skip
            cells = (cells | cells << shift) & mask
        codes |= cells << axis
    return codes
