"""How far the lift is from the optimum: ``L(x') / L(x^)`` over all rays, beside the paper's ``1 + beta``.

x^ is found by conjugate gradients in r random projections ``G = E R`` of the channels. Least squares is linear in B,
so x^ R is the solution for B R; and with R Gaussian / sqrt(r), squared lengths and so L keep their mean (the ratio's
relative error is about sqrt(2 / r), less where residuals point many ways).

The theorem, and which beta it is about. Where the rows of A sum to one, Jensen gives ``L(x') <= J(x')`` with
``J(x) = sum_ij A_ij |x_j - B_i|^2``, and x' minimises J, so ``L(x') <= J(x^)``. Now with

    mu_i = | sum_j A_ij (x^_j - B_i) |,  beta_i = sum_j A_ij |x^_j - B_i|^2 / mu_i^2 - 1

mu_i^2 is the row's part of L(x^), hence ``L(x') <= J(x^) = sum_i (1 + beta_i) mu_i^2 <= (1 + max_i beta_i) L(x^)``.
The paper writes ``mu_i = sum_j A_ij |x^_j - B_i|``, lengths before the sum; that mu_i^2 is at least the row's part of
L, not at most, its last step does not follow, and two rays suffice for a counterexample (tests/unit/solve). So the
bound is built from the first reading, and the second is given beside it as ``beta_of_lengths``. The whole chain holds
for any x in the place of x^, converged or not, and in the projected channels as in any.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.solve.certificate import ViewMeasures, measure_samples, quantiles
from liftcore.solve.channels import Channels, blocks, random_axes
from liftcore.solve.least_squares import solve_block

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from liftcore.progress import Progress
    from liftcore.settings import LiftSettings
    from liftcore.solve.accumulate import SampledRays
    from liftcore.solve.all_rays import AllRays
    from liftcore.solve.conjugate_gradients import Watch

STEPS = 100  # of conjugate gradients, unless the gradient has vanished before


def reference(
    rays: AllRays,
    features: Tensor,
    seen: np.ndarray,
    samples: Sequence[SampledRays],
    codebooks: Sequence[Tensor],
    settings: LiftSettings,
    progress: Progress,
) -> dict[str, Any]:
    """``L(x')``, ``L(x^)`` and their ratio over all rays; beta and the bounds at x^ on the sampled rays.

    Args:
        features: [P, F], x'. seen: [P] bool. samples, codebooks: of every view.

    Returns:
        Plain numbers, ready for JSON; None where nothing was sampled or a row is met exactly.
    """
    axes = random_axes(features.shape[1], settings.reference_channels, settings.seed)
    parts = blocks(features.shape[1], axes)
    optimum = np.empty((features.shape[0], axes.shape[1]), np.float32)
    lifted = best = gradient = 0.0
    steps, converged = 0, True
    for number, part in enumerate(parts):
        block = solve_block(rays, part, features, seen, (0.0, STEPS), _teller(progress, number, len(parts)))
        solution = part.project(features) + block.step
        optimum[:, part.begin : part.end] = solution
        lifted += block.losses[0]
        best += rays.gradient(solution, part.project)[1]  # measured, not by recurrence
        gradient = max(gradient, float(block.cg.gradients[-1]))
        steps, converged = max(steps, block.cg.steps), converged and bool(block.cg.converged.all())
        progress("reference", (number + 1) * STEPS, len(parts) * STEPS, "steps")
    whole = Channels(0, axes.shape[1], axes)
    books = [torch.from_numpy(whole.project(book)) for book in codebooks]
    measured = _measured(measure_samples(samples, torch.from_numpy(optimum), books))
    found = {
        "channels": axes.shape[1],
        "steps": steps,
        "converged": converged,
        "gradient": gradient,
        "residual": lifted / max(rays.rows, 1),
        "optimum": best / max(rays.rows, 1),
        "ratio": lifted / best if best > 0 else None,
        **measured,
    }
    return found | {"message": _message(found)}


def row_betas(measures: ViewMeasures) -> np.ndarray:
    """beta_i [rows] f64 of the theorem: ``sum_j A_ij |x_j - B_i|^2 / mu_i^2 - 1``; infinite where only mu is zero."""
    ratio = np.ones_like(measures.surrogates)
    np.divide(measures.surrogates, measures.residuals, out=ratio, where=measures.residuals > 0)
    ratio[(measures.residuals == 0) & (measures.surrogates > 0)] = np.inf
    return np.maximum(ratio - 1.0, 0.0)


def _measured(measures: ViewMeasures) -> dict[str, Any]:
    beta = quantiles(row_betas(measures))
    residual = measures.residuals.sum()
    return {
        "beta": beta,
        "bound": None if beta["max"] is None else 1.0 + beta["max"],
        "surrogate_bound": float(measures.surrogates.sum() / residual) if residual > 0 else None,
        "beta_of_lengths": quantiles(measures.betas),
    }


def _message(found: dict[str, Any]) -> str:
    """What was found, in a sentence for the user."""
    if found["ratio"] is None:
        return "The optimum meets every row exactly: there is no ratio to speak of."
    end = (
        "converged"
        if found["converged"]
        else f"not converged, so it is at least that; gradient {found['gradient']:.2g}"
    )
    said = f"L(x') is {found['ratio']:.3f} times L(x^) after {found['steps']} steps ({end})"
    if found["bound"] is None:
        return f"{said}; no bound, for no row was sampled or one is met exactly."
    return (
        f"{said}; on the sampled rays J(x^) / L(x^) is {found['surrogate_bound']:.3f} and 1 + beta is "
        f"{found['bound']:.3g}. Both bound the ratio for plain weights (power 1) over all rays."
    )


def _teller(progress: Progress, number: int, parts: int) -> Watch:
    return lambda step, *_: progress("reference", number * STEPS + step, parts * STEPS, "steps")
