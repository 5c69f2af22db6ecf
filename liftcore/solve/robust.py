"""The robust step on W: each region keeps as much of its weight at a splat as the other views agree with it.

With u_m the unit vector of region m, ``mu = sum W u / sum W`` the scene's mean over all splats and views, and
``e_m = (u_m - mu) / |u_m - mu|``, the weight of region m of view v at splat j becomes::

    W'_jm = s_j W_jm ((1 - p_jv) c_jm + p_jv c),     c_jm = max(0, cos(e_m, r_jv))
    r_jv = sum of W_jn e_n over the regions n of all other views,     c = sum W c_jm / sum W over the scene

``p_jv`` is the share of view v in the weight of splat j, and ``s_j`` gives the splat its old sum of weights back, so
denominators, ``seen`` and evidence stay what they were. A further step takes r and p from the weights of the step
before, and starts from the first W again. Nothing is tuned; each part has its reason:

- **The other views judge, never the region itself.** A region's vector is noisy, and the noise of a heavy region
  leans the splat's mean towards itself. Judged by that mean it is rewarded for its own noise, most where few regions
  meet: that, not its bandwidth, is how reweighting by the distance to x_j lost on masks. Regions of one view are left
  out together, for levels and neighbouring cells share their errors.
- **Its own view agrees, with its share.** Without ``p c`` a minority of agreeing views outvotes a view that holds
  most of the weight, and splats that one view sees well turn into what leaks to them in the others. Its own
  agreement counts as what is usual in the scene, c, for the measured one would be the noise again.
- **Centred on the scene's mean**, as the vectors of CLIP lie in one narrow cone: raw cosines are all alike.
- **The cosine itself is the weight.** If ``e_m = a_m x + noise``, the cosine estimates a_m up to a factor, and
  weights in proportion to the signal give the least noise. There is no bandwidth; a region merged of two things
  keeps part of its weight, and one that points away from the others loses it.

A splat of one view does not change. A region without direction (a zero vector, or the mean itself) has c_jm = 0, and
where nothing in the scene has a direction nothing changes. A step goes over blocks of splats as the file
has them and the slices of channels of the closed form, and does some three times its work.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.jit import kernel, vectorised
from liftcore.lanes import WIDE
from liftcore.solve.accumulate import row_totals
from liftcore.solve.weight_tables import WeightTables, addresses_of, floats_at, rows_between, table_at
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
    from collections.abc import Iterator, Sequence

    from torch import Tensor

    from liftcore.progress import Progress
    from liftcore.raster.protocol import RegionWeights
    from liftcore.solve.view_weights import ViewWeights

CHUNK_VALUES = 1 << 20  # of a codebook in float64 at a time
NO_CONSENSUS = 1e-6  # of a splat's weight: a shorter r is what rounding leaves of inputs that cancel
NO_DIRECTION = 1e-6  # a unit vector nearer to the mean than that is the mean


@vectorised
def judge_rows(rows, weights, scale, codebook, block, agreement, squares):
    """Add to ``e_m . r`` of the entries and to ``|r|^2`` of some CSR rows, over these channels.

    Args:
        rows: (first, last, offset): the CSR rows ``first..last``, and the splat that the block starts with.
        weights: (splats [n] i32, row_starts [n + 1] i64, columns [nnz] i32, weights [nnz] f32).
        scale: [P] f64. codebook: [M, C] f32, of e. block: [B, C] f32, the sums over all views.
        agreement: [nnz] f32. squares: [n] f32.
    """
    first, last, offset = rows
    splats, row_starts, columns, values = weights
    width = codebook.shape[1]
    others = np.empty(width, np.float32)
    for row in range(first, last):
        splat = splats[row]
        others[:] = block[splat - offset]
        for k in range(row_starts[row], row_starts[row + 1]):
            share = np.float32(values[k] * scale[splat])
            own = codebook[columns[k]]
            for c in range(width):
                others[c] -= share * own[c]
        square = np.float32(0.0)
        for c in range(width):
            square += others[c] * others[c]
        squares[row] += square
        for k in range(row_starts[row], row_starts[row + 1]):
            own = codebook[columns[k]]
            product = np.float32(0.0)
            for c in range(width):
                product += own[c] * others[c]
            agreement[k] += product


@kernel
def judge_share(splats, tables, strips, sums, scale):
    """``judge_rows`` of a share of splats for all views, block by block over the channels of the strips.

    Args:
        splats: (first, last). tables: (addresses, rows) of WeightTables. strips: Strips, of e.
        sums: [V, 2] i64, where agreement [nnz] f32 and squares [n] f32 of each view lie. scale: [P] f64.
    """
    addresses, rows = tables
    starts, most = entries_before(splats, tables), most_entries(strips.rows)
    pieces = strips.values.reshape(strips.number, strips.rows, WIDE)
    first = 0
    while first < starts.shape[0] - 1:
        last = block_end(starts, first, most)
        block = (splats[0] + first, splats[0] + last)
        entries = block_entries(block, starts[first : last + 1], tables, strips.bases, scale)
        means = np.empty((last - first, WIDE), np.float32)
        for strip in range(strips.number):
            sum_strip(entries, strips, strip, means)
            for view in range(addresses.shape[0]):
                weights = table_at(addresses[view], rows[view])
                own = rows_between(weights[0], block)
                if own[0] < own[1]:
                    book = pieces[strip, strips.bases[view] :]
                    agreement = floats_at(sums[view, 0], weights[2].shape[0])
                    squares = floats_at(sums[view, 1], weights[0].shape[0])
                    judge_rows((own[0], own[1], block[0]), weights, scale, book, means, agreement, squares)
        first = last


@dataclass(frozen=True)
class Directions:
    """How codebook rows become e: ``e_m = (E_m / lengths_m - mu) / distances_m``, zero where a divisor is."""

    books: Sequence[Tensor]  # E [M, F] a view, f16 or f32
    lengths: tuple[np.ndarray, ...]  # [M] f64 a view
    mean: np.ndarray  # [F] f64, mu
    distances: tuple[np.ndarray, ...]  # [M] f64 a view, |u_m - mu|

    def slice_of(self, view: int, begin: int, end: int) -> Tensor:
        """Channels ``begin..end`` of e of one view, [M, C] f32."""
        part = self.books[view][:, begin:end].double().numpy()
        unit = _over(part, self.lengths[view])
        return torch.from_numpy(_over(unit - self.mean[begin:end], self.distances[view])).float()


def directions_of(pool: ThreadPoolExecutor, store: ViewWeights, books: Sequence[Tensor]) -> Directions:
    """The scene's mean of unit vectors, each weighted by its column sum of W, and what divides the rows."""

    def measure(view: int) -> tuple[np.ndarray, np.ndarray, float]:
        weights, book = store[view], books[view]
        totals = np.bincount(weights.columns.numpy(), weights.weights.numpy(), minlength=book.shape[0])
        lengths, mean = np.zeros(book.shape[0]), np.zeros(book.shape[1])
        for rows in _row_chunks(book):
            part = book[rows].double().numpy()
            lengths[rows] = np.linalg.norm(part, axis=1)
            mean += totals[rows] @ _over(part, lengths[rows])
        return lengths, mean, float(totals[lengths > 0].sum())

    measured = list(pool.map(measure, range(len(store))))
    lengths = tuple(part[0] for part in measured)
    mean = np.sum([part[1] for part in measured], axis=0) / (sum(part[2] for part in measured) or 1.0)

    def distance(view: int) -> np.ndarray:
        book, distances = books[view], np.zeros(books[view].shape[0])
        for rows in _row_chunks(book):
            unit = _over(book[rows].double().numpy(), lengths[view][rows])
            distances[rows] = np.linalg.norm(unit - mean, axis=1)
        return np.where((distances > NO_DIRECTION) & (lengths[view] > 0), distances, 0.0)

    return Directions(books, lengths, mean, tuple(pool.map(distance, range(len(store)))))


def robust_weights(
    store: ViewWeights,
    codebooks: Sequence[Tensor],
    denominators: np.ndarray,
    steps: int,
    progress: Progress,
    threads: int | None = None,
) -> ViewWeights:
    """W after so many robust steps: the store itself for none, else new weights on its sparsity.

    Args:
        store: W of every view. It stays as it is; the result shares its columns, so it must stay open.
        codebooks: E_v [M, F] of every view, f16 or f32.
        denominators: [P] f64, row sums of W over all views. They are those of the result too.
        threads: None takes the cores that this process may use. The number changes no bit.
    """
    if steps == 0:
        return store
    current, written = store, [store.blank() for _ in range(min(steps, 2))]
    with ThreadPoolExecutor(threads or len(os.sched_getaffinity(0))) as pool:
        directions = directions_of(pool, store, codebooks)
        for step in range(steps):
            target = written[step % 2]
            squares = _judge(pool, current, directions, denominators, target)
            _write(pool, (store, current), target, squares, denominators)
            current = target
            progress("robust", step + 1, steps, "steps")
    return current


def _judge(
    pool: ThreadPoolExecutor,
    current: ViewWeights,
    directions: Directions,
    denominators: np.ndarray,
    target: ViewWeights,
) -> list[np.ndarray]:
    """``e_m . r_jv`` of every entry into the weights of the target; gives ``|r_jv|^2`` [n] f32 of every view."""
    squares = [np.zeros(weights.splats.numel(), np.float32) for weights in current]
    for weights in target:
        weights.weights.zero_()
    counts = [book.shape[0] for book in directions.books]
    scale, weights = _over(np.ones(denominators.size), denominators), WeightTables(current)
    tables, shares = (weights.addresses, weights.rows), splat_shares(0, denominators.size, 1)
    sums = addresses_of([(view.weights.numpy(), square) for view, square in zip(target, squares, strict=True)])
    for begin, end in channel_slices(sum(counts), directions.mean.size, 4):
        parts = pool.map(lambda view, ends=(begin, end): directions.slice_of(view, *ends), range(len(counts)))
        own = strips_of(parts, counts, end - begin, torch.float32)
        list(pool.map(lambda share, own=own: judge_share(share, tables, own, sums, scale), shares))
        del own  # before others are made
    return squares


def _write(
    pool: ThreadPoolExecutor,
    sources: tuple[ViewWeights, ViewWeights],
    target: ViewWeights,
    squares: Sequence[np.ndarray],
    denominators: np.ndarray,
) -> None:
    """The target's products ``e_m . r_jv`` become its weights.

    Args:
        sources: W to start from, and the W that the products were made with.
        squares: ``|r_jv|^2`` [n] f32 of every view.
    """
    first, current = sources
    scale, views = _over(np.ones(denominators.size), denominators), range(len(target))

    def to_cosines(view: int) -> np.ndarray:
        lengths = np.sqrt(squares[view].astype(np.float64))
        lengths[lengths <= NO_CONSENSUS] = 0
        values, weights = target[view].weights.numpy(), first[view].weights.numpy()
        values[:] = _over(values.astype(np.float64), _by_entry(target[view], lengths)).clip(0.0, 1.0)
        return np.array([np.dot(weights.astype(np.float64), values), weights.sum(dtype=np.float64)])

    agreeing, everything = np.sum(list(pool.map(to_cosines, views)), axis=0)
    usual = agreeing / (everything or 1.0)

    def to_weights(view: int) -> np.ndarray:
        share = (row_totals(current[view]) * scale[target[view].splats.numpy()]).clip(0.0, 1.0)
        values = target[view].weights.numpy()
        agreement = _by_entry(target[view], 1.0 - share) * values + _by_entry(target[view], share * usual)
        values[:] = first[view].weights.numpy() * agreement
        return row_totals(target[view])

    totals = np.zeros(denominators.size)
    for weights, added in zip(target, pool.map(to_weights, views), strict=True):
        totals[weights.splats.numpy()] += added
    gain = _over(denominators, totals)

    def to_old_sums(view: int) -> None:
        gains = _by_entry(target[view], gain[target[view].splats.numpy()])
        values = target[view].weights.numpy()
        values[:] = np.where(gains > 0, values * gains, first[view].weights.numpy())

    list(pool.map(to_old_sums, views))


def _by_entry(weights: RegionWeights, rows: np.ndarray) -> np.ndarray:
    """The value of its row [n] for each entry [nnz]."""
    return np.repeat(rows, np.diff(weights.row_starts.numpy()))


def _row_chunks(book: Tensor) -> Iterator[slice]:
    """The rows of a codebook, a few megabytes at a time: dense maps have a row a pixel."""
    step = max(CHUNK_VALUES // book.shape[1], 1)
    for begin in range(0, book.shape[0], step):
        yield slice(begin, min(begin + step, book.shape[0]))


def _over(values: np.ndarray, divisors: np.ndarray) -> np.ndarray:
    """Rows divided by their divisors; zero where the divisor is."""
    columns = divisors.reshape(divisors.shape + (1,) * (values.ndim - 1))
    return np.divide(values, columns, out=np.zeros_like(values), where=columns > 0)
