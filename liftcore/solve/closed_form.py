"""The closed form: ``x_j = sum_v W_v[j] E_v / sum W[j]`` (paper Eq. 6, App. Tikhonov for squared weights).

X is never held in float32 as a whole. Splats go in chunks (`gathering`) and channels in strips, so that a chunk's
entries and the rows of a strip that it reads stay in the cache. Weights are divided by their sum before they meet the
codebook: a mean cannot overflow where its inputs do not, and faint splats keep their digits.

Sums are float32 over a few hundred terms at most. Longer ones, of a splat behind a million regions or of thousands of
views, are sums of such parts in float64: added one by one, ten million equal terms would be wrong in their first
digit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from liftcore.jit import vectorised
from liftcore.one_thread import one_thread
from liftcore.progress import Progress, silent
from liftcore.raster.base import RegionWeights
from liftcore.solve.columns import Columns, rows_of
from liftcore.solve.curve import places_along_curve
from liftcore.solve.gathering import LONG, WIDE, Chunk, EachShare, Gathering, channel_slices, strips_of
from liftcore.solve.host import ALL_CORES, Host
from liftcore.solve.view_weights import WeightStore

NORM_VALUES = 1 << 16  # of a codebook that are widened at a time
FLOAT16_MAX = 65_504.0
FLOAT16_STEP = 2.0**-25  # the largest rounding error of its small values
FLOAT16_ERROR = 1e-4  # of the longest vector, which float16 must hold
UNIT_TOLERANCE = 5e-3  # float16 unit vectors are off by less


@dataclass(frozen=True)
class Solution:
    """X and how much the inputs of each splat agreed."""

    features: Tensor  # [P, F] f16 or f32, zero rows where nothing was seen
    agreement: Tensor  # [P] f32, norm of the weighted mean of unit codebook rows


@one_thread()
def solve_closed_form(
    store: Sequence[RegionWeights] | WeightStore,
    columns: Sequence[Columns],
    denominators: np.ndarray,
    dtype: torch.dtype,
    progress: Progress,
    host: Host = ALL_CORES,
) -> Solution:
    """Solve for X, slice by slice of channels and chunk by chunk of splats.

    Args:
        store: W of every view.
        columns: of every view, what the columns of its W stand for.
        denominators: [P] f64, row sums of W over all views.
        dtype: how X is stored; float16 becomes float32 when the codebooks are too large or too small for it.
        host: what there is to solve with, and where X is to lie.
    """
    books = [part.codebook for part in columns]
    channels, count = books[0].shape[1], denominators.shape[0]
    norms = [row_norms(book).numpy() for book in books]
    unit = all(bool((np.abs(norm - 1) < UNIT_TOLERANCE).all()) for norm in norms)
    if dtype == torch.float16 and not fits_float16(books, max(float(norm.max()) for norm in norms)):
        dtype = torch.float32
    features = host.room(count, channels, dtype)  # every share of splats fills its rows
    squares, counts = np.zeros(count), [part.count for part in columns]
    scale = np.divide(1.0, denominators, out=np.zeros(count), where=denominators > 0)
    slices = channel_slices(sum(counts) * (1 if unit else 2), channels)
    with host.workers() as (_, each_share):
        row_bytes = channels * dtype.itemsize
        gathering = Gathering(each_share, store, counts, scale, host.places(channels), row_bytes)
        for number, (begin, end) in enumerate(slices):
            rows = (part.means(part.codebook[:, begin:end]) for part in columns)
            strips, others = strips_of(rows, sum(counts), end - begin), None
            if not unit:
                pairs = zip(columns, norms, strict=True)
                rows = (part.means(_unit_rows(part.codebook[:, begin:end], norm)) for part, norm in pairs)
                others = strips_of(rows, sum(counts), end - begin)
            for chunk in gathering:
                solve_chunk(each_share, chunk, strips, features[chunk.first : chunk.last, begin:end], squares, others)
            del strips, others  # before others are made
            progress("solve", number + 1, len(slices), "slices")
    agreement = np.sqrt(squares).clip(0.0, 1.0).astype(np.float32)
    return Solution(features, torch.from_numpy(agreement))


def solve_chunk(
    each_share: EachShare,
    chunk: Chunk,
    strips: np.ndarray,
    target: Tensor,
    squares: np.ndarray,
    units: np.ndarray | None = None,
) -> None:
    """X of a chunk over the channels of the strips, and the squared norms of the means of unit vectors.

    Args:
        strips: [S, M, WIDE] f32. target: [n, C] f16 or f32, written. squares: [P] f64, those of the chunk grow.
        units: the strips of unit vectors, where ``strips`` are none.
    """
    count = chunk.last - chunk.first
    sums, own = np.empty((count, WIDE), np.float32), squares[chunk.first : chunk.last]
    made = torch.from_numpy(sums)
    for strip in range(strips.shape[0]):
        part = target[:, strip * WIDE : (strip + 1) * WIDE]

        def add(values: np.ndarray, lengths: np.ndarray) -> None:
            each_share(partial(sum_rows, *chunk[2:6], values, sums, lengths), 0, count)

        def keep(first: int, last: int, part: Tensor = part) -> None:
            part[first:last].copy_(made[first:last, : part.shape[1]])

        if units is not None:
            add(units[strip], own)
        add(strips[strip], own if units is None else np.zeros(count))
        each_share(keep, 0, count)


@vectorised
def sum_rows(order, indptr, rows, shares, strip, sums, squares, begin_row, end_row):
    """``sums[b] = sum_k shares[k] strip[rows[k]]`` of the rows ``order[begin_row:end_row]``, and their norms.

    Args:
        order: [n] i64, row numbers. indptr: [n + 1] i64. rows: [nnz] i32. shares: [nnz] f32.
        strip: [M, WIDE] f32. sums: [n, WIDE] f32, written. squares: [n] f64.
    """
    part, total = np.empty(WIDE, np.float32), np.empty(WIDE)
    for place in range(begin_row, end_row):
        own = order[place]
        first, last = indptr[own], indptr[own + 1]
        total[:] = 0
        for begin in range(first, last, LONG):
            part[:] = 0
            for k in range(begin, min(begin + LONG, last)):
                line, share = strip[rows[k]], shares[k]
                for c in range(WIDE):
                    part[c] += share * line[c]
            for c in range(WIDE):
                total[c] += part[c]
        square = 0.0
        for c in range(WIDE):
            sums[own, c] = total[c]
            square += total[c] * total[c]
        squares[own] += square


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


def _unit_rows(part: Tensor, norms: np.ndarray) -> Tensor:
    """Some channels of a codebook as f32, every row divided by its norm, if it has one."""
    rows = part.to(torch.float32, copy=True).numpy()
    return torch.from_numpy(np.divide(rows, norms[:, None], out=rows, where=norms[:, None] > 0, casting="same_kind"))


def warm_up_solution() -> None:
    """Compile the kernels of the solution, or load them from the disk cache."""
    one = torch.zeros(1, dtype=torch.int32)
    weights = RegionWeights(one, torch.tensor([0, 1]), one, torch.ones(1), one, torch.ones(1))
    solve_closed_form([weights], rows_of([torch.ones(1, 1)]), np.ones(1), torch.float16, silent, Host(1))
    places_along_curve(torch.zeros(1, 3))  # which more channels than one ask for
