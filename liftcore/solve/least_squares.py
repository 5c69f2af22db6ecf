"""Least squares over all rays: conjugate gradients from the closed form X0 on ``|A X - B|^2``, and the optimum.

A ray has a row of B for each labelled level (one for a grid), so its row of A counts as often: with N the number of
rows of each ray, the matrix is ``sum_v A_v^T N_v A_v``. It is never formed: each step of conjugate gradients renders
and transposes all views, a view and a block of channels at a time.

**Damping.** With a row of A for each row of B, D = A^T 1 and the damping mu, `refine` minimises::

    |A X - B|^2 + mu |D^(1/2) (X - X0)|^2,   (A^T A + mu D)(X - X0) = A^T (B - A X0)

mu has no unit: where the rows of A sum to one, ``A^T A <= D``, so with mu = 1 the damping is at least as strong as
the data. mu = 0 is undamped least squares, a large mu the closed form. Splats without weights in the lift stay zero.

**Distance of the lift to the optimum** (`reference`): ``L(x') / L(x^)`` over all rays, with ``1 + beta``.

x^ is computed by conjugate gradients in r random projections ``G = E R`` of the channels. Least squares is linear in
B, so x^ R is the solution for B R; and with R Gaussian / sqrt(r), squared lengths and so L keep their expectation
(the ratio's relative error is about sqrt(2 / r), less if residuals have many directions).

**The theorem and its beta.** Where the rows of A sum to one, Jensen gives ``L(x') <= J(x')`` with
``J(x) = sum_ij A_ij |x_j - B_i|^2``, and x' minimises J, so ``L(x') <= J(x^)``. Now with

    mu_i = | sum_j A_ij (x^_j - B_i) |,  beta_i = sum_j A_ij |x^_j - B_i|^2 / mu_i^2 - 1

mu_i^2 is the row's part of L(x^), hence ``L(x') <= J(x^) = sum_i (1 + beta_i) mu_i^2 <= (1 + max_i beta_i) L(x^)``.
The paper writes ``mu_i = sum_j A_ij |x^_j - B_i|``, lengths before the sum. That mu_i^2 is at least the row's part of
L, not at most, so its last step does not follow; two rays suffice for a counterexample (tests/unit/solve). So the
bound uses the first definition, and the second is reported as ``beta_of_lengths``. The chain holds for any x in place
of x^, converged or not, and in projected channels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.raster.base import Raster
from liftcore.runtime.jit import kernel
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, silent
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.solve.codebook import row_lengths
from liftcore.solve.diagnostics import ViewMeasures, measure_samples, quantiles
from liftcore.solve.rays import Readout, SampledRays, read_pixels
from liftcore.values.settings import LiftSettings
from liftcore.values.views import NO_LABEL, Regions, ViewFeatures

BLOCK = 32  # channels solved at a time: one pass of the raster, and memory for a few [P, 32] f32
ROWS = 1 << 14  # rows converted at a time
EXTRA_AXES = 8  # directions of the iteration beyond those requested
ROUNDS = 12  # of the subspace iteration
FLOAT16_MAX = 65_504.0
TOLERANCE = 1e-4  # of the gradient, relative to the closed form's; float32 products allow little more
FAR_LONGER = 10.0  # than any input: never for a mean of inputs, and rare with damping 1 (tests/stability)
FAINTEST = 1e-30  # a smaller diagonal entry does not determine its splat, and its inverse would overflow
STEPS = 100  # of conjugate gradients towards the optimum, at most

Product = Callable[[np.ndarray], np.ndarray]  # [P, C] f32 -> [P, C] f32
Watch = Callable[[int, np.ndarray, np.ndarray], None]  # step, solution, rest: after every step


@dataclass(frozen=True)
class Channels:
    """A block of channels: ``rows [n, F] -> rows axes [n, C]``, with axes orthonormal or a slice of the identity."""

    begin: int  # of the slice, or of the columns of axes
    end: int
    axes: Tensor | None  # [F, K] f32; None: the identity

    def project(self, rows: Tensor) -> np.ndarray:
        """Project rows [n, F] f16 or f32 to [n, C] f32."""
        result = torch.empty(rows.shape[0], self.end - self.begin, dtype=torch.float32)
        axes = None if self.axes is None else self.axes[:, self.begin : self.end].contiguous()
        with one_thread():
            for first in range(0, rows.shape[0], ROWS):
                part = rows[first : first + ROWS]
                block = part[:, self.begin : self.end].float() if axes is None else part.float() @ axes
                result[first : first + ROWS] = block
        return result.numpy()

    def add(self, features: Tensor, step: np.ndarray) -> Tensor:
        """Add ``step`` [P, C] f32, mapped back to all channels, to the features [P, F], and return them.

        In place, unless the result overflows float16: then to a float32 copy.
        """
        axes = None if self.axes is None else self.axes[:, self.begin : self.end].T.contiguous()
        channels = slice(self.begin, self.end) if axes is None else slice(None)
        with one_thread():
            for first in range(0, features.shape[0], ROWS):
                part = torch.from_numpy(step[first : first + ROWS])
                rows = features[first : first + ROWS, channels] + (part if axes is None else part @ axes)
                if features.dtype == torch.float16 and bool((rows.abs() > FLOAT16_MAX).any()):
                    features = features.float()
                features[first : first + ROWS, channels] = rows
        return features


def blocks(channels: int, axes: Tensor | None = None) -> list[Channels]:
    """Return all channels, or all columns of ``axes`` [F, K], in blocks of one pass of the raster."""
    total = channels if axes is None else axes.shape[1]
    return [Channels(begin, min(begin + BLOCK, total), axes) for begin in range(0, total, BLOCK)]


def codebook_axes(codebooks: Sequence[Tensor], count: int) -> Tensor:
    """Return the ``count`` leading right singular vectors [F, count] f32 of all codebook rows.

    A block power iteration from a fixed start. The rows are not centred, so their mean is included; every solution is
    a combination of rows, so with ``count`` at their rank the projection is exact.
    """
    channels = codebooks[0].shape[1]
    generator = torch.Generator().manual_seed(0)
    width = min(channels, count + EXTRA_AXES)
    axes = torch.randn(channels, width, generator=generator, dtype=torch.float64)
    longest = max(max((float(book.abs().max()) for book in codebooks if book.numel()), default=0.0), 1e-300)
    with one_thread():
        for _ in range(ROUNDS):
            axes = torch.linalg.qr(_gram_times(codebooks, axes, longest)).Q
        image = _gram_times(codebooks, axes, longest)
        values, vectors = torch.linalg.eigh(axes.T @ image)
        order = torch.argsort(values, descending=True, stable=True)[:count]
        return (axes @ vectors[:, order]).float()


def longest_row(books: Sequence[Tensor]) -> float:
    """Return the largest length of the rows of several arrays [n, F]."""
    return max((float(row_lengths(book).max()) for book in books if book.numel()), default=0.0)


def random_axes(channels: int, count: int, seed: int) -> Tensor:
    """Return Gaussian projections [F, count] f32 that keep expected squared lengths (Johnson-Lindenstrauss)."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(channels, count, generator=generator, dtype=torch.float32) / count**0.5


def _gram_times(codebooks: Sequence[Tensor], axes: Tensor, scale: float) -> Tensor:
    """Return ``sum_v E_v^T E_v axes / scale^2``."""
    total = torch.zeros_like(axes)
    for book in codebooks:
        for first in range(0, book.shape[0], ROWS):
            rows = book[first : first + ROWS].double() / scale
            total += rows.T @ (rows @ axes)
    return total


class AllRays:
    """The operator of least squares. Weights have power 1, for any power of the closed form.

    Args:
        raster: A of a view. count: P.
        views: the cameras, in the order of the sums.
        observed: view number -> its observation, as the lift read it.
        params: of the lift; all rays are used, for any stride.
    """

    def __init__(
        self,
        raster: Raster,
        count: int,
        views: Sequence[Camera],
        observed: Callable[[int], ViewFeatures],
        params: CompositingParams,
        progress: Progress = silent,
    ) -> None:
        self.count = count
        self.views = views
        self._raster, self._observed = raster, observed
        self._params = replace(params, stride=1, offset=(0, 0))
        self._counts: list[np.ndarray] = []  # [H, W] per view: rows of B of each ray
        self.row_sums = np.zeros(count)  # D = sum_v A_v^T N_v 1, [P] f64
        self.diagonal = np.zeros(count)  # of sum_v A_v^T N_v A_v, [P] f64
        self.rows = 0  # of B
        for number, camera in enumerate(views):
            self._count_rows(number, camera)
            progress("rays", number + 1, len(views), "views")

    def _count_rows(self, number: int, camera: Camera) -> None:
        """Count the rows of a view, and add its row sums and diagonal."""
        observation = self._observed(number)
        rays = _readout(observation, camera).rays
        counts = np.bincount(rays, minlength=camera.width * camera.height).reshape(camera.height, camera.width)
        self._counts.append(counts.astype(np.uint8 if counts.max(initial=0) <= 255 else np.int32))
        self.rows += rays.size
        labelled = _labelled(observation)
        for power, sums in ((1, self.row_sums), (2, self.diagonal)):
            weights = self._raster.region_weights(camera, labelled, self._params, Weighting(power)).cpu()
            sums[weights.splats.numpy()] += weights.weight.numpy()

    def normal(self, X: np.ndarray) -> np.ndarray:
        """Return ``sum_v A_v^T N_v A_v X``: [P, C] f32 -> [P, C] f32."""
        total = np.zeros_like(X)
        values = torch.from_numpy(X)
        for camera, counts in zip(self.views, self._counts, strict=True):
            image = self._raster.render(camera, values, self._params).numpy()
            image *= counts[:, :, None]
            total += self._raster.adjoint(camera, torch.from_numpy(image), self._params).numpy()
        return total

    def gradient(self, X: np.ndarray, project: Callable[[Tensor], np.ndarray]) -> tuple[np.ndarray, float]:
        """Return ``A^T (B - A X)`` [P, C] f32 over all rows, and ``|A X - B|^2``.

        Args:
            X: [P, C] f32. project: rows of a codebook [M, F] -> [M, C] f32, the channels of X.
        """
        total, squares = np.zeros_like(X), 0.0
        for number, camera in enumerate(self.views):
            observation = self._observed(number)
            readout = _readout(observation, camera)
            rendered = self._raster.render(camera, torch.from_numpy(X), self._params).numpy()
            rest = np.zeros_like(rendered)
            squares += subtract_rows(
                readout.rays,
                readout.columns,
                readout.shares,
                project(observation.codebook),
                rendered.reshape(-1, X.shape[1]),
                rest.reshape(-1, X.shape[1]),
            )
            total += self._raster.adjoint(camera, torch.from_numpy(rest), self._params).numpy()
        return total, squares


@kernel
def subtract_rows(rays, columns, shares, codebook, rendered, rest):
    """Add ``B_i - (A X)_i`` of every row i to its ray in ``rest`` [rays, C] f32; return the sum of their squares.

    Args:
        rays: [rows] i64. columns: [rows, taps] i64. shares: [rows, taps] f64. codebook: [M, C] f32.
        rendered: [rays, C] f32.
    """
    squares = 0.0
    for row in range(rays.shape[0]):
        ray = rays[row]
        for channel in range(codebook.shape[1]):
            value = 0.0
            for tap in range(columns.shape[1]):
                value += shares[row, tap] * codebook[columns[row, tap], channel]
            value -= rendered[ray, channel]
            rest[ray, channel] += value
            squares += value * value
    return squares


def _readout(observation: ViewFeatures, camera: Camera) -> Readout:
    """Return S of all pixels of a view."""
    y, x = np.mgrid[: camera.height, : camera.width].astype(np.int32)
    return read_pixels(observation, camera, torch.from_numpy(np.stack([x.ravel(), y.ravel()], axis=1)))


def _labelled(observation: ViewFeatures) -> Regions:
    """Return an observation with one region for all labelled pixels, whose weights are sums over the rows of B."""
    if isinstance(observation, Regions):
        return Regions(observation.labels.clamp(NO_LABEL, 0), torch.ones(1, 1, dtype=torch.float32))
    return Regions(torch.zeros(1, 1, 1, dtype=torch.int32), torch.ones(1, 1, dtype=torch.float32))


@dataclass(frozen=True)
class Stopping:
    """The stopping criterion of conjugate gradients."""

    steps: int  # at most
    tolerance: float = 0.0  # of the gradient's preconditioned length, relative to the first


@dataclass(frozen=True)
class CgOutcome:
    """The result of conjugate gradients, per channel."""

    solution: np.ndarray  # [P, C] f32
    rest: np.ndarray  # [P, C] f32, R - K X by recurrence
    steps: int
    gradients: np.ndarray  # [steps + 1] f64: sqrt(sum_c r^T M^-1 r), relative to the first
    converged: np.ndarray  # [C] bool, the tolerance was reached
    broken: np.ndarray  # [C] bool, the curvature was not positive before that


def conjugate_gradients(
    product: Product, right: np.ndarray, inverse: np.ndarray, stopping: Stopping, watch: Watch | None = None
) -> CgOutcome:
    """Solve ``K X = right`` from zero.

    Args:
        product: K.
        right: [P, C] f32. inverse: [P] f32, the preconditioner ``M^-1``; rows where it is zero stay zero.
        watch: called after every step; an exception from it stops the solve.
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
    """Return the inner products [C] f64 of the columns of two arrays [P, C] f32, in a fixed order."""
    total = np.zeros(left.shape[1])
    for begin in range(0, left.shape[0], ROWS):
        block = slice(begin, begin + ROWS)
        total += np.multiply(left[block], right[block], dtype=np.float64).sum(axis=0)
    return total


@dataclass(frozen=True)
class Refinement:
    """Refined features, and statistics of the solve."""

    features: Tensor  # [P, F], in the dtype of the input; float32 if they overflow float16
    stats: dict[str, Any]  # for JSON; result: "converged", "steps" (all were used) or "breakdown"


@dataclass(frozen=True)
class BlockOutcome:
    """The solution of one block of channels."""

    step: np.ndarray  # [P, C] f32, X - X0
    losses: list[float]  # |A X - B|^2 in these channels, of X0 and after every step
    steps: int
    gradient: float  # after the last step, relative to the first
    converged: bool  # in all channels
    broken: bool  # in any


def refine(
    rays: AllRays,
    features: Tensor,
    has_feature: np.ndarray,
    codebooks: Sequence[Tensor],
    settings: LiftSettings,
    progress: Progress,
) -> Refinement:
    """Take ``cg_steps`` steps from the closed form, in blocks of channels.

    Args:
        features: [P, F] f16 or f32, X0; changed in place.
        has_feature: [P] bool, the splats to solve for.
        codebooks: E_v [M, F] of every view.
    """
    reduced = 0 < settings.cg_basis < features.shape[1]
    parts = blocks(features.shape[1], codebook_axes(codebooks, settings.cg_basis) if reduced else None)
    total = len(parts) * settings.cg_steps
    solved = []
    for number, part in enumerate(parts):
        completed = number * settings.cg_steps

        def watch(step: int, *_: object, completed: int = completed) -> None:
            progress("refine", completed + step, total, "steps")

        block = solve_block(rays, part, features, has_feature, settings.damping, settings.cg_steps, watch)
        features = part.add(features, block.step)
        solved.append(replace(block, step=np.empty(0)))  # the step is as large as its part of X
        del block  # before the next one is solved
        progress("refine", completed + settings.cg_steps, total, "steps")
    refinement = _summary(features, solved, parts[-1].end, settings, rays.rows)
    inputs, longest = longest_row(codebooks), longest_row([features])
    if longest > FAR_LONGER * inputs:
        message = f"least squares made features up to {longest / inputs:.0f} times as long as any input"
        refinement.stats["warning"] = f"{message}: try damping=1, which bounds them"
    return refinement


def solve_block(
    rays: AllRays,
    part: Channels,
    features: Tensor,
    has_feature: np.ndarray,
    damping: float,
    steps: int,
    watch: Watch | None = None,
) -> BlockOutcome:
    """Compute ``X - X0`` in one block of channels."""
    weight = np.where(has_feature, damping * rays.row_sums, 0.0)
    diagonal = np.where(has_feature, rays.diagonal, 0.0) + weight
    inverse = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=diagonal > FAINTEST).astype(np.float32)
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
    return BlockOutcome(
        outcome.solution,
        losses,
        outcome.steps,
        float(outcome.gradients[-1]),
        bool(outcome.converged.all()),
        bool(outcome.broken.any()),
    )


def _summary(
    features: Tensor, solved: Sequence[BlockOutcome], channels: int, settings: LiftSettings, rows: int
) -> Refinement:
    longest = max(len(block.losses) for block in solved)
    losses = [
        sum(block.losses[min(step, len(block.losses) - 1)] for block in solved) / max(rows, 1)
        for step in range(longest)
    ]
    gradient = max(block.gradient for block in solved)
    if any(block.broken for block in solved):
        result, reason = "breakdown", "some channels ended early, without positive curvature; use more damping"
    elif all(block.converged for block in solved):
        result, reason = "converged", f"the gradient fell below {TOLERANCE:g} of the closed form's"
    else:
        result, reason = "steps", f"the gradient is {gradient:.2g} of the closed form's; use more cg_steps"
    change = losses[-1] / losses[0] if losses[0] > 0 else 1.0
    stats = {
        "result": result,
        "steps": max(block.steps for block in solved),
        "damping": settings.damping,
        "channels": channels,
        "gradient": gradient,
        "residuals": losses,
    }
    stats["message"] = (
        f"{stats['steps']} steps with damping {settings.damping:g} left {100 * change:.1f}% of the closed form's "
        f"residual in {stats['channels']} channels: {reason}."
    )
    return Refinement(features, stats)


def reference(
    rays: AllRays,
    features: Tensor,
    has_feature: np.ndarray,
    samples: Sequence[SampledRays],
    codebooks: Sequence[Tensor],
    settings: LiftSettings,
    progress: Progress,
) -> dict[str, Any]:
    """Return ``L(x')``, ``L(x^)`` and their ratio over all rays; beta and the bounds at x^ on the sampled rays.

    Args:
        features: [P, F], x'. has_feature: [P] bool. samples, codebooks: of every view.

    Returns:
        Numbers for JSON; None if nothing was sampled or measurable, or a row has no residual.
    """
    axes = random_axes(features.shape[1], settings.reference_channels, settings.seed)
    parts = blocks(features.shape[1], axes)
    optimum = np.empty((features.shape[0], axes.shape[1]), np.float32)
    lifted = best = gradient = 0.0
    steps, converged = 0, True
    for number, part in enumerate(parts):
        block = solve_block(
            rays, part, features, has_feature, 0.0, STEPS, _reference_watch(progress, number, len(parts))
        )
        solution = part.project(features) + block.step
        optimum[:, part.begin : part.end] = solution
        lifted += block.losses[0]
        best += rays.gradient(solution, part.project)[1]  # recomputed, not by recurrence
        gradient = max(gradient, block.gradient)
        steps, converged = max(steps, block.steps), converged and block.converged
        progress("reference", (number + 1) * STEPS, len(parts) * STEPS, "steps")
    all_channels = Channels(0, axes.shape[1], axes)
    books = [torch.from_numpy(all_channels.project(book)) for book in codebooks]
    measured = _measured(measure_samples(samples, torch.from_numpy(optimum), books))
    facts = {
        "channels": axes.shape[1],
        "steps": steps,
        "converged": converged,
        "gradient": gradient,
        "residual": lifted / max(rays.rows, 1),
        "optimum": best / max(rays.rows, 1),
        "ratio": lifted / best if best > 0 else None,
        **measured,
    }
    return facts | {"message": _message(facts)}


def row_betas(measures: ViewMeasures) -> np.ndarray:
    """Return beta_i [rows] f64 of the theorem, ``sum_j A_ij |x_j - B_i|^2 / mu_i^2 - 1``.

    Infinite where only mu is zero, and NaN where the ray hits no splat.
    """
    ratio = np.ones_like(measures.surrogates)
    np.divide(measures.surrogates, measures.residuals, out=ratio, where=measures.residuals > 0)
    ratio[(measures.residuals == 0) & (measures.surrogates > 0)] = np.inf
    return np.where(np.isnan(measures.betas), np.nan, np.maximum(ratio - 1.0, 0.0))


def _measured(measures: ViewMeasures) -> dict[str, Any]:
    beta = quantiles(row_betas(measures))
    residual, surrogate = measures.residuals.sum(), measures.surrogates.sum()
    return {
        "beta": beta,
        "bound": None if beta["max"] is None else 1.0 + beta["max"],
        "surrogate_bound": float(surrogate / residual) if residual > 0 and np.isfinite(surrogate) else None,
        "beta_of_lengths": quantiles(measures.betas),
    }


def _message(facts: dict[str, Any]) -> str:
    """Return the result in a sentence for the user."""
    if facts["ratio"] is None:
        return "The residual of the optimum is zero: there is no ratio."
    end = (
        "converged"
        if facts["converged"]
        else f"not converged, so it is at least that; gradient {facts['gradient']:.2g}"
    )
    sentence = f"L(x') is {facts['ratio']:.3f} times L(x^) after {facts['steps']} steps ({end})"
    if facts["bound"] is None or facts["surrogate_bound"] is None:
        return f"{sentence}; no bound, as no row was sampled or the residual of one is zero."
    return (
        f"{sentence}; on the sampled rays J(x^) / L(x^) is {facts['surrogate_bound']:.3f} and 1 + beta is "
        f"{facts['bound']:.3g}. Both bound the ratio for weights of power 1 over all rays."
    )


def _reference_watch(progress: Progress, number: int, parts: int) -> Watch:
    return lambda step, *_: progress("reference", number * STEPS + step, parts * STEPS, "steps")
