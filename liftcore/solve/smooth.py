"""Smooth features: Tikhonov regularisation over the graph of neighbouring splats.

From the closed form X0, with total weight D, confidence c and affinities a_jk (`liftcore.scene.neighbours`)::

    min over X of  sum_j w_j |x_j - x0_j|^2  +  lambda sum_jk a_jk sqrt(w_j w_k) |x_j - x_k|^2,   each pair once
    w_j = D_j max(c_j, 0.02)

Solved by conjugate gradients from X0, with the diagonal as preconditioner, in float32 with sums in float64. All
channels have the same matrix, so they use the same steps: those of PROBES random sums of channels, in which every
channel is represented by its energy. In the form of Stiefel (1958) a step needs only the last two iterates,

    x <- x + alpha M^-1 (b - K x) + beta (x - x_before),

and with alpha and beta given it is one pass over the graph, by blocks of channels, without a sum over the scene.
Every sum has a fixed order: the result is bitwise identical for any number of threads. The solution is a mean of X0's
rows, so each channel stays in the range of X0; the result is clipped to it.

A splat without total weight keeps its row of zeros: it has no feature, and no question reads one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.raster.cpu.simd import (
    LANES,
    in_all_lanes,
    lanes_at,
    minus,
    plus,
    plus_product,
    plus_times,
    store_lanes,
    times,
)
from liftcore.runtime.cores import cores
from liftcore.runtime.jit import kernel
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, silent
from liftcore.scene.neighbours import SplatGraph
from liftcore.solve import shared_rows as wide

LEAST_CONFIDENCE = 0.02  # lower bound of c, for splats of a single view
LEAST_WEIGHT = 1e-30  # of the largest; a splat below it has no total weight
BLOCK = 2 * wide.LANES  # channels solved at a time: three [P, 64] f32
ROWS = 1 << 13  # splats per task
PROBES = LANES  # random sums of all channels, whose steps are used
# Of the gradient, relative to that at X0, over sqrt(1 + lambda): components that vary slowly over the scene have a
# small share of the gradient, smaller for larger lambda.
TOLERANCE = 2e-3
STEPS = 200  # of conjugate gradients at most; about 20 are enough for lambda 4

Step = tuple[np.float32, np.float32]  # alpha and beta


@dataclass(frozen=True)
class _System:
    """The matrix ``diag(w) + lambda L``, with rows in the graph's order."""

    graph: SplatGraph
    weights: np.ndarray  # [P] f32, w over its largest value; zero without total weight
    couplings: np.ndarray  # [E] f32, lambda a_jk sqrt(w_j w_k)
    diagonal: np.ndarray  # [P] f32, w plus the sum of a row's couplings
    inverse: np.ndarray  # [P] f32, of the diagonal; zero without total weight
    tolerance: float  # of the gradient, relative to that at X0

    @classmethod
    def of(cls, graph: SplatGraph, weights: np.ndarray, smoothness: float) -> _System:
        """Build from weights [P] f64 in the graph's order, at most one."""
        roots, counts = np.sqrt(weights), np.diff(graph.starts)
        couplings = (smoothness * graph.affinities * np.repeat(roots, counts) * roots[graph.neighbours]).astype(
            np.float32
        )
        rows = np.repeat(np.arange(len(weights), dtype=np.int32), counts)
        diagonal = weights + np.bincount(rows, couplings, minlength=len(weights))
        inverse = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=weights > 0)
        relative = TOLERANCE / (1.0 + smoothness) ** 0.5
        diagonal, inverse = diagonal.astype(np.float32), inverse.astype(np.float32)
        return cls(graph, weights.astype(np.float32), couplings, diagonal, inverse, relative)


@one_thread()
def smooth(
    X: Tensor,
    graph: SplatGraph,
    total_weight: Tensor,
    confidence: Tensor | None,
    solved: Tensor,
    smoothness: float,
    progress: Progress = silent,
    threads: int | None = None,
) -> tuple[Tensor, dict[str, Any]]:
    """Smooth the features of splats that are near in position and colour.

    Args:
        X: [P, F] f16 or f32 on the CPU, changed in place.
        graph: of the P lifted splats.
        total_weight: [P] f32, sums of unscaled weights. confidence: [P] f32; None: one everywhere.
        solved: [P] bool, the splats with a row of X from the solve; the others keep theirs.
        smoothness: lambda; zero does not change X.

    Returns:
        X, and its facts for the diagnostics: ``smoothness``, the ``steps``, the ``residual`` (the preconditioned
        gradient's length over that at X0, of the probes), ``moved`` (the root of
        ``sum_j w_j |x_j - x0_j|^2 / sum_j w_j |x0_j|^2``), and ``colours``, True if the graph uses colours.
    """
    weights = smoothing_weights(torch.where(solved, total_weight, 0.0), confidence)[graph.order]
    system = _System.of(graph, weights, smoothness)
    has_weight = weights > 0
    count, channels = X.shape
    squares, steps, residual = np.zeros((2, channels)), list[Step](), 0.0
    with ThreadPoolExecutor(threads or cores()) as pool:
        if smoothness and has_weight.any():
            steps, residual = _conjugate_gradients(system, _probe(X, graph.order, has_weight, pool), pool)
            values, *iterates = (np.zeros((count, BLOCK), np.float32) for _ in range(3))
            for begin in range(0, channels, BLOCK):
                part = X[:, begin : begin + BLOCK]
                width = part.shape[1]

                def read(rows: slice, part: Tensor = part, width: int = width) -> tuple[np.ndarray, np.ndarray]:
                    """Copy rows of X in the graph's order; return the minimum and maximum of each channel."""
                    values[rows, :width] = part.index_select(0, torch.from_numpy(graph.order[rows])).float().numpy()
                    low, high = np.full(width, np.inf, np.float32), np.full(width, -np.inf, np.float32)
                    bound_rows(rows.start, rows.stop, has_weight, values, low, high)
                    for iterate in iterates:
                        iterate[rows] = values[rows]
                    return low, high

                lows, highs = zip(*_map_rows(read, count, pool), strict=True)
                low, high = np.min(lows, axis=0), np.max(highs, axis=0)
                solution = _descend(system, values, iterates, steps, pool)
                arguments = system.weights, values, low, high, solution
                squares[:, begin : begin + width] = _row_sums(clip_rows, arguments, (2, width), count, pool)

                def write(rows: slice, part: Tensor = part, solution: np.ndarray = solution) -> None:
                    """Copy rows that have weight back to X."""
                    mask = has_weight[rows]
                    smooth_rows = torch.from_numpy(solution[rows, : part.shape[1]][mask])
                    part.index_copy_(0, torch.from_numpy(graph.order[rows][mask]).long(), smooth_rows.to(X.dtype))

                _map_rows(write, count, pool)
                progress("smooth", begin + width, channels, "channels")
    change, norm = squares.sum(axis=1).tolist()
    facts: dict[str, Any] = {
        "smoothness": smoothness,
        "steps": len(steps),
        "residual": residual,
        "moved": float(np.sqrt(change / norm)) if norm > 0 and np.isfinite(norm) else None,
        "colours": graph.coloured,
    }
    if residual > system.tolerance:
        facts["warning"] = (
            f"smoothness={smoothness:g} ended after {len(steps)} steps with {residual:.1g} of the gradient left: "
            "features are less smooth than requested"
        )
    return X, facts


def smoothing_weights(total_weight: Tensor, confidence: Tensor | None) -> np.ndarray:
    """Return w over its largest value, [P] f64; zero for splats without total weight."""
    weights = total_weight.double()
    if confidence is not None:
        weights *= confidence.double().clamp_min(LEAST_CONFIDENCE)
    values = weights.nan_to_num(0.0).numpy()
    largest = float(values.max(initial=0.0))
    values = values / largest if largest > 0 else values
    return np.where(values >= LEAST_WEIGHT, values, 0.0)


def _probe(X: Tensor, order: np.ndarray, mask: np.ndarray, pool: Executor) -> np.ndarray:
    """Return sums of X's channels with random signs, [P, PROBES] f32 in the graph's order, zero outside the mask."""
    signs = torch.from_numpy(np.random.default_rng(0).choice(np.array([-1.0, 1.0], np.float32), (X.shape[1], PROBES)))

    def add(rows: slice) -> np.ndarray:
        return (X.index_select(0, torch.from_numpy(order[rows])).float() @ signs).numpy()

    sums = np.concatenate(_map_rows(add, len(X), pool))
    return np.where(mask[:, None] & np.isfinite(sums), sums, np.float32(0.0))


def _conjugate_gradients(system: _System, start: np.ndarray, pool: Executor) -> tuple[list[Step], float]:
    """Minimise from X0 [P, C] f32, all channels as one vector; return the steps and the final relative gradient.

    C is a multiple of LANES.
    """
    graph, count = system.graph, len(start)
    X, rest, direction = start.copy(), np.zeros_like(start), start.copy()
    image, steps = np.empty_like(start), list[Step]()

    def run(work: Callable[..., Any], *arguments: Any) -> float:
        return float(_row_sums(work, arguments, (1,), count, pool)[0])

    def multiply(weights: np.ndarray) -> float:
        flat = direction.reshape(-1), image.reshape(-1)
        return run(multiply_rows, graph.starts, graph.neighbours, system.couplings, weights, *flat)

    multiply(np.zeros_like(system.weights))  # lambda L X0, the gradient at X0
    unit, zero = np.float32(1.0), np.float32(0.0)
    first = slope = run(advance_rows, system.inverse, unit, direction, image, zero, X, rest)
    run(turn_rows, system.inverse, zero, rest, direction)
    turn = length = zero
    while 0 < slope < np.inf and slope > system.tolerance**2 * first and len(steps) < STEPS:
        curvature = multiply(system.weights)
        if not 0 < curvature < np.inf:
            break
        before, length = length, np.float32(slope / curvature)
        steps.append((length, length * turn / before if steps else zero))
        new = run(advance_rows, system.inverse, length, direction, image, length, X, rest)
        slope, turn = new, np.float32(new / slope)
        run(turn_rows, system.inverse, turn, rest, direction)
    return steps, float(np.sqrt(slope / first)) if first > 0 else 0.0


def _descend(
    system: _System, start: np.ndarray, iterates: Sequence[np.ndarray], steps: Sequence[Step], pool: Executor
) -> np.ndarray:
    """Take the given steps from X0 [P, BLOCK] f32, in two copies of it; return the one with the last iterate."""
    graph, (X, before) = system.graph, iterates
    arrays = graph.starts, graph.neighbours, system.couplings, system.weights, system.diagonal, start.reshape(-1)

    def take(step: Step, X: np.ndarray, before: np.ndarray, rows: slice) -> None:
        step_rows(rows.start, rows.stop, *arrays, X.reshape(-1), before.reshape(-1), *step)

    for step in steps:
        _map_rows(partial(take, step, X, before), len(start), pool)
        X, before = before, X
    return X


@kernel
def step_rows(
    first, last, starts, neighbours, couplings, weights, diagonal, start, X, before, length, turn
):  # fmt: skip
    """Overwrite the iterate before X by that after it, in rows first..last of flat [P, 64] arrays."""
    for j in range(first, last):
        far = length / diagonal[j] if diagonal[j] > 0 else np.float32(0.0)
        for c in range(0, BLOCK, wide.LANES):
            at = BLOCK * j + c
            x = wide.lanes_at(X, at)
            p = plus_times(wide.no_lanes(), weights[j], wide.lanes_at(start, at))
            p = plus_times(p, -diagonal[j], x)
            for n in range(starts[j], starts[j + 1]):
                p = plus_times(p, couplings[n], wide.lanes_at(X, BLOCK * np.int64(neighbours[n]) + c))
            p = plus_times(plus_times(x, far, p), turn, minus(x, wide.lanes_at(before, at)))
            store_lanes(before, at, p)


@kernel
def multiply_rows(first, last, starts, neighbours, couplings, weights, direction, image, dots):
    """Write ``(diag(w) + lambda L) P`` of rows first..last of flat [P, C] arrays; add ``p^T K p`` to dots [1] f64."""
    minus_one, channels = in_all_lanes(np.float32(-1.0)), direction.size // weights.size
    for j in range(first, last):
        for c in range(0, channels, LANES):
            at, weight = channels * j + c, in_all_lanes(weights[j])
            values = lanes_at(direction, at)
            product = times(weight, values)
            for n in range(starts[j], starts[j + 1]):
                near = lanes_at(direction, channels * np.int64(neighbours[n]) + c)
                product = plus_product(product, in_all_lanes(couplings[n]), plus(values, times(minus_one, near)))
            store_lanes(image, at, product)
            for lane in range(at, at + LANES):
                dots[0] += np.float64(direction[lane]) * image[lane]


@kernel
def advance_rows(first, last, inverse, fall, direction, image, length, X, rest, dots):
    """Take a step of rows first..last, ``X += length P``, ``R -= fall K P``; add ``r^T M^-1 r`` to dots [1] f64."""
    for j in range(first, last):
        for c in range(X.shape[1]):
            X[j, c] += length * direction[j, c]
            residual = rest[j, c] - fall * image[j, c]
            rest[j, c] = residual
            dots[0] += np.float64(residual) * residual * inverse[j]


@kernel
def turn_rows(first, last, inverse, turn, rest, direction, dots):
    """Write the next direction of rows first..last, ``P = M^-1 R + turn P``."""
    for j in range(first, last):
        for c in range(direction.shape[1]):
            direction[j, c] = inverse[j] * rest[j, c] + turn * direction[j, c]


@kernel
def bound_rows(first, last, has_weight, values, low, high):
    """Zero rows first..last without total weight; extend low and high [C] f32 by the others. NaN propagates."""
    for j in range(first, last):
        if not has_weight[j]:
            values[j] = 0.0
            continue
        for c in range(low.size):
            value = values[j, c]
            low[c] = value if value < low[c] or np.isnan(value) else low[c]
            high[c] = value if value > high[c] or np.isnan(value) else high[c]


@kernel
def clip_rows(first, last, weights, before, low, high, after, sums):
    """Clip rows first..last of ``after`` to low..high [C] f32; add squares of the change, and of ``before``, to sums.

    Sums [2, C] f64 are ``sum_j w_j (x_j - x0_j)^2`` and ``sum_j w_j x0_j^2`` of each channel.
    """
    for j in range(first, last):
        for c in range(low.size):
            value = after[j, c]
            value = low[c] if value < low[c] or np.isnan(low[c]) else value
            after[j, c] = high[c] if value > high[c] or np.isnan(high[c]) else value
        for c in range(low.size):
            value = np.float64(before[j, c])
            change = after[j, c] - value
            sums[0, c] += weights[j] * change * change
            sums[1, c] += weights[j] * value * value


def _map_rows(work: Callable[[slice], Any], count: int, pool: Executor) -> list[Any]:
    """Run ``work`` for each piece of ``count`` rows; return the results in order."""
    return list(pool.map(work, (slice(first, min(first + ROWS, count)) for first in range(0, count, ROWS))))


def _row_sums(
    work: Callable[..., Any], arguments: tuple[Any, ...], shape: tuple[int, ...], count: int, pool: Executor
) -> np.ndarray:
    """Sum ``work(first, last, *arguments, sums)`` over pieces of ``count`` rows in order, f64 of the shape."""

    def add(rows: slice) -> np.ndarray:
        part = np.zeros(shape)
        work(rows.start, rows.stop, *arguments, part)
        return part

    total = np.zeros(shape)
    for part in _map_rows(add, count, pool):
        total += part
    return total
