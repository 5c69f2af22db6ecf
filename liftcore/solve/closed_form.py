"""The closed form: ``x_j = sum_v W_v[j] E_v / sum W[j]`` (paper Eq. 6, App. Tikhonov for squared weights).

`liftcore.solve.shared_rows` computes the sums: one thread adds a row in a fixed order, so the result is bitwise
identical for any number of threads.

Weights are divided by their sum before the product with the codebook. So a mean cannot overflow if its inputs do not,
and faint splats keep their precision. At most LONG terms of a splat are added one by one in float32; more terms are
added in pieces of LONG, as a plain float32 sum of ten million equal terms is wrong in its first digit.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from liftcore.runtime.device import give_back_memory
from liftcore.runtime.memory import zeros
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, silent
from liftcore.solve.codebook import Codebook
from liftcore.solve.shared_rows import LONG, flat_table, sum_rows
from liftcore.values.region_weights import BLOCK_ENTRIES, BLOCK_ROWS, RegionWeights, from_zero, row_blocks, run_each

# rows [n] i64 -> means of vectors, of unit vectors, [n, C] f32
BlockMeans = Callable[[Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Solution:
    """X and the consistency of the vectors that views give each splat."""

    features: Tensor  # [P, F] f16 or f32, zero rows of splats without weights
    view_consistency: Tensor  # [P] f32, norm of the weighted mean of unit codebook rows


@one_thread()
def solve(
    W: RegionWeights,
    codebook: Codebook,
    dtype: torch.dtype,
    progress: Progress = silent,
    *,
    means: Tensor | None = None,
    threads: int | None = None,
    memory: int | None = None,
) -> Solution:
    """Return ``X = D^-1 W E`` and the consistency of the vectors that views give each splat.

    Args:
        W: of all views, with a row for every splat, on the CPU.
        dtype: of X; float16 becomes float32 if the codebooks are too large or too small for it.
        means: [P, 3] f32, centres of the splats: neighbours read the same codebook rows, so they are solved in one
            block. None solves in the order of the rows.
        threads: None uses the cores that this process may use. The result is bitwise identical for any.
        memory: bytes above which X is stored in a mapped file; None for no limit.
    """
    if dtype == torch.float16 and not codebook.fits_float16():
        dtype = torch.float32
    shape = W.splats.shape[0], codebook.channels
    size = shape[0] * shape[1] * dtype.itemsize
    X = zeros(shape, dtype, name="features", in_file=memory is not None and size > memory)
    rows = torch.nonzero(W.indptr.diff())[:, 0]
    squares = solve_rows(X, rows, W, codebook, progress, means=means, threads=threads)
    give_back_memory()
    return Solution(X, squares.sqrt().clamp(0.0, 1.0).float())


def solve_rows(
    X: Tensor,
    rows: Tensor,
    W: RegionWeights,
    codebook: Codebook,
    progress: Progress = silent,
    *,
    means: Tensor | None = None,
    threads: int | None = None,
) -> Tensor:
    """Solve for some splats, by their numbers [n] i64, and write their rows of X [P, F].

    Returns:
        [P] f64, squared lengths of the means of unit vectors; zero for the other splats.
    """
    sums = W.row_sums()
    scale = torch.where(sums > 0, 1.0 / sums, 0.0)
    squares = torch.zeros(X.shape[0], dtype=torch.float64)
    if means is not None:
        rows = rows[torch.argsort(morton_codes(means.cpu()[rows]))]
    blocks = row_blocks(W.indptr.diff()[rows].numpy(), BLOCK_ROWS, BLOCK_ENTRIES)
    slices = list(codebook.slices())
    inverse = None if codebook.unit or codebook.inverse_lengths is None else codebook.inverse_lengths
    for number, channels in enumerate(slices):
        table = codebook.values(channels, X.device)
        units = None if codebook.unit or inverse is not None else codebook.unit_values(channels, X.device)
        means_of = _block_means(W, scale, table, units, inverse)

        def solve_block(first: int, last: int, means_of: BlockMeans = means_of, channels: slice = channels) -> None:
            block_rows = rows[first:last]
            block_means, unit_means = means_of(block_rows)
            X[:, channels].index_copy_(0, block_rows, block_means.to(X.dtype))
            squares[block_rows] += torch.linalg.vector_norm(unit_means, dim=1).double().square()

        run_each(solve_block, blocks, threads)
        progress("solve", number + 1, len(slices), "slices")
    return squares


def _block_means(
    W: RegionWeights, scale: Tensor, table: Tensor, units: Tensor | None, inverse: Tensor | None
) -> BlockMeans:
    """Return a function for the means of rows of W.

    Args:
        scale: [P] f64, 1 / row sum. table: [M, C] f32. units: [M, C] f32, unit rows of the table. inverse: [M] f32,
            inverse lengths of its rows. At most one of the two is given; neither if the rows have unit length.
    """
    indptr, region, weight, scales = (part.numpy() for part in (W.indptr, W.region, W.weight, scale))
    flat, width, none = flat_table(table), table.shape[1], np.empty(0, np.float32)
    flat_units = None if units is None else flat_table(units)
    inverse_lengths = none if inverse is None else inverse.numpy()

    def sum_table(rows: np.ndarray, table: np.ndarray, inverse_lengths: np.ndarray = none) -> Tensor:
        sums = np.empty((rows.size, width), np.float32)
        sum_rows(*[rows, indptr, region, weight, scales, inverse_lengths, table, width, sums])
        return torch.from_numpy(sums)

    def means_of(block_rows: Tensor) -> tuple[Tensor, Tensor]:
        rows = block_rows.numpy()
        means = sum_table(rows, flat)
        if flat_units is not None:
            return means, sum_table(rows, flat_units)
        return means, means if inverse is None else sum_table(rows, flat, inverse_lengths)

    return means_of


def bag_sums(index: Tensor, table: Tensor, starts: Tensor, shares: Tensor | None = None) -> Tensor:
    """Return ``sum_k shares[k] table[index[k]]`` of each bag b, k in ``starts[b]..starts[b + 1]``: [B, C] f32.

    Args:
        index: [n] i32 or i64. table: [M, C] f32. starts: [B + 1] i64. shares: [n] f32; None for ones.
    """
    lengths = starts.diff()
    if lengths.numel() == 0 or int(lengths.max()) <= LONG:
        return _bags(index, table, starts, shares)
    counts = (lengths + LONG - 1) // LONG  # of parts
    bags = from_zero(counts)
    total = int(bags[-1])
    number = torch.arange(total, device=starts.device)
    part_starts = torch.repeat_interleave(starts[:-1] - LONG * bags[:-1], counts, output_size=total) + LONG * number
    parts = _bags(index, table, torch.cat([part_starts, starts[-1:]]), shares)
    return bag_sums(number, parts, bags)


def _bags(index: Tensor, table: Tensor, starts: Tensor, shares: Tensor | None) -> Tensor:
    return embedding_bag(
        index, table, starts.to(index.dtype), mode="sum", per_sample_weights=shares, include_last_offset=True
    )


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
