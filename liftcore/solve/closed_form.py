"""The closed form: ``x_j = sum_v W_v[j] E_v / sum W[j]`` (paper Eq. 6, App. Tikhonov for squared weights).

X is never held in float32 as a whole. Splats go in blocks of neighbours (`gathering`) and channels in strips
(`weighted_sums`), so that a block's entries and the rows of a strip that it reads stay in the cache.
Weights are divided by their sum before they meet the codebook: a mean cannot overflow where its inputs do not, and
faint splats keep their digits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numba import types
from numba.extending import overload

from liftcore.jit import kernel
from liftcore.one_thread import one_thread
from liftcore.progress import silent
from liftcore.raster.base import RegionWeights
from liftcore.raster.cpu.lanes import LANES, copy_values, keep_halves, lanes_at, no_lanes, plus_product, sum_of_lanes
from liftcore.raster.cpu.lanes_rows import WIDE
from liftcore.solve.columns import Columns, rows_of
from liftcore.solve.curve import places_along_curve
from liftcore.solve.gathering import Gathering
from liftcore.solve.host import ALL_CORES, Host
from liftcore.solve.weight_tables import WeightTables
from liftcore.solve.weighted_sums import (
    Entries,
    block_end,
    channel_slices,
    first_columns,
    strips_of,
    sum_strip,
    sum_strip_twice,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from liftcore.progress import Progress
    from liftcore.solve.host import EachShare
    from liftcore.solve.view_weights import WeightStore
    from liftcore.solve.weighted_sums import Strips

BLOCK_ENTRIES = 1 << 12  # summed strip by strip, before their splats' rows are copied to X
NORM_VALUES = 1 << 16  # of a codebook that are widened at a time
FLOAT16_MAX = 65_504.0
FLOAT16_STEP = 2.0**-25  # the largest rounding error of its small values
FLOAT16_ERROR = 1e-4  # of the longest vector, which float16 must hold
SHORTEST = 1e-30  # of the vectors whose inverse length float32 takes well, and of these inverses
UNIT_TOLERANCE = 5e-3  # float16 unit vectors are off by less


@dataclass(frozen=True)
class Solution:
    """X and how much the inputs of each splat agreed."""

    features: Tensor  # [P, F] f16 or f32, zero rows where nothing was seen
    agreement: Tensor  # [P] f32, norm of the weighted mean of unit codebook rows


@kernel
def finish_rows(block, squares, begin, features):
    """Squared norms of a block's rows, and the rows as X has them.

    Args:
        block: [B, C] f32, channels ``begin..`` of the rows, padded with zeros.
        squares: [B] f64, grows. features: [B, F] in the bits of f16 (u16), or f32; [0, F] keeps nothing.
    """
    source, width = block.reshape(-1), block.shape[1]
    for row in range(block.shape[0]):
        total = no_lanes()
        for c in range(0, width, LANES):
            values = lanes_at(source, row * width + c)
            total = plus_product(total, values, values)
        squares[row] += sum_of_lanes(total)
    if features.shape[0] > 0:
        _store_rows(source, width, begin, features)


def _store_rows(source, width, begin, features) -> Any:
    """The block's rows into X, rounded if it is float16."""


@overload(_store_rows, inline="always")
def _overload_store_rows(source, width, begin, features):
    return _store_halves if features.dtype == types.uint16 else _store_singles


def _store_halves(source, width, begin, features):
    kept = min(width, features.shape[1] - begin)
    whole = kept // LANES * LANES
    target, last = features.reshape(-1), np.empty(LANES, np.uint16)
    for row in range(features.shape[0]):
        place = row * features.shape[1] + begin
        for c in range(0, whole, LANES):
            keep_halves(target, place + c, lanes_at(source, row * width + c))
        if whole < kept:
            keep_halves(last, 0, lanes_at(source, row * width + whole))
            target[place + whole : place + kept] = last[: kept - whole]


def _store_singles(source, width, begin, features):
    kept = min(width, features.shape[1] - begin)
    for row in range(features.shape[0]):
        features[row, begin : begin + kept] = source[row * width : row * width + kept]


@one_thread()
def solve_closed_form(
    store: Sequence[RegionWeights] | WeightStore,
    columns: Sequence[Columns],
    denominators: np.ndarray,
    dtype: torch.dtype,
    progress: Progress,
    host: Host = ALL_CORES,
) -> Solution:
    """Solve for X, slice by slice of channels and block by block of splats.

    Args:
        store: W of every view.
        columns: of every view, what the columns of its W stand for.
        denominators: [P] f64, row sums of W over all views.
        dtype: how X is stored; float16 becomes float32 when the codebooks are too large or too small for it.
        host: what there is to solve with, and where X is to lie.
    """
    books = [part.codebook for part in columns]
    channels = books[0].shape[1]
    norms = [row_norms(book).numpy() for book in books]
    unit = all(bool((np.abs(norm - 1) < UNIT_TOLERANCE).all()) for norm in norms)
    if dtype == torch.float16 and not fits_float16(books, max(float(norm.max()) for norm in norms)):
        dtype = torch.float32
    count = denominators.shape[0]
    features = host.room(count, channels, dtype)  # every share of splats fills its rows
    kept = features.view(torch.uint16).numpy() if dtype == torch.float16 else features.numpy()
    squares, nothing = np.zeros(count), kept[:0]
    scale = np.divide(1.0, denominators, out=np.zeros(count), where=denominators > 0)
    halves = all(_in_halves(part, dtype) for part in columns)
    counts, tables = [part.count for part in columns], WeightTables(store)
    inverse = None if unit else _inverse(columns, norms)
    apart = not unit and inverse is None  # strips of unit vectors, beside the others
    slices = channel_slices(sum(counts), channels, (2 if halves else 4) + (4 if apart else 0))
    with host.workers() as (_, each_share):
        columns_of_all = (first_columns(counts), scale)
        gathering = Gathering(each_share, tables, columns_of_all, host.places(channels), channels * dtype.itemsize)
        for number, (begin, end) in enumerate(slices):
            parts = (part.means(part.codebook[:, begin:end]) for part in columns)
            strips = strips_of(parts, counts, end - begin, torch.float16 if halves else torch.float32)
            sums = [(strips, inverse, (np.zeros(count) if apart else squares, begin, kept))]
            if apart:
                parts = (
                    part.means(_unit_rows(part.codebook[:, begin:end], norm))
                    for part, norm in zip(columns, norms, strict=True)
                )
                sums.append((strips_of(parts, counts, end - begin, torch.float32), None, (squares, begin, nothing)))
            _solve_strips(each_share, gathering, sums)
            del strips, sums  # before others are made
            progress("solve", number + 1, len(slices), "slices")
    agreement = np.sqrt(squares).clip(0.0, 1.0).astype(np.float32)
    return Solution(features, torch.from_numpy(agreement))


def _in_halves(columns: Columns, dtype: torch.dtype) -> bool:
    """Whether strips of f16 hold the columns: rows as they are, means of rows rounded as X is."""
    return columns.codebook.dtype == torch.float16 and (columns.tuples is None or dtype == torch.float16)


def row_norms(book: Tensor) -> Tensor:
    """[M] f64: lengths of a codebook's rows [M, F], f16 or f32.

    Some rows at a time: all in float64 were four times what a codebook of float16 takes.
    """
    norms = torch.empty(book.shape[0], dtype=torch.float64)
    step = max(1, NORM_VALUES // max(book.shape[1], 1))
    for first in range(0, book.shape[0], step):
        wide = book[first : first + step].float()  # two quick conversions instead of a slow one
        torch.linalg.vector_norm(wide, dim=1, dtype=torch.float64, out=norms[first : first + step])
    return norms


def fits_float16(books: Sequence[Tensor], longest: float) -> bool:
    """Whether float16 holds every value of the codebooks, and the longest of their rows to FLOAT16_ERROR."""
    if any(max(abs(float(end)) for end in torch.aminmax(book)) > FLOAT16_MAX for book in books):
        return False
    return longest == 0 or FLOAT16_STEP * math.sqrt(books[0].shape[1]) <= FLOAT16_ERROR * longest


def _inverse(columns: Sequence[Columns], norms: Sequence[np.ndarray]) -> np.ndarray | None:
    """[rows] f32: of every row of all codebooks one over its length, zero for none, which makes of rows unit vectors.

    None where columns are means of several rows, or a product with it would leave float32.
    """
    lengths = np.concatenate(norms)
    lengths = np.where(lengths > 0, lengths, np.inf)
    if any(part.tuples is not None for part in columns) or lengths.min() < SHORTEST:
        return None
    inverse = 1.0 / lengths
    return None if inverse.min(initial=1.0, where=inverse > 0) < SHORTEST else inverse.astype(np.float32)


def _unit_rows(part: Tensor, norms: np.ndarray) -> Tensor:
    """Some channels of a codebook as f32, every row divided by its norm, if it has one."""
    rows = part.to(torch.float32, copy=True).numpy()
    return torch.from_numpy(np.divide(rows, norms[:, None], out=rows, where=norms[:, None] > 0, casting="same_kind"))


@kernel
def solve_share(share, splats, entries, strips, inverse, result):
    """X of a share of a chunk over the channels of the strips, and the squared norms of its rows.

    Args:
        share: (first, last) of the chunk's ``splats`` [B] i64. entries: theirs. strips: Strips.
        inverse: [rows] f32, what makes unit vectors of the strips' rows: then norms are those of their sums; or None.
        result: (squares [P] f64, which grow; the first channel; X [P, F] in the bits of f16 (u16), or f32, [0, F] to
            keep nothing).
    """
    squares, begin, features = result
    starts, last = entries.starts[: share[1] + 1], share[0]
    width, target = min(strips.number * WIDE, features.shape[1] - begin), features.reshape(-1)
    while last < share[1]:
        first, last = last, block_end(starts, last, BLOCK_ENTRIES)
        count, own = last - first, Entries(starts[first : last + 1], entries.rows, entries.shares)
        sums, norms = np.empty((count, WIDE), np.float32), np.zeros(count)
        rows = np.empty((min(count, features.shape[0]), width), features.dtype)
        if inverse is None:
            for strip in range(strips.number):
                sum_strip(own, strips, strip, sums)
                finish_rows(sums, norms, strip * WIDE, rows)
        else:
            units, others = np.empty((count, WIDE), np.float32), np.zeros(count)
            for strip in range(strips.number):
                sum_strip_twice(own, strips, strip, inverse, (sums, units))
                finish_rows(units, norms, strip * WIDE, rows[:0])
                finish_rows(sums, others, strip * WIDE, rows)
        for row in range(count):
            squares[splats[first + row]] += norms[row]
        source = rows.reshape(-1)
        for row in range(rows.shape[0]):  # whole, so that a page of X is written while it is there
            copy_values(target, splats[first + row] * features.shape[1] + begin, source, row * width, width)


def _solve_strips(
    each_share: EachShare,
    gathering: Gathering,
    sums: Sequence[tuple[Strips, np.ndarray | None, tuple[np.ndarray, int, np.ndarray]]],
) -> None:
    """Each of the strips, with its rows' inverse lengths, for all splats, into its ``(squares, first channel, X)``.

    W is gathered once for all.
    """
    for chunk in gathering:
        for strips, inverse, result in sums:
            given = (chunk.splats, chunk.entries, strips, inverse, result)
            each_share(lambda share, given=given: solve_share(share, *given), 0, chunk.splats.size)


def warm_up_solution() -> None:
    """Compile the kernels of the solution, or load them from the disk cache, for both types of X and of codebooks."""
    one = torch.zeros(1, dtype=torch.int32)
    weights = RegionWeights(one, torch.tensor([0, 1]), one, torch.ones(1), one, torch.ones(1))
    for dtype, kind, length in product((torch.float16, torch.float32), (torch.float16, torch.float32), (1.0, 2.0)):
        columns = rows_of([torch.full((1, 1), length, dtype=kind)])
        solve_closed_form([weights], columns, np.ones(1), dtype, silent, Host(1))
    places_along_curve(torch.zeros(1, 3))  # which more channels than one ask for
