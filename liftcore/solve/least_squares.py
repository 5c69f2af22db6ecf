"""Damped least squares, from the closed form X0 towards the smallest ``|A X - B|^2``.

With a row of A for each row of B, D = A^T 1 and the damping mu, the answer is the smallest of::

    |A X - B|^2 + mu |D^(1/2) (X - X0)|^2,   (A^T A + mu D)(X - X0) = A^T (B - A X0)

mu has no unit: where the rows of A sum to one, ``A^T A <= D``, so mu = 1 keeps at least as much of X0 as the data
can take from it. mu = 0 is plain least squares, a large mu the closed form. Splats that the lift did not see stay
zero. The matrix is never formed: each step of conjugate gradients renders and transposes all views.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from liftcore.solve.channels import Channels, blocks, codebook_axes
from liftcore.solve.conjugate_gradients import CgOutcome, Stopping, Watch, column_dots, conjugate_gradients

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from liftcore.progress import Progress
    from liftcore.settings import LiftSettings
    from liftcore.solve.all_rays import AllRays

TOLERANCE = 1e-4  # of the gradient, relative to the closed form's; float32 products give little more
_FAINTEST = 1e-30  # a diagonal entry below this says nothing of its splat, and its inverse would overflow


@dataclass(frozen=True)
class Refinement:
    """The refined features, and how it went."""

    features: Tensor  # [P, F], as they came in; float32 where float16 cannot hold them
    stats: dict[str, Any]  # ready for JSON; result: "converged", "steps" (all were used) or "breakdown"


@dataclass(frozen=True)
class BlockOutcome:
    """One block of channels solved."""

    step: np.ndarray  # [P, C] f32, X - X0
    losses: list[float]  # |A X - B|^2 in these channels: of X0 and after every step
    cg: CgOutcome


@dataclass(frozen=True)
class BlockFacts:
    """What is kept of a solved block, whose vectors are as large as its part of X."""

    channels: int
    losses: list[float]
    steps: int
    gradient: float  # after the last step, relative to the first
    converged: bool  # in all channels
    broken: bool  # in any

    @classmethod
    def of(cls, block: BlockOutcome) -> BlockFacts:
        """The facts of a block."""
        cg, channels = block.cg, block.step.shape[1]
        last = float(cg.gradients[-1])
        return cls(channels, block.losses, cg.steps, last, bool(cg.converged.all()), bool(cg.broken.any()))


def refine(
    rays: AllRays,
    features: Tensor,
    seen: np.ndarray,
    codebooks: Sequence[Tensor],
    settings: LiftSettings,
    progress: Progress,
) -> Refinement:
    """Take ``cg_steps`` steps from the closed form, in blocks of channels.

    Args:
        features: [P, F] f16 or f32, X0; changed in place.
        seen: [P] bool, the splats to solve for.
        codebooks: E_v [M, F] of every view.
    """
    reduced = 0 < settings.cg_basis < features.shape[1]
    parts = blocks(features.shape[1], codebook_axes(codebooks, settings.cg_basis) if reduced else None)
    total = len(parts) * settings.cg_steps
    solved = []
    for number, part in enumerate(parts):
        done = number * settings.cg_steps

        def watch(step: int, *_: object, done: int = done) -> None:
            progress("refine", done + step, total, "steps")

        block = solve_block(rays, part, features, seen, (settings.damping, settings.cg_steps), watch)
        features = part.add(features, block.step)
        solved.append(BlockFacts.of(block))
        del block  # before the next one is solved beside it
        progress("refine", done + settings.cg_steps, total, "steps")
    return _summary(features, solved, settings, rays.rows)


def solve_block(
    rays: AllRays,
    part: Channels,
    features: Tensor,
    seen: np.ndarray,
    effort: tuple[float, int],
    watch: Watch | None = None,
) -> BlockOutcome:
    """``X - X0`` in one block of channels, with ``effort = (damping, steps)``."""
    damping, steps = effort
    weight = np.where(seen, damping * rays.row_sums, 0.0)
    diagonal = np.where(seen, rays.diagonal, 0.0) + weight
    inverse = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=diagonal > _FAINTEST).astype(np.float32)
    weight = weight.astype(np.float32)[:, None]
    gradient, loss = rays.gradient(part.project(features), part.project)
    losses = [loss]

    def note(step: int, solution: np.ndarray, rest: np.ndarray) -> None:
        # With K = A^T A + mu D, g = A^T (B - A X0) and rest = g - K d, the loss at X0 + d needs no product.
        gain = column_dots(solution, gradient + rest) + column_dots(solution, weight * solution)
        losses.append(max(loss - float(gain.sum()), 0.0))
        if watch is not None:
            watch(step, solution, rest)

    outcome = conjugate_gradients(
        lambda X: rays.normal(X) + weight * X, gradient, inverse, Stopping(steps, TOLERANCE), note
    )
    return BlockOutcome(outcome.solution, losses, outcome)


def _summary(features: Tensor, solved: Sequence[BlockFacts], settings: LiftSettings, rows: int) -> Refinement:
    longest = max(len(block.losses) for block in solved)
    losses = [
        sum(block.losses[min(step, len(block.losses) - 1)] for block in solved) / max(rows, 1)
        for step in range(longest)
    ]
    gradient = max(block.gradient for block in solved)
    if any(block.broken for block in solved):
        result, why = "breakdown", "a direction without curvature ended some channels early; more damping helps"
    elif all(block.converged for block in solved):
        result, why = "converged", f"the gradient fell below {TOLERANCE:g} of the closed form's"
    else:
        result, why = "steps", f"the gradient is {gradient:.2g} of the closed form's; more cg_steps would go on"
    change = losses[-1] / losses[0] if losses[0] > 0 else 1.0
    stats = {
        "result": result,
        "steps": max(block.steps for block in solved),
        "damping": settings.damping,
        "channels": sum(block.channels for block in solved),
        "gradient": gradient,
        "residuals": losses,
    }
    stats["message"] = (
        f"{stats['steps']} steps with damping {settings.damping:g} left {100 * change:.1f}% of the closed form's "
        f"residual in {stats['channels']} channels: {why}."
    )
    return Refinement(features, stats)
