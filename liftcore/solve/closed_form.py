"""The closed form: ``x_j = sum_v W_v[j] E_v / sum W[j]`` (paper Eq. 6, App. Tikhonov for squared weights).

X is never held in float32 as a whole. Splats go in blocks and channels in strips (`weighted_sums`), so that a block's
entries and a strip of all codebooks stay in the cache. Weights are divided by their sum before they meet the
codebook: a mean cannot overflow where its inputs do not, and faint splats keep their digits.
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numba import types
from numba.extending import overload

from liftcore.jit import kernel
from liftcore.lanes import LANES, WIDE, keep_halves, lanes_at, no_lanes, plus_product, sum_of_lanes
from liftcore.progress import silent
from liftcore.raster.protocol import RegionWeights
from liftcore.solve.columns import Columns, rows_of
from liftcore.solve.feature_room import in_memory
from liftcore.solve.weight_tables import WeightTables
from liftcore.solve.weighted_sums import (
    block_end,
    block_entries,
    channel_slices,
    entries_before,
    most_entries,
    splat_shares,
    strips_of,
    sum_strip,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from torch import Tensor

    from liftcore.progress import Progress
    from liftcore.solve.feature_room import FeatureRoom
    from liftcore.solve.view_weights import ViewWeights
    from liftcore.solve.weighted_sums import Strips

FLOAT16_MAX = 65_504.0
FLOAT16_STEP = 2.0**-25  # the largest rounding error of its small values
FLOAT16_ERROR = 1e-4  # of the longest vector, which float16 must hold
UNIT_TOLERANCE = 5e-3  # float16 unit vectors are off by less


@dataclass(frozen=True)
class Solution:
    """X and how much the inputs of each splat agreed."""

    features: Tensor  # [P, F] f16 or f32, zero rows where nothing was seen
    agreement: Tensor  # [P] f32, norm of the weighted mean of unit codebook rows


@kernel
def finish_rows(block, first, squares, begin, features):
    """Squared norms of a block's rows, and the rows into X.

    Args:
        block: [B, C] f32, channels ``begin..`` of the splats from ``first`` on, padded with zeros.
        squares: [P] f64, grows. features: [P, F] in the bits of f16 (u16), or f32; [0, F] keeps nothing.
    """
    source, width = block.reshape(-1), block.shape[1]
    for row in range(block.shape[0]):
        total = no_lanes()
        for c in range(0, width, LANES):
            values = lanes_at(source, row * width + c)
            total = plus_product(total, values, values)
        squares[first + row] += sum_of_lanes(total)
    if features.shape[0] > 0:
        _store_rows(source, (block.shape[0], width), first, begin, features)


def _store_rows(source, shape, first, begin, features) -> Any:
    """The block's rows into X, rounded if it is float16."""


@overload(_store_rows, inline="always")
def _overload_store_rows(source, shape, first, begin, features):
    return _store_halves if features.dtype == types.uint16 else _store_singles


def _store_halves(source, shape, first, begin, features):
    count, width = shape
    kept = min(width, features.shape[1] - begin)
    whole = kept // LANES * LANES
    target, last = features.reshape(-1), np.empty(LANES, np.uint16)
    for row in range(count):
        place = (first + row) * features.shape[1] + begin
        for c in range(0, whole, LANES):
            keep_halves(target, place + c, lanes_at(source, row * width + c))
        if whole < kept:
            keep_halves(last, 0, lanes_at(source, row * width + whole))
            target[place + whole : place + kept] = last[: kept - whole]


def _store_singles(source, shape, first, begin, features):
    count, width = shape
    kept = min(width, features.shape[1] - begin)
    for row in range(count):
        features[first + row, begin : begin + kept] = source[row * width : row * width + kept]


def solve_closed_form(
    store: Sequence[RegionWeights] | ViewWeights,
    columns: Callable[[int], Columns],
    denominators: np.ndarray,
    dtype: torch.dtype,
    progress: Progress,
    threads: int | None = None,
    room: FeatureRoom = in_memory,
) -> Solution:
    """Solve for X, slice by slice of channels and block by block of splats.

    Args:
        store: W of every view.
        columns: view number -> what the columns of its W stand for.
        denominators: [P] f64, row sums of W over all views.
        dtype: how X is stored; float16 becomes float32 when the codebooks are too large or too small for it.
        threads: None takes the cores that this process may use. The number changes no bit.
        room: where X is to lie.
    """
    own = [columns(view) for view in range(len(store))]
    books = [part.codebook for part in own]
    channels = books[0].shape[1]
    norms = [torch.linalg.vector_norm(book, dim=1, dtype=torch.float64).numpy() for book in books]
    unit = all(bool((np.abs(norm - 1) < UNIT_TOLERANCE).all()) for norm in norms)
    if dtype == torch.float16 and not fits_float16(books, max(float(norm.max()) for norm in norms)):
        dtype = torch.float32
    count = denominators.shape[0]
    features = room(count, channels, dtype)  # every share of splats fills its rows
    kept = features.view(torch.uint16).numpy() if dtype == torch.float16 else features.numpy()
    squares, nothing = np.zeros(count), kept[:0]
    scale = np.divide(1.0, denominators, out=np.zeros(count), where=denominators > 0)
    halves = all(_in_halves(part, dtype) for part in own)
    counts, tables = [part.count for part in own], WeightTables(store)
    slices = channel_slices(sum(counts), channels, 2 if halves and unit else 4)
    with ThreadPoolExecutor(threads or len(os.sched_getaffinity(0))) as pool:
        for number, (begin, end) in enumerate(slices):
            parts = (part.means(part.codebook[:, begin:end]) for part in own)
            strips = strips_of(parts, counts, end - begin, torch.float16 if halves else torch.float32)
            _solve_strips(pool, tables, strips, scale, (squares if unit else np.zeros(count), begin, kept))
            del strips  # before others are made
            if not unit:
                parts = (
                    part.means(_unit_rows(part.codebook[:, begin:end], norm))
                    for part, norm in zip(own, norms, strict=True)
                )
                strips = strips_of(parts, counts, end - begin, torch.float32)
                _solve_strips(pool, tables, strips, scale, (squares, begin, nothing))
                del strips
            progress("solve", number + 1, len(slices), "slices")
    agreement = np.sqrt(squares).clip(0.0, 1.0).astype(np.float32)
    return Solution(features, torch.from_numpy(agreement))


def _in_halves(columns: Columns, dtype: torch.dtype) -> bool:
    """Whether strips of f16 hold the columns: rows as they are, means of rows rounded as X is."""
    return columns.codebook.dtype == torch.float16 and (columns.tuples is None or dtype == torch.float16)


def fits_float16(books: Sequence[Tensor], longest: float) -> bool:
    """Whether float16 holds every value of the codebooks, and the longest of their rows to FLOAT16_ERROR."""
    if any(max(abs(float(end)) for end in torch.aminmax(book)) > FLOAT16_MAX for book in books):
        return False
    return longest == 0 or FLOAT16_STEP * math.sqrt(books[0].shape[1]) <= FLOAT16_ERROR * longest


def _unit_rows(part: Tensor, norms: np.ndarray) -> Tensor:
    """Some channels of a codebook as f32, every row divided by its norm, if it has one."""
    rows = part.to(torch.float32, copy=True).numpy()
    return torch.from_numpy(np.divide(rows, norms[:, None], out=rows, where=norms[:, None] > 0, casting="same_kind"))


@kernel
def solve_share(splats, tables, strips, scale, result):
    """X of a share of splats over the channels of the strips, and their squared norms.

    Args:
        splats: (first, last). tables: (addresses, rows) of WeightTables. strips: Strips. scale: [P] f64.
        result: (squares, begin, features) as ``finish_rows`` takes them.
    """
    squares, begin, features = result
    starts, most = entries_before(splats, tables), most_entries(strips.rows)
    first = 0
    while first < starts.shape[0] - 1:
        last = block_end(starts, first, most)
        block = (splats[0] + first, splats[0] + last)
        entries = block_entries(block, starts[first : last + 1], tables, strips.bases, scale)
        sums = np.empty((last - first, WIDE), np.float32)
        for strip in range(strips.number):
            sum_strip(entries, strips, strip, sums)
            finish_rows(sums, block[0], squares, begin + strip * WIDE, features)
        first = last


def _solve_strips(
    pool: ThreadPoolExecutor,
    weights: WeightTables,
    strips: Strips,
    scale: np.ndarray,
    result: tuple[np.ndarray, int, np.ndarray],
) -> None:
    """The strips for all splats, into ``result = (squares, first channel, X)``."""
    tables = (weights.addresses, weights.rows)
    list(pool.map(lambda share: solve_share(share, tables, strips, scale, result), splat_shares(scale.shape[0])))


def warm_up_solution() -> None:
    """Compile the kernels of the solution, or load them from the disk cache, for both types of X and of codebooks."""
    one = torch.zeros(1, dtype=torch.int32)
    weights = RegionWeights(one, torch.tensor([0, 1]), one, torch.ones(1), one, torch.ones(1))
    for dtype, kind in product((torch.float16, torch.float32), repeat=2):
        columns = rows_of([torch.ones(1, 1, dtype=kind)])
        solve_closed_form([weights], columns, np.ones(1), dtype, silent, 1)
