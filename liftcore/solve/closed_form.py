"""The closed form: ``x_j = sum_v W_v[j] E_v / sum W[j]`` (paper Eq. 6, App. Tikhonov for squared weights).

X is never held in float32 as a whole. Splats go in blocks and channels in slices, so that a block of X and a slice
of a view's codebook stay in the cache while all views add to them. Weights are divided by their sum before they meet
the codebook: a mean cannot overflow where its inputs do not, and faint splats keep their digits.

Sums are float32 over a few hundred terms at most. Longer ones, of a splat behind a million regions or of thousands of
views, are sums of such parts: added one by one, ten million equal terms would be wrong in their first digit.
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.jit import kernel, vectorised
from liftcore.lanes import WIDE, add_weighted_row

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from torch import Tensor

    from liftcore.progress import Progress
    from liftcore.solve.view_weights import ViewWeights

LONG = 256  # entries of a row that float32 adds up one by one
VIEWS = 64  # views that add to a block one by one
BLOCK = 4_096  # splats a block; with a slice of channels two megabytes
SLICE = 128  # channels a slice, fewer where the codebooks of all views are long
SLICE_BYTES = 1 << 28  # of a slice of all codebooks, which dense maps would go far beyond
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
def add_weighted_rows(first, last, offset, weights, scale, codebook, block):
    """``block[splats[r] - offset] += W[r] scale[splats[r]] codebook`` for the CSR rows ``first..last``.

    Args:
        weights: (splats [n] i32, row_starts [n + 1] i64, columns [nnz] i32, weights [nnz] f32).
        scale: [P] f64. codebook: [M, C] f32. block: [B, C] f32. C is a multiple of WIDE.
    """
    splats, row_starts, columns, values = weights
    width = codebook.shape[1]
    source, target = codebook.reshape(-1), block.reshape(-1)
    begin = row_starts[first]
    part, total = np.zeros(width, np.float32), np.zeros(width)
    shares = np.empty(row_starts[last] - begin, np.float32)
    own_columns = columns[begin : row_starts[last]]
    for row in range(first, last):
        entries = (row_starts[row] - begin, row_starts[row + 1] - begin)
        for k in range(entries[0], entries[1]):
            shares[k] = values[begin + k] * scale[splats[row]]
        place = (splats[row] - offset) * width
        if entries[1] - entries[0] > LONG:
            total[:] = 0
            for start in range(entries[0], entries[1], LONG):
                chunk = (start, min(start + LONG, entries[1]))
                part[:] = 0
                for channel in range(0, width, WIDE):
                    add_weighted_row(part, channel, source, chunk, (own_columns, shares), (width, channel))
                total += part
            for channel in range(width):
                target[place + channel] += total[channel]
            continue
        for channel in range(0, width, WIDE):
            add_weighted_row(target, place + channel, source, entries, (own_columns, shares), (width, channel))


def sum_views(met: Sequence[tuple], offset: int, scale: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Add the rows of all views to ``block`` [B, C] f32, some views at a time; gives the block.

    Args:
        met: (first, last, weights, codebook) of every view that met the block, as ``add_weighted_rows`` takes them.
        offset: the first splat of the block. scale: [P] f64.
    """
    part = block if len(met) <= VIEWS else np.empty_like(block)
    for start in range(0, len(met), VIEWS):
        if part is not block:
            part[:] = 0
        for first, last, weights, codebook in met[start : start + VIEWS]:
            add_weighted_rows(first, last, offset, weights, scale, codebook, part)
        if part is not block:
            block += part
    return block


@vectorised
def square_norms(block, squares):
    """The squared norms [B] f64 of the rows of ``block`` [B, C] f32."""
    for row in range(block.shape[0]):
        total = np.float32(0.0)
        for c in range(block.shape[1]):
            total += block[row, c] * block[row, c]
        squares[row] = total


def solve_closed_form(
    store: ViewWeights,
    codebooks: Callable[[int], Tensor],
    denominators: np.ndarray,
    dtype: torch.dtype,
    progress: Progress,
    threads: int | None = None,
) -> Solution:
    """Solve for X, slice by slice of channels and block by block of splats.

    Args:
        store: W of every view.
        codebooks: view number -> E_v [M, F] f16 or f32.
        denominators: [P] f64, row sums of W over all views.
        dtype: how X is stored; float16 becomes float32 when the codebooks are too large or too small for it.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    books = [codebooks(view) for view in range(len(store))]
    channels = books[0].shape[1]
    norms = [torch.linalg.vector_norm(book, dim=1, dtype=torch.float64).numpy() for book in books]
    unit = all(bool((np.abs(norm - 1) < UNIT_TOLERANCE).all()) for norm in norms)
    if dtype == torch.float16 and not _fits_float16(books, max(float(norm.max()) for norm in norms)):
        dtype = torch.float32
    count = denominators.shape[0]
    features = torch.zeros(count, channels, dtype=dtype)
    squares = np.zeros(count)
    scale = np.divide(1.0, denominators, out=np.zeros(count), where=denominators > 0)
    step = slice_width(sum(book.shape[0] for book in books))
    slices = [(begin, min(begin + step, channels)) for begin in range(0, channels, step)]
    with ThreadPoolExecutor(threads or len(os.sched_getaffinity(0))) as pool:
        for number, (begin, end) in enumerate(slices):
            parts = [slice_of(book, begin, end) for book in books]
            sums = _solve_slice(pool, store, parts, scale, features[:, begin:end])
            if not unit:
                for part, norm in zip(parts, norms, strict=True):
                    np.divide(part, norm[:, None], out=part, where=norm[:, None] > 0, casting="same_kind")
                sums = _solve_slice(pool, store, parts, scale, None)
            squares += sums
            progress("solve", number + 1, len(slices), "slices")
    agreement = np.sqrt(squares).clip(0.0, 1.0).astype(np.float32)
    return Solution(features, torch.from_numpy(agreement))


def _fits_float16(books: Sequence[Tensor], longest: float) -> bool:
    """Whether float16 holds every value of the codebooks, and the longest of their rows to FLOAT16_ERROR."""
    if any(max(abs(float(end)) for end in torch.aminmax(book)) > FLOAT16_MAX for book in books):
        return False
    return longest == 0 or FLOAT16_STEP * math.sqrt(books[0].shape[1]) <= FLOAT16_ERROR * longest


def slice_width(rows: int) -> int:
    """Channels a slice, a multiple of WIDE, for codebooks of so many rows together."""
    return min(SLICE, max(WIDE, SLICE_BYTES // (4 * rows) // WIDE * WIDE))


def slice_of(book: Tensor, begin: int, end: int) -> np.ndarray:
    """Channels ``begin..end`` of a codebook as [M, C] f32, C padded with zeros to a multiple of WIDE."""
    part = np.zeros((book.shape[0], -(-(end - begin) // WIDE) * WIDE), np.float32)
    part[:, : end - begin] = book[:, begin:end].to(torch.float32).numpy()
    return part


def _solve_slice(
    pool: ThreadPoolExecutor,
    store: ViewWeights,
    parts: Sequence[np.ndarray],
    scale: np.ndarray,
    result: Tensor | None,
) -> np.ndarray:
    """One slice of channels for all splats; written to ``result`` [P, C]. Gives the squared norms [P] f64."""
    count = scale.shape[0]
    squares = np.zeros(count)
    edges = np.arange(0, count + BLOCK, BLOCK)
    views = [
        (view.splats.numpy(), view.row_starts.numpy(), view.columns.numpy(), view.weights.numpy()) for view in store
    ]
    bounds = [np.searchsorted(view[0], edges.astype(view[0].dtype)) for view in views]

    def solve_block(number: int) -> None:
        offset, end = edges[number], min(edges[number + 1], count)
        met = [
            (rows[number], rows[number + 1], weights, part)
            for weights, part, rows in zip(views, parts, bounds, strict=True)
            if rows[number] < rows[number + 1]
        ]
        block = sum_views(met, offset, scale, np.zeros((end - offset, parts[0].shape[1]), np.float32))
        square_norms(block, squares[offset:end])
        if result is not None:
            result[offset:end] = torch.from_numpy(block[:, : result.shape[1]]).to(result.dtype)

    list(pool.map(solve_block, range(len(edges) - 1)))
    return squares
