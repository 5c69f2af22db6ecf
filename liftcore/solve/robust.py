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
where nothing in the scene has a direction nothing changes. A step goes along the curve and over the slices of
channels as the closed form does, and reads each row twice where that reads it once.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from liftcore.jit import kernel, vectorised
from liftcore.one_thread import one_thread
from liftcore.progress import Progress
from liftcore.solve.gathering import LONG, WIDE, EachShare, Gathering, channel_slices, strips_of
from liftcore.solve.host import ALL_CORES, Host
from liftcore.solve.totals import row_totals
from liftcore.solve.view_weights import WeightStore

CHUNK_VALUES = 1 << 20  # of a codebook in float64 at a time
NO_CONSENSUS = 1e-6  # of a splat's weight: a shorter r is what rounding leaves of inputs that cancel
NO_DIRECTION = 1e-6  # a unit vector nearer to the mean than that is the mean


@dataclass(frozen=True)
class Directions:
    """How codebook rows become e: ``e_m = (E_m / lengths_m - mu) / distances_m``, zero where a divisor is."""

    books: Sequence[Tensor]  # E [M, F] a view, f16 or f32
    lengths: tuple[np.ndarray, ...]  # [M] f64 a view
    mean: np.ndarray  # [F] f64, mu
    distances: tuple[np.ndarray, ...]  # [M] f64 a view, |u_m - mu|

    def slice_of(self, view: int, begin: int, end: int) -> Tensor:
        """Channels ``begin..end`` of e of one view, [M, C] f32."""
        book = self.books[view]
        found = np.empty((book.shape[0], end - begin), np.float32)
        for rows in _row_chunks(found):
            unit = _over(book[rows, begin:end].double().numpy(), self.lengths[view][rows])
            found[rows] = _over(unit - self.mean[begin:end], self.distances[view][rows])
        return torch.from_numpy(found)


def directions_of(pool: ThreadPoolExecutor, store: WeightStore, books: Sequence[Tensor]) -> Directions:
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


@one_thread()
def robust_weights(
    store: WeightStore,
    codebooks: Sequence[Tensor],
    denominators: np.ndarray,
    steps: int,
    progress: Progress,
    host: Host = ALL_CORES,
) -> WeightStore:
    """W after so many robust steps: the store itself for none, else new weights on its sparsity.

    Args:
        store: W of every view. It stays as it is; the result shares its columns, so it must stay open.
        codebooks: E_v [M, F] of every view, f16 or f32.
        denominators: [P] f64, row sums of W over all views. They are those of the result too.
        host: what there is to judge with. Neither threads nor means change a bit.
    """
    if steps == 0:
        return store
    current, written = store, [store.blank() for _ in range(min(steps, 2))]
    curve = host.places(codebooks[0].shape[1])
    with host.workers() as (pool, each_share):
        directions = directions_of(pool, store, codebooks)
        for step in range(steps):
            target = written[step % 2]
            squares = _judge((pool, each_share), current, directions, (denominators, curve), target)
            _write(pool, (store, current), target, squares, denominators)
            current = target
            progress("robust", step + 1, steps, "steps")
    return current


def _judge(
    workers: tuple[ThreadPoolExecutor, EachShare],
    current: WeightStore,
    directions: Directions,
    splats: tuple[np.ndarray, np.ndarray | None],
    target: WeightStore,
) -> list[np.ndarray]:
    """``e_m . r_jv`` of every entry into the weights of the target; gives ``|r_jv|^2`` [n] f32 of every view.

    Args:
        splats: the denominators and the places along a curve of each.
    """
    (pool, each_share), (denominators, curve) = workers, splats
    squares = [np.zeros(weights.splats.numel(), np.float32) for weights in current]
    for weights in target:
        weights.weights.zero_()
    counts, total = [book.shape[0] for book in directions.books], sum(book.shape[0] for book in directions.books)
    scale = _over(np.ones(denominators.size), denominators)
    into = [view.weights.numpy() for view in target]
    gathering = Gathering(each_share, current, counts, scale, curve, 0)
    for begin, end in channel_slices(total, directions.mean.size):
        parts = pool.map(lambda view, ends=(begin, end): directions.slice_of(view, *ends), range(len(counts)))
        strips = strips_of(parts, total, end - begin)
        for chunk in gathering:
            products, found = np.zeros((2, len(chunk.shares)), np.float32)
            for strip in strips:
                each_share(partial(judge_rows, *chunk[2:], strip, products, found), 0, len(chunk.order))
            gathering.scatter(chunk, products, found, into, squares)
        del strips  # before others are made
    return squares


@vectorised
def judge_rows(order, indptr, rows, shares, runs, strip, products, squares, first, last):
    """Add ``e_m . r`` of the entries of the rows ``order[first:last]``, and ``|r|^2`` at the first entry of each run.

    A run is the entries of one view in a row; r is the sum of all other runs.

    Args:
        order, indptr, rows, shares, runs: as `Chunk` has them. strip: [M, WIDE] f32, of e.
        products, squares: [nnz] f32, which grow.
    """
    own, others, total = np.empty(WIDE, np.float32), np.empty(WIDE, np.float32), np.empty(WIDE)
    for place in range(first, last):
        begin, end = indptr[order[place]], indptr[order[place] + 1]
        total[:] = 0
        k = begin
        while k < end:
            run_sum(rows, shares, k, k + runs[k], strip, own)
            for c in range(WIDE):
                total[c] += own[c]
            k += runs[k]
        k = begin
        while k < end:
            stop = k + runs[k]
            run_sum(rows, shares, k, stop, strip, own)
            square = np.float32(0)
            for c in range(WIDE):
                others[c] = total[c] - own[c]
                square += others[c] * others[c]
            squares[k] += square
            while k < stop:
                line, product = strip[rows[k]], np.float32(0)
                for c in range(WIDE):
                    product += line[c] * others[c]
                products[k] += product
                k += 1


@vectorised
def run_sum(rows, shares, begin, end, strip, own):
    """``own[c] = sum_k shares[k] strip[rows[k], c]`` [WIDE] f32 of the entries ``begin..end``, by parts of LONG."""
    if end - begin <= LONG:
        part_sum(rows, shares, begin, end, strip, own)
        return
    total = np.zeros(WIDE)
    for first in range(begin, end, LONG):
        part_sum(rows, shares, first, min(first + LONG, end), strip, own)
        for c in range(WIDE):
            total[c] += own[c]
    for c in range(WIDE):
        own[c] = total[c]


@vectorised
def part_sum(rows, shares, begin, end, strip, own):
    """``run_sum`` in float32, one by one."""
    own[:] = 0
    for k in range(begin, end):
        line, share = strip[rows[k]], shares[k]
        for c in range(WIDE):
            own[c] += share * line[c]


def _write(
    pool: ThreadPoolExecutor,
    sources: tuple[WeightStore, WeightStore],
    target: WeightStore,
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
    starts, splats = ([getattr(view, name).numpy() for view in target] for name in ("indptr", "splats"))
    before, values = ([view.weights.numpy() for view in store] for store in (first, target))

    def find(view: int) -> tuple[float, float]:
        return to_cosines(starts[view], squares[view], NO_CONSENSUS, before[view], values[view])

    agreeing, everything = np.sum(list(pool.map(find, views)), axis=0)
    usual = agreeing / (everything or 1.0)

    def weigh(view: int) -> np.ndarray:
        shares = row_totals(current[view]) * scale[splats[view]]
        return to_weights(starts[view], shares, usual, before[view], values[view])

    totals = np.zeros(denominators.size)
    for own, added in zip(splats, pool.map(weigh, views), strict=True):
        totals[own] += added
    gain = _over(denominators, totals)

    def scale_back(view: int) -> None:
        to_old_sums(starts[view], gain[splats[view]], before[view], values[view])

    list(pool.map(scale_back, views))


def _row_chunks(book: Tensor | np.ndarray) -> Iterator[slice]:
    """The rows of a codebook, a few megabytes at a time: dense maps have a row a pixel."""
    step = max(CHUNK_VALUES // book.shape[1], 1)
    for begin in range(0, book.shape[0], step):
        yield slice(begin, min(begin + step, book.shape[0]))


def _over(values: np.ndarray, divisors: np.ndarray) -> np.ndarray:
    """Rows divided by their divisors; zero where the divisor is."""
    columns = divisors.reshape(divisors.shape + (1,) * (values.ndim - 1))
    return np.divide(values, columns, out=np.zeros_like(values), where=columns > 0)


@kernel
def to_cosines(indptr, squares, least, weights, products):
    """Products of a view become the cosines c; gives ``(W . c, sum of W)``.

    Args:
        indptr: [n + 1] i64. squares: [n] f32. least: of a length that has a direction.
        weights: [nnz] f32. products: [nnz] f32, changed.
    """
    agreeing, everything = 0.0, 0.0
    for row in range(squares.shape[0]):
        length = np.sqrt(np.float64(squares[row]))
        for k in range(indptr[row], indptr[row + 1]):
            cosine = min(max(products[k] / length, 0.0), 1.0) if length > least else 0.0
            products[k] = cosine
            agreeing += weights[k] * cosine
            everything += weights[k]
    return agreeing, everything


@kernel
def to_weights(indptr, shares, usual, weights, cosines):
    """Cosines of a view become ``W ((1 - p) c_m + p c)``; gives their row sums [n] f64.

    Args:
        indptr: [n + 1] i64. shares: [n] f64, p. usual: c.
        weights: [nnz] f32, W. cosines: [nnz] f32, changed.
    """
    totals = np.zeros(shares.shape[0])
    for row in range(shares.shape[0]):
        own = min(max(shares[row], 0.0), 1.0)
        for k in range(indptr[row], indptr[row + 1]):
            cosines[k] = weights[k] * ((1.0 - own) * cosines[k] + own * usual)
            totals[row] += cosines[k]
    return totals


@kernel
def to_old_sums(indptr, gains, first, weights):
    """Weights of a view times the gain [n] f64 of their row; where that is zero, the first ones again."""
    for row in range(gains.shape[0]):
        for k in range(indptr[row], indptr[row + 1]):
            weights[k] = weights[k] * gains[row] if gains[row] > 0 else first[k]
