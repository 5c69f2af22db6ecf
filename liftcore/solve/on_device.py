"""The closed form on any device of torch: the sums of ``closed_form``, in blocks of splats and slices of channels.

W of a block of splats is gathered from all views into rows of one sparse matrix, whose columns are those of all
views, one after the other. A row is cut into parts of LONG entries. ``embedding_bag`` adds up a part in float32:
on a card one thread reads the entries of a part in their order, nothing is written between the product and the sum,
and no sum is shared, so the bits repeat. The parts of a row are added in float64 the same way. A product with a
sparse tensor would take cuSPARSE's default algorithm, and ``index_add_`` atomic sums: neither has a fixed order.

No bit depends on where splats are cut into blocks, so a block may follow the memory that happens to be free; the
slices follow the size of the codebooks alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch.nn.functional import embedding_bag

from liftcore.device import out_of_memory
from liftcore.solve.closed_form import UNIT_TOLERANCE, Solution, fits_float16, row_norms
from liftcore.solve.device_blocks import GRAIN, block_room, bounds_of, device_slices, splat_blocks
from liftcore.solve.feature_room import in_memory

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from torch import Tensor

    from liftcore.progress import Progress
    from liftcore.raster.base import RegionWeights
    from liftcore.solve.columns import Columns
    from liftcore.solve.feature_room import FeatureRoom
    from liftcore.solve.view_weights import WeightStore

LONG = 256  # entries that float32 adds up one by one


class Place(NamedTuple):
    """A device, and what of its memory may be taken."""

    device: torch.device
    free: int | None = None  # bytes; None for a device without limits of its own


@dataclass(frozen=True)
class BlockRows:
    """W of a block of splats, its rows divided by their sums: a row a splat, its views in their order."""

    columns: Tensor  # [nnz] i32, among those of all views
    shares: Tensor  # [nnz] f32
    part_starts: Tensor  # [parts + 1] i32, entries of each part
    row_parts: Tensor  # [B + 1] i32, parts of each row


def solve_on_device(
    store: Sequence[RegionWeights] | WeightStore,
    columns: Sequence[Columns],
    denominators: np.ndarray,
    dtype: torch.dtype,
    progress: Progress,
    place: Place,
    room: FeatureRoom = in_memory,
) -> Solution:
    """Solve for X as ``solve_closed_form`` does, which describes the arguments; X comes back to the host.

    Args:
        place: where the sums are made. What is free there changes no bit.
        room: where X is to lie, on the host.

    Raises:
        RuntimeError: not even a grain of splats fits beside a slice of the codebooks (``device.out_of_memory``).
    """
    books = [part.codebook for part in columns]
    count, channels = denominators.shape[0], books[0].shape[1]
    norms = [row_norms(book) for book in books]
    unit = all(bool(((norm - 1).abs() < UNIT_TOLERANCE).all()) for norm in norms)
    if dtype == torch.float16 and not fits_float16(books, max(float(norm.max()) for norm in norms)):
        dtype = torch.float32
    scale = torch.from_numpy(np.divide(1.0, denominators, out=np.zeros(count), where=denominators > 0))
    X, squares = room(count, channels, dtype), torch.zeros(count, dtype=torch.float64)
    counts = [part.count for part in columns]
    work, rows = _Work(store, counts, scale, place.device, X, squares), sum(counts)
    slices = device_slices(rows, channels)
    for number, (begin, end) in enumerate(slices):
        chosen = slice(begin, end)
        values = _all_columns(columns, chosen, place.device)
        units = None if unit else _all_columns(columns, chosen, place.device, norms)
        most = block_room(place.free, rows, end - begin, unit)
        for block in splat_blocks(store, count, end - begin, most):
            for done in _solve_fitting(work, _Slice(chosen, values, units), block):
                progress("solve", number * count + done, len(slices) * count, "splats")
    return Solution(X, squares.sqrt().clamp(0.0, 1.0).to(torch.float32))


@dataclass(frozen=True)
class _Work:
    """What all blocks and slices share. X and squares are on the host; each block and slice fills its part."""

    store: Sequence[RegionWeights] | WeightStore
    counts: Sequence[int]  # columns of every view's W
    scale: Tensor  # [P] f64, one by the sums of rows
    place: torch.device
    X: Tensor  # [P, F] f16 or f32
    squares: Tensor  # [P] f64, of the means of unit vectors


@dataclass(frozen=True)
class _Slice:
    """Channels of what all columns stand for, view by view, on the device."""

    channels: slice
    values: Tensor  # [M, C] f32
    units: Tensor | None  # the same of the unit vectors; None where the codebooks hold such


def _solve_fitting(work: _Work, own: _Slice, splats: tuple[int, int]) -> Iterator[int]:
    """Solve a block, in halves where the device has less room than it said; yields how far it is."""
    waiting = [splats]
    while waiting:
        first, last = waiting.pop()
        try:
            _solve_block(work, own, (first, last))
        except RuntimeError as error:
            if not out_of_memory(error) or last - first <= GRAIN:
                raise
        else:
            yield last
            continue
        torch.cuda.empty_cache()  # out here the error no longer holds what the block held
        middle = (first + last) // 2
        waiting += [(middle, last), (first, middle)]


def _solve_block(work: _Work, own: _Slice, splats: tuple[int, int]) -> None:
    block = block_rows(work.store, work.counts, splats, work.scale, work.place)
    rows = slice(*splats)
    if block is None:
        work.X[rows, own.channels] = 0
        return
    sums = weighted_sums(block, own.values)
    lengths = squared_lengths(sums if own.units is None else weighted_sums(block, own.units))
    work.X[rows, own.channels] = sums.to(torch.float32).to(work.X.dtype).cpu()
    work.squares[rows] += lengths.cpu()


def block_rows(
    store: Sequence[RegionWeights] | WeightStore,
    counts: Sequence[int],
    splats: tuple[int, int],
    scale: Tensor,
    place: torch.device,
) -> BlockRows | None:
    """The rows of some splats; None where no view has an entry.

    Args:
        counts: columns of every view. splats: (first, last). scale: [P] f64, what rows are multiplied with.
    """
    offset, base, gathered = splats[0], 0, []
    for weights, count, (first, last, begin, end) in zip(store, counts, bounds_of(store, splats), strict=True):
        if begin < end:
            own = weights.splats[first:last], weights.indptr[first : last + 1], weights.columns[begin:end]
            ids, starts, columns, values = (part.to(place) for part in (*own, weights.weights[begin:end]))
            gathered.append((ids, torch.diff(starts), columns + base, values))
        base += count
    if not gathered:
        return None
    owners, lengths, columns, values = (torch.cat(part) for part in zip(*gathered, strict=True))
    owners, order = torch.sort(owners - offset, stable=True)  # of equal ones the earlier view stays first
    taken = _from_zero(lengths)[:-1][order]
    lengths = lengths[order]
    starts = _from_zero(lengths)
    total = columns.shape[0]
    entries = _repeated(taken - starts[:-1], lengths, total) + torch.arange(total, device=place)
    every = torch.arange(splats[1] - offset + 1, dtype=owners.dtype, device=place)
    starts = starts[torch.searchsorted(owners, every)]  # of each splat's entries
    own_scale = _repeated(scale[offset : splats[1]].to(place), torch.diff(starts), total)
    shares = (values[entries].to(torch.float64) * own_scale).to(torch.float32)
    part_starts, row_parts = _parts(starts)
    return BlockRows(columns[entries], shares, part_starts, row_parts)


def _parts(starts: Tensor) -> tuple[Tensor, Tensor]:
    """Rows [B + 1] i64 cut into parts of LONG entries: the entries of each part, and the parts of each row, i32."""
    counts = torch.diff(starts).add(LONG - 1).div(LONG, rounding_mode="floor")
    row_parts = _from_zero(counts)
    total = int(row_parts[-1])
    number = torch.arange(total, device=starts.device) - _repeated(row_parts[:-1], counts, total)
    part_starts = torch.cat([_repeated(starts[:-1], counts, total) + LONG * number, starts[-1:]])
    return part_starts.to(torch.int32), row_parts.to(torch.int32)


def weighted_sums(block: BlockRows, book: Tensor) -> Tensor:
    """``W E`` of a block: book [M, C] f32 -> [B, C] f64."""
    parts = _bags(block.columns, book, block.part_starts, block.shares)
    order = torch.arange(parts.shape[0], dtype=torch.int32, device=parts.device)
    return _bags(order, parts.to(torch.float64), block.row_parts)


def _bags(columns: Tensor, rows: Tensor, starts: Tensor, shares: Tensor | None = None) -> Tensor:
    """Sums of rows [n, C], those of bag k at ``columns[starts[k]:starts[k + 1]]``, times their shares."""
    return embedding_bag(columns, rows, starts, mode="sum", per_sample_weights=shares, include_last_offset=True)


def squared_lengths(values: Tensor) -> Tensor:
    """Squared norms of rows: [B, C] f64 -> [B] f64.

    Channels are added half to half. torch's own sum may take another order for another number of rows.
    """
    squares = values.square()
    while squares.shape[1] > 1:
        half = squares.shape[1] // 2
        halves = squares[:, :half] + squares[:, half : 2 * half]
        squares = torch.cat([halves, squares[:, 2 * half :]], dim=1)
    return squares[:, 0]


def _all_columns(
    columns: Sequence[Columns], channels: slice, place: torch.device, norms: Sequence[Tensor] | None = None
) -> Tensor:
    """Some channels of what all columns stand for, view by view, [M, C] f32.

    Args:
        norms: [M] f64 of every codebook, which rows are divided by, those of norm zero left as they are.
    """
    values = torch.empty(sum(own.count for own in columns), channels.stop - channels.start, device=place)
    base = 0
    for view, own in enumerate(columns):
        rows = own.codebook[:, channels].to(place)
        if norms is not None:
            divisors = torch.where(norms[view] > 0, norms[view], 1.0).to(place)
            rows = (rows.to(torch.float64) / divisors[:, None]).to(torch.float32)
        values[base : base + own.count] = own.means(rows)
        base += own.count
    return values


def _from_zero(lengths: Tensor) -> Tensor:
    """[n] -> [n + 1], their sums from the left, from nought."""
    return torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])


def _repeated(values: Tensor, counts: Tensor, total: int) -> Tensor:
    """Each value so many times, ``total`` in all: told, so that no device must be waited for."""
    return torch.repeat_interleave(values, counts, output_size=total)
