"""The closed form: ``x_j = sum_v W_v[j] E_v / sum W[j]`` (paper Eq. 6, App. Tikhonov for squared weights).

On the CPU `liftcore.solve.shared_rows` makes the sums, on a device torch's ``embedding_bag``: one thread adds up a
row in a fixed order, so the bits repeat for any number of threads. A product with a sparse tensor would take
cuSPARSE's default algorithm, and ``index_add_`` atomic sums: neither has a fixed order.

Weights are divided by their sum before they meet the codebook: a mean cannot overflow where its inputs do not, and
faint splats keep their digits. float32 adds LONG terms one by one; longer bags, of a splat behind a million regions,
are sums of the sums of such parts: added one by one, ten million equal terms would be wrong in their first digit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from liftcore.runtime.cores import cores
from liftcore.runtime.device import CPU, Device, give_back_memory, out_of_memory
from liftcore.runtime.memory import zeros
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, silent
from liftcore.solve.codebook import Codebook
from liftcore.solve.shared_rows import LONG, flat_table, sum_rows
from liftcore.values.region_weights import BLOCK_ENTRIES, BLOCK_ROWS, RegionWeights, from_zero, row_blocks, run_each

DEVICE_ROWS, DEVICE_ENTRIES = 1 << 16, 1 << 24  # of a block on a device; halved where its memory runs out
LEAST_ROWS = 256  # of a block that is halved no more
BESIDE = 4  # blocks of a device in work together: to write one into X takes longer than to sum it up

Sums = Callable[[Tensor], tuple[Tensor, Tensor]]  # of rows [n] i64: means of vectors and of unit ones, [n, C] f32


@dataclass(frozen=True)
class Solution:
    """X and how much the inputs of each splat agreed."""

    features: Tensor  # [P, F] f16 or f32, zero rows where nothing was seen
    agreement: Tensor  # [P] f32, norm of the weighted mean of unit codebook rows


@one_thread()
def solve(
    W: RegionWeights,
    codebook: Codebook,
    dtype: torch.dtype,
    progress: Progress = silent,
    *,
    means: Tensor | None = None,
    threads: int | None = None,
    device: Device = CPU,
    memory: int | None = None,
) -> Solution:
    """``X = D^-1 W E`` and the agreement of each splat's inputs.

    Args:
        W: of all views, with a row for every splat, wherever it lies.
        dtype: how X is stored; float16 becomes float32 when the codebooks are too large or too small for it.
        means: [P, 3] of the splats: neighbours, which read the same rows, are solved together. None: in their order.
        threads: of the CPU. None takes the cores that this process may use. The number changes no bit.
        device: where the sums are made; X comes back to the CPU.
        memory: bytes that X may take before it lies in a mapped file; None for no limit.
    """
    if dtype == torch.float16 and not codebook.fits_float16():
        dtype = torch.float32
    shape = W.splats.shape[0], codebook.channels
    size = shape[0] * shape[1] * dtype.itemsize
    X = zeros(shape, dtype, name="features", in_file=memory is not None and size > memory)
    seen = torch.nonzero(W.indptr.diff())[:, 0]
    squares = solve_rows(X, seen, W, codebook, progress, means=means, threads=threads, device=device)
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
    device: Device = CPU,
    sums: Tensor | None = None,
    unit: Tensor | None = None,
) -> Tensor:
    """Solve for some splats alone, by their numbers [n] i64, into their rows of X [P, F].

    Args:
        sums: [P] f64, of the rows of the W that this one is a part of: its part of ``D^-1 W E``. None: of its own.
        unit: [P, F] f32, whose rows become the same means of unit vectors.

    Returns:
        [P] f64, squared lengths of the means of unit vectors; zero for the other splats.
    """
    sums = W.row_sums() if sums is None else sums
    scale = torch.where(sums > 0, 1.0 / sums, 0.0)
    squares = torch.zeros(X.shape[0], dtype=torch.float64)
    if means is not None:
        rows = rows[torch.argsort(morton_codes(means.cpu()[rows.cpu()])).to(rows.device)]
    most = (BLOCK_ROWS, BLOCK_ENTRIES) if device.kind == "cpu" else (DEVICE_ROWS, DEVICE_ENTRIES)
    blocks = row_blocks(W.indptr.diff()[rows].cpu().numpy(), *most)
    slices = list(codebook.slices())
    inverse = None if codebook.unit or codebook.inverse_lengths is None else codebook.inverse_lengths.to(device.place)
    for number, channels in enumerate(slices):
        table = codebook.values(channels, device.place)
        units = None if codebook.unit or inverse is not None else codebook.unit_values(channels, device.place)

        if device.kind == "cpu":
            sums_of = _sums_by_processor(W, scale, table, units, inverse)
        else:
            sums_of = _sums_by_device(W, scale, table, units, inverse)

        def solve_block(first: int, last: int, sums_of: Sums = sums_of, channels: slice = channels) -> None:
            own = rows[first:last]
            sums, unit_sums = sums_of(own)
            own = own.cpu()
            X[:, channels].index_copy_(0, own, sums.to(X.dtype).cpu())
            if unit is not None:
                unit[:, channels].index_copy_(0, own, unit_sums.cpu())
            squares[own] += torch.linalg.vector_norm(unit_sums, dim=1).double().square().cpu()

        if device.kind == "cpu":
            run_each(solve_block, blocks, threads)
        else:
            workers, late = threads or cores(), list[tuple[int, int]]()
            run_each(partial(_unless_full, solve_block, late), blocks, min(workers, BESIDE))
            for block in late:
                _halved_to_fit(solve_block, *block)
        progress("solve", number + 1, len(slices), "slices")
    return squares


def _sums_by_processor(
    W: RegionWeights, scale: Tensor, table: Tensor, units: Tensor | None, inverse: Tensor | None
) -> Sums:
    """Sums of rows of W on the CPU."""
    indptr, region, weight, scales = (part.cpu().numpy() for part in (W.indptr, W.region, W.weight, scale))
    flat, width, none = flat_table(table), table.shape[1], np.empty(0, np.float32)
    flat_units = None if units is None else flat_table(units)
    lengths = none if inverse is None else inverse.numpy()

    def summed(rows: np.ndarray, table: np.ndarray, lengths: np.ndarray = none) -> Tensor:
        sums = np.empty((rows.size, width), np.float32)
        sum_rows(*[rows, indptr, region, weight, scales, lengths, table, width, sums])
        return torch.from_numpy(sums)

    def sums_of(own: Tensor) -> tuple[Tensor, Tensor]:
        rows = own.cpu().numpy()
        sums = summed(rows, flat)
        if flat_units is not None:
            return sums, summed(rows, flat_units)
        return sums, sums if inverse is None else summed(rows, flat, lengths)

    return sums_of


def _sums_by_device(
    W: RegionWeights, scale: Tensor, table: Tensor, units: Tensor | None, inverse: Tensor | None
) -> Sums:
    """Sums of rows of W, wherever it lies, on the device of the table."""
    place = table.device

    def sums_of(own: Tensor) -> tuple[Tensor, Tensor]:
        starts, entries = W.take(own)
        scales = scale[own].repeat_interleave(starts.diff(), output_size=entries.shape[0])
        shares = (W.weight.index_select(0, entries) * scales).float().to(place)
        region, starts = W.region.index_select(0, entries).to(place), starts.to(place)
        del entries, scales
        sums = bag_sums(region, table, starts, shares)
        if units is not None:
            return sums, bag_sums(region, units, starts, shares)
        if inverse is not None:
            return sums, bag_sums(region, table, starts, shares.mul_(inverse.index_select(0, region)))
        return sums, sums

    return sums_of


def bag_sums(index: Tensor, table: Tensor, starts: Tensor, shares: Tensor | None = None) -> Tensor:
    """``sum_k shares[k] table[index[k]]`` over bags, k in ``starts[b]..starts[b + 1]``: [B, C] f32.

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


def _unless_full(work: Callable[[int, int], None], late: list[tuple[int, int]], first: int, last: int) -> None:
    """Do a block of work, or note it for later where the device has no room for it beside the others."""
    try:
        work(first, last)
    except RuntimeError as error:
        if not out_of_memory(error):
            raise
        late.append((first, last))


def _halved_to_fit(work: Callable[[int, int], None], first: int, last: int) -> None:
    """Do a block of work, in halves where the device has less room than that.

    Raises:
        RuntimeError: LEAST_ROWS do not fit either (`device.out_of_memory`).
    """
    try:
        work(first, last)
    except RuntimeError as error:
        if not out_of_memory(error) or last - first <= LEAST_ROWS:
            raise
    else:
        return
    torch.cuda.empty_cache()  # out here the error no longer holds what the block held
    middle = (first + last) // 2
    _halved_to_fit(work, first, middle)
    _halved_to_fit(work, middle, last)


def morton_codes(points: Tensor, bounds: Tensor | None = None) -> Tensor:
    """[n] i64: places along a curve that fills space, near to one another on it is near in space (Morton, 1966).

    Args:
        points: [n, 3] f32, finite, any frame and unit; of 2^21 cells an axis between the least and the greatest.
        bounds: [2, 3], the least and the greatest; None: of the points.
    """
    codes = torch.zeros(points.shape[0], dtype=torch.int64)
    for axis, values in enumerate(points.double().T if codes.numel() else ()):
        low, high = values.aminmax() if bounds is None else bounds[:, axis].double()
        cells = ((values - low) * ((2**21 - 1) / (high - low) if high > low else 0.0)).long()
        for shift, mask in (  # 21 bits in a row to the same with two zeros before each
            (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
        ):  # fmt: skip
            cells = (cells | cells << shift) & mask
        codes |= cells << axis
    return codes
