"""Features that know their neighbours: Tikhonov's regularisation, carried from each splat to the scene.

After the closed form, X0, with evidence D, confidence c and affinities a_jk (`liftcore.scene.neighbours`)::

    min over X of  sum_j w_j |x_j - x0_j|^2  +  lambda sum_jk a_jk sqrt(w_j w_k) |x_j - x_k|^2,   each pair once
    w_j = D_j max(c_j, 0.02)

Conjugate gradients from X0 on, with the diagonal as preconditioner, in blocks of channels: float32 with sums in
float64. A channel stops by itself, and every sum has a fixed order, so that neither the number of threads nor the
size of a block changes a bit. The solution is a mean of X0's rows, so no channel of it leaves the range of X0's; nor
does what is delivered.

A splat without evidence has no term of its own. It takes the limit of the solution for w_j towards zero, the mean of
its neighbours by ``a_jk sqrt(w_k)``, and those behind it the mean of these, ring by ring.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.runtime.jit import kernel
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, silent
from liftcore.scene.neighbours import SplatGraph
from liftcore.scene.splats import Splats

LEAST_CONFIDENCE = 0.02  # that a splat counts by: one view alone says something, too
LEAST_WEIGHT = 1e-30  # of the largest; a splat below it has no evidence
BLOCK = 32  # channels solved at a time: four [P, 32] f32
ROWS = 1 << 13  # splats of one piece of work
TOLERANCE = 1e-3  # of each channel's gradient, relative to that at X0, over sqrt(1 + lambda): what varies slowly
# over the scene has little of the gradient, the less the larger lambda
ROUGHLY = 2e-2  # a tolerance by which features are compared, not delivered
STEPS = 200  # of conjugate gradients at most; with lambda 4 about 20 are enough


@dataclass(frozen=True)
class _System:
    """The matrix of the minimum, ``diag(w) + lambda L``, with rows in the graph's order."""

    graph: SplatGraph
    weights: np.ndarray  # [P] f32, w over its largest value; zero without evidence
    couplings: np.ndarray  # [E] f32, lambda a_jk sqrt(w_j w_k)
    inverse: np.ndarray  # [P] f32, of the diagonal; zero without evidence
    tolerance: float  # of the gradient, relative to that at X0

    @classmethod
    def of(cls, graph: SplatGraph, weights: np.ndarray, smoothness: float, tolerance: float = TOLERANCE) -> _System:
        """Of weights [P] f64 in the graph's order, at most one."""
        roots, counts = np.sqrt(weights), np.diff(graph.starts)
        couplings = (smoothness * graph.affinities * np.repeat(roots, counts) * roots[graph.neighbours]).astype(
            np.float32
        )
        rows = np.repeat(np.arange(len(weights), dtype=np.int32), counts)
        diagonal = weights + np.bincount(rows, couplings, minlength=len(weights))
        inverse = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=weights > 0)
        relative = tolerance / (1.0 + smoothness) ** 0.5
        return cls(graph, weights.astype(np.float32), couplings, inverse.astype(np.float32), relative)


@one_thread()
def smooth(
    X: Tensor,
    graph: SplatGraph,
    evidence: Tensor,
    confidence: Tensor | None,
    seen: Tensor,
    smoothness: float,
    progress: Progress = silent,
    threads: int | None = None,
    *,
    block: int = BLOCK,
) -> tuple[Tensor, dict[str, Any]]:
    """Draw the features of splats that are near in place and colour together.

    Args:
        X: [P, F] f16 or f32 on the CPU, changed in place.
        graph: of the P splats that were lifted.
        evidence: [P] f32, sums of plain weights. confidence: [P] f32; None counts as one everywhere.
        seen: [P] bool, the splats whose row of X was solved for; the others take their neighbours' features.
        smoothness: lambda; zero leaves X as it is.
        threads: None takes the cores that this process may use. The number changes no bit.
        block: channels solved at a time; the number changes no bit.

    Returns:
        X, and its facts for the diagnostics: ``smoothness``, the ``steps`` of the slowest channel, its ``residual``
        (the preconditioned gradient's length over that at X0), ``moved`` (the root of
        ``sum_j w_j |x_j - x0_j|^2 / sum_j w_j |x0_j|^2``), ``filled``, the splats without evidence that took a
        feature, and whether ``colours`` counted.
    """
    weights = smoothing_weights(torch.where(seen, evidence, 0.0), confidence)[graph.order]
    rings = _rings(graph, weights) if smoothness else []
    system = _System.of(graph, weights, smoothness)
    has_evidence, has_feature = weights > 0, weights > 0
    for rows, _ in rings:
        has_feature[rows] = True
    order, (count, channels) = torch.from_numpy(graph.order).long(), X.shape
    squares, steps, residual = np.zeros((2, channels)), 0, 0.0
    with ThreadPoolExecutor(threads or len(os.sched_getaffinity(0))) as pool:
        for begin in range(0, channels if smoothness and has_evidence.any() else 0, block):
            columns = X[:, begin : begin + block]
            values = np.empty(columns.shape, np.float32)

            def read(rows: slice, columns: Tensor = columns, values: np.ndarray = values) -> tuple[Any, Any]:
                """Take rows of X in the graph's order; their least and greatest value in each channel."""
                own, part = has_evidence[rows], values[rows]
                part[:] = columns.index_select(0, order[rows]).float().numpy()
                part[~own] = 0.0
                supported = part[own]
                return supported.min(axis=0, initial=np.inf), supported.max(axis=0, initial=-np.inf)

            lows, highs = zip(*_map_rows(read, count, pool), strict=True)
            low, high = np.min(lows, axis=0), np.max(highs, axis=0)
            solution, taken, gradient = _solve(system, values, pool)
            steps, residual = max(steps, taken), max(residual, gradient)

            def clip(
                rows: slice, low: np.ndarray = low, high: np.ndarray = high, values: np.ndarray = solution
            ) -> None:
                np.clip(values[rows], low, high, out=values[rows])

            _map_rows(clip, count, pool)
            squares[:, begin : begin + block] = _movement(system.weights, values, solution, pool)
            for rows, shares in rings:
                solution[rows] = shares @ solution

            def write(rows: slice, columns: Tensor = columns, values: np.ndarray = solution) -> None:
                """Put rows into their places in X."""
                own = has_feature[rows]
                columns.index_copy_(
                    0, order[rows][torch.from_numpy(own)], torch.from_numpy(values[rows][own]).to(X.dtype)
                )

            _map_rows(write, count, pool)
            progress("smooth", min(begin + block, channels), channels, "channels")
    moved, whole = squares.sum(axis=1).tolist()
    facts: dict[str, Any] = {
        "smoothness": smoothness,
        "steps": steps,
        "residual": residual,
        "moved": float(np.sqrt(moved / whole)) if whole > 0 and np.isfinite(whole) else None,
        "filled": sum(len(rows) for rows, _ in rings),
        "colours": graph.coloured,
    }
    if residual > system.tolerance:
        facts["warning"] = (
            f"smoothness={smoothness:g} ended after {steps} steps with {residual:.1g} of the gradient left: features "
            "are less smooth than asked for"
        )
    return X, facts


def smooth_channels(
    graph: SplatGraph, values: np.ndarray, weights: np.ndarray, smoothness: float, pool: Executor
) -> np.ndarray:
    """Smooth features [P, C] f32 with weights [P] f64 up to one, in the graph's order, as well as comparisons need.

    Splats without evidence come back as zeros.
    """
    known = np.where(weights[:, None] > 0, values, np.float32(0.0))
    return _solve(_System.of(graph, weights, smoothness, ROUGHLY), known, pool)[0]


def warm_up_smoothing() -> None:
    """Compile the kernels, or load them from the disk cache."""
    graph = SplatGraph.of(Splats(torch.eye(3), torch.zeros(3, 4), torch.zeros(3, 3), torch.zeros(3)), 1)
    ones = torch.ones(3)
    smooth(torch.eye(3), graph, ones, None, ones > 0, 1.0, threads=1)


def smoothing_weights(evidence: Tensor, confidence: Tensor | None) -> np.ndarray:
    """[P] f64, w over its largest value: zero where a splat has no evidence."""
    weights = evidence.double()
    if confidence is not None:
        weights *= confidence.double().clamp_min(LEAST_CONFIDENCE)
    values = weights.nan_to_num(0.0).numpy()
    most = float(values.max(initial=0.0))
    values = values / most if most > 0 else values
    return np.where(values >= LEAST_WEIGHT, values, 0.0)


def _rings(graph: SplatGraph, weights: np.ndarray) -> list[tuple[np.ndarray, Any]]:
    """Rows without evidence, ring by ring from those that have some, with what they take of rows that have a feature.

    Args:
        weights: [P] f64, in the graph's order.

    Returns:
        For each ring its rows [n] and shares [n, P], sparse f32, whose rows sum to one.
    """
    from scipy.sparse import csr_array

    count, left = len(weights), np.flatnonzero(weights == 0)
    if not 0 < left.size < count:
        return []
    affinities = csr_array((graph.affinities, graph.neighbours, graph.starts), shape=(count, count))[left]
    roots, rings = np.sqrt(weights), list[tuple[np.ndarray, Any]]()
    while left.size:
        shares = csr_array(affinities.multiply(roots[None]))
        shares.eliminate_zeros()
        sums = np.asarray(shares.sum(axis=1), np.float64)
        ring = np.flatnonzero(sums > 0)
        if not ring.size:
            break
        shares = csr_array(shares[ring].multiply(1.0 / sums[ring][:, None])).astype(np.float32)
        rings.append((left[ring], shares))
        roots = np.zeros_like(roots)  # rows of the next ring have no neighbour in those before this one
        roots[left[ring]] = 1.0
        rest = np.delete(np.arange(left.size), ring)
        left, affinities = left[rest], affinities[rest]
    return rings


def _solve(system: _System, start: np.ndarray, pool: Executor) -> tuple[np.ndarray, int, float]:
    """The minimum [P, C] f32 from X0 [P, C] f32 on, the steps taken, and the largest relative gradient left."""
    graph, (count, channels) = system.graph, start.shape
    X, rest, direction = start.copy(), np.zeros_like(start), start.copy()
    image = np.empty_like(start)

    def run(work: Callable[..., Any], *arguments: Any) -> np.ndarray:
        return _row_sums(work, arguments, (channels,), count, pool)

    def multiply(weights: np.ndarray) -> np.ndarray:
        return run(multiply_rows, graph.starts, graph.neighbours, system.couplings, weights, direction, image)

    multiply(np.zeros_like(system.weights))  # lambda L X0, the gradient at X0
    ones, zeros = np.ones(channels, np.float32), np.zeros(channels, np.float32)
    slope = run(advance_rows, system.inverse, ones, direction, image, zeros, X, rest)
    first, active, steps = slope.copy(), np.isfinite(slope) & (slope > 0), 0
    run(turn_rows, system.inverse, zeros, rest, direction)
    while active.any() and steps < STEPS:
        curvature = multiply(system.weights)
        active &= np.isfinite(curvature) & (curvature > 0)
        length = np.divide(slope, curvature, out=np.zeros(channels), where=active).astype(np.float32)
        new = run(advance_rows, system.inverse, length, direction, image, length, X, rest)
        turn = np.divide(new, slope, out=np.zeros(channels), where=active).astype(np.float32)
        slope, steps = new, steps + 1
        active &= slope > system.tolerance**2 * first
        run(turn_rows, system.inverse, turn, rest, direction)
    left = np.divide(slope, first, out=np.zeros(channels), where=np.isfinite(first) & (first > 0))
    return X, steps, float(np.sqrt(left.max(initial=0.0)))


@kernel
def multiply_rows(first, last, starts, neighbours, couplings, weights, direction, image, dots):
    """Write ``(diag(w) + lambda L) P`` of rows first..last; add the columns' ``p^T K p`` to dots [C] f64."""
    channels = direction.shape[1]
    for j in range(first, last):
        for c in range(channels):
            image[j, c] = weights[j] * direction[j, c]
        for n in range(starts[j], starts[j + 1]):
            coupling, k = couplings[n], neighbours[n]
            for c in range(channels):
                image[j, c] += coupling * (direction[j, c] - direction[k, c])
        for c in range(channels):
            dots[c] += np.float64(direction[j, c]) * image[j, c]


@kernel
def advance_rows(first, last, inverse, fall, direction, image, length, X, rest, dots):
    """Take a step of rows first..last, ``X += length P``, ``R -= fall K P``; add ``r^T M^-1 r`` to dots [C] f64."""
    for j in range(first, last):
        for c in range(X.shape[1]):
            X[j, c] += length[c] * direction[j, c]
            left = rest[j, c] - fall[c] * image[j, c]
            rest[j, c] = left
            dots[c] += np.float64(left) * left * inverse[j]


@kernel
def turn_rows(first, last, inverse, turn, rest, direction, dots):
    """Write the next direction of rows first..last, ``P = M^-1 R + turn P``."""
    for j in range(first, last):
        for c in range(direction.shape[1]):
            direction[j, c] = inverse[j] * rest[j, c] + turn[c] * direction[j, c]


def _movement(weights: np.ndarray, before: np.ndarray, after: np.ndarray, pool: Executor) -> np.ndarray:
    """[2, C] f64: ``sum_j w_j (x_j - x0_j)^2`` and ``sum_j w_j x0_j^2`` of each channel."""
    return _row_sums(add_movement, (weights, before, after), (2, before.shape[1]), len(before), pool)


def _map_rows(work: Callable[[slice], Any], count: int, pool: Executor) -> list[Any]:
    """What ``work`` returns for each piece of ``count`` rows, in their order."""
    return list(pool.map(work, (slice(first, min(first + ROWS, count)) for first in range(0, count, ROWS))))


def _row_sums(
    work: Callable[..., Any], arguments: tuple[Any, ...], shape: tuple[int, ...], count: int, pool: Executor
) -> np.ndarray:
    """What ``work(first, last, *arguments, sums)`` adds up over pieces of ``count`` rows: f64 of the shape."""

    def add(rows: slice) -> np.ndarray:
        part = np.zeros(shape)
        work(rows.start, rows.stop, *arguments, part)
        return part

    total = np.zeros(shape)
    for part in _map_rows(add, count, pool):
        total += part
    return total


@kernel
def add_movement(first, last, weights, before, after, sums):
    """Add what rows first..last moved, and what they were, to sums [2, C] f64."""
    for j in range(first, last):
        for c in range(before.shape[1]):
            value = np.float64(before[j, c])
            apart = after[j, c] - value
            sums[0, c] += weights[j] * apart * apart
            sums[1, c] += weights[j] * value * value
