"""Conjugate gradients for ``K X = R`` with K symmetric and at least zero, every channel a system of its own.

The vectors are float32, as the products are; the few numbers that steer the steps are summed in float64 and in a
fixed order. A channel stops when its gradient has shrunk by the tolerance, or when its direction has no curvature
left (rounding, or a K that is no such matrix); channels that stopped cost nothing more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

_BLOCK = 1 << 14  # rows summed at a time in float64

Product = Callable[[np.ndarray], np.ndarray]  # [P, C] f32 -> [P, C] f32
Watch = Callable[[int, np.ndarray, np.ndarray], None]  # step, solution, rest: after every step


@dataclass(frozen=True)
class Stopping:
    """When to stop."""

    steps: int
    tolerance: float = 0.0  # of the gradient's preconditioned length, relative to the first


@dataclass(frozen=True)
class CgOutcome:
    """Where it ended, and why."""

    solution: np.ndarray  # [P, C] f32
    rest: np.ndarray  # [P, C] f32, R - K X as the recurrence has it
    steps: int
    gradients: np.ndarray  # [steps + 1] f64: sqrt(sum_c r^T M^-1 r), relative to the first
    converged: np.ndarray  # [C] bool: the tolerance was reached
    broken: np.ndarray  # [C] bool: no curvature was left before that


def conjugate_gradients(
    product: Product, right: np.ndarray, inverse: np.ndarray, stopping: Stopping, watch: Watch | None = None
) -> CgOutcome:
    """Solve from zero.

    Args:
        product: K.
        right: [P, C] f32. inverse: [P] f32, the preconditioner ``M^-1``; rows where it is zero stay zero.
        watch: called after every step; an exception from it stops the work.
    """
    solution, rest = np.zeros_like(right), right.copy()
    slope = column_dots(rest, rest * inverse[:, None])  # r^T M^-1 r
    first = slope.copy()
    direction = rest * inverse[:, None]
    converged, broken = slope <= 0, ~np.isfinite(slope)
    gradients = [1.0]
    step = 0
    while step < stopping.steps and not (converged | broken).all():
        active = np.flatnonzero(~(converged | broken))
        part = np.ascontiguousarray(direction[:, active])
        image = product(part)
        curvature = column_dots(part, image)
        sound = np.isfinite(curvature) & (curvature > 0)
        broken[active[~sound]] = True
        length = np.divide(slope[active], curvature, out=np.zeros(active.size), where=sound)
        solution[:, active] += part * length.astype(np.float32)
        rest[:, active] -= image * length.astype(np.float32)
        scaled = rest[:, active] * inverse[:, None]
        old, slope[active] = slope[active], column_dots(rest[:, active], scaled)
        turn = np.divide(slope[active], old, out=np.zeros(active.size), where=old > 0)
        direction[:, active] = part * turn.astype(np.float32) + scaled
        step += 1
        broken |= ~np.isfinite(slope)
        converged |= slope <= stopping.tolerance**2 * first
        gradients.append(float(np.sqrt(slope.sum() / first.sum())))
        if watch is not None:
            watch(step, solution, rest)
    return CgOutcome(solution, rest, step, np.array(gradients), converged & ~broken, broken)


def column_dots(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """[C] f64: the inner products of the columns of two [P, C] f32, in a fixed order."""
    total = np.zeros(left.shape[1])
    for begin in range(0, left.shape[0], _BLOCK):
        block = slice(begin, begin + _BLOCK)
        total += np.multiply(left[block], right[block], dtype=np.float64).sum(axis=0)
    return total
