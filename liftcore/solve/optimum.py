"""The least-squares optimum over the rays of a lift, as a measure of the lift's distance from it.

A ray has a row of B for each labelled level (one for a grid), so its row of A counts as often. In r random
projections ``G = E R`` of the channels, x^ minimises ``L(x) = |A x - B R|^2`` over all rays of the lift's stride,
with weights of power 1. Least squares are linear in B, so x^ R is the solution for B R; with R Gaussian / sqrt(r),
squared lengths and so L keep their expectation (the ratio's relative error is about sqrt(2 / r), less if residuals
have many directions). A is in memory, 12 bytes for each splat on a ray: take a stride for large photos.

**The theorem and its beta.** Where the rows of A sum to one, Jensen gives ``L(x') <= J(x')`` with
``J(x) = sum_ij A_ij |x_j - B_i|^2``, and the closed form x' minimises J, so ``L(x') <= J(x^)``. Now with

    mu_i = | sum_j A_ij (x^_j - B_i) |,  beta_i = sum_j A_ij |x^_j - B_i|^2 / mu_i^2 - 1

mu_i^2 is the row's part of L(x^), hence ``L(x') <= J(x^) = sum_i (1 + beta_i) mu_i^2 <= (1 + max_i beta_i) L(x^)``.
The paper writes ``mu_i = sum_j A_ij |x^_j - B_i|``, lengths before the sum. That mu_i^2 is at least the row's part of
L, not at most, so its last step does not follow; two rays suffice for a counterexample. The chain
holds for any x in place of x^, converged or not, and in projected channels.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_array, hstack
from scipy.sparse.linalg import lsmr
from torch import Tensor

from liftcore.raster.base import Raster
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.solve.diagnostics import ViewMeasures, measure_samples, quantiles
from liftcore.solve.rays import SampledRays, read_pixels, sample_pixels
from liftcore.values.settings import LiftSettings
from liftcore.values.views import NO_LABEL, Regions, ViewFeatures

ROWS = 1 << 14  # rows converted at a time
STEPS = 200  # of LSMR for each channel, at most
TOLERANCE = 1e-6  # of LSMR: of the gradient, relative to the lengths of A and of the residual
FAINTEST = 1e-15  # a shorter column of A does not determine its splat, and its inverse would overflow


def random_axes(channels: int, count: int, seed: int) -> Tensor:
    """Return Gaussian projections [F, count] f32 that keep expected squared lengths (Johnson-Lindenstrauss)."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(channels, count, generator=generator, dtype=torch.float32) / count**0.5


@one_thread()
def compare_with_optimum(
    raster: Raster,
    views: Iterable[tuple[Camera, ViewFeatures, CompositingParams]],
    features: Tensor,
    has_feature: np.ndarray,
    samples: Sequence[SampledRays],
    codebooks: Sequence[Tensor],
    settings: LiftSettings,
    progress: Progress,
) -> dict[str, Any]:
    """Return ``L(x')``, ``L(x^)`` and their ratio over the rays; beta and the bounds at x^ on the sampled rays.

    Args:
        views: cameras, what the lift read of their features, and its strided compositing.
        features: [P, F] f16 or f32, x'. has_feature: [P] bool, the splats to solve for.
        samples, codebooks: of every view.

    Returns:
        Numbers for JSON; None if nothing was sampled or measurable, or a row has no residual.
    """
    axes = random_axes(features.shape[1], settings.reference_channels, settings.seed)
    transpose, targets, unfit, rows = _system(raster, views, axes)
    counts, lifted = np.diff(transpose.indptr), _project(features, axes)
    squares = np.bincount(np.repeat(np.arange(counts.size), counts), transpose.data**2, minlength=counts.size)
    lengths = np.where(has_feature & (squares > FAINTEST**2), np.sqrt(squares), 0.0)
    scale = np.divide(1.0, lengths, out=np.zeros_like(lengths), where=lengths > 0)
    transpose.data *= np.repeat(scale, counts)  # columns of A of length one, as preconditioner
    A, optimum, steps, is_converged = transpose.T, lifted.copy(), 0, True
    residual = least = unfit
    for c in range(axes.shape[1]):
        start = lifted[:, c] * lengths
        solution, reason, iterations, *_ = lsmr(
            A, targets[:, c], atol=TOLERANCE, btol=TOLERANCE, conlim=0.0, maxiter=STEPS, x0=start
        )
        optimum[:, c] = np.where(lengths > 0, solution * scale, lifted[:, c])
        residual += float(np.square(A @ start - targets[:, c]).sum())
        least += float(np.square(A @ solution - targets[:, c]).sum())
        steps, is_converged = max(steps, iterations), is_converged and reason < 7  # 7: STEPS were too few
        progress("reference", c + 1, axes.shape[1], "channels")
    books = [torch.from_numpy(_project(book, axes)).float() for book in codebooks]
    return {
        "channels": axes.shape[1],
        "steps": steps,
        "converged": is_converged,
        "residual": residual / max(rows, 1),
        "optimum": least / max(rows, 1),
        "ratio": residual / least if least > 0 else None,
        **_bounds(measure_samples(samples, torch.from_numpy(optimum).float(), books)),
    }


def _system(
    raster: Raster, views: Iterable[tuple[Camera, ViewFeatures, CompositingParams]], axes: Tensor
) -> tuple[csr_array, np.ndarray, float, int]:
    """Return A^T [P, rays] and the targets [rays, r] f64, both times the root of a ray's number of rows.

    Also the squares that no x fits, as rows of one ray differ, and the number of rows of B.
    """
    parts, targets, unfit, row_count = list[csr_array](), list[np.ndarray](), 0.0, 0
    for camera, observation, params in views:
        pixels = sample_pixels(camera, camera.width * camera.height, (0, 0), params)
        x, y = pixels.numpy().T
        labels = np.full((1, camera.height, camera.width), NO_LABEL, np.int32)
        labels[0, y, x] = np.arange(len(pixels))  # a region a ray: its weights are a column of A^T
        rays = Regions.unchecked(torch.from_numpy(labels), torch.empty(len(pixels), 0))
        weights = raster.region_weights(camera, rays, params, Weighting()).matrix(raster.splats.count)
        part = csr_array(weights, dtype=np.float64)
        readout = read_pixels(observation, camera, pixels)
        rows, taps = readout.columns.shape
        starts, book = np.arange(rows + 1) * taps, _project(observation.codebook, axes)
        B = csr_array((readout.shares.ravel(), readout.columns.ravel(), starts), shape=(rows, len(book))) @ book
        roots = np.sqrt(np.bincount(readout.rays, minlength=len(pixels)))[:, None]
        of_ray = csr_array((np.ones(rows), (readout.rays, np.arange(rows))), shape=(len(pixels), rows))
        targets.append(np.divide(of_ray @ B, roots, out=np.zeros((len(pixels), axes.shape[1])), where=roots > 0))
        part.data *= roots[part.indices, 0]
        parts.append(part)
        unfit += float(np.square(B).sum() - np.square(targets[-1]).sum())
        row_count += rows
    return csr_array(hstack(parts, format="csr")), np.concatenate(targets), max(unfit, 0.0), row_count


def _project(rows: Tensor, axes: Tensor) -> np.ndarray:
    """Project rows [n, F] f16 or f32 to [n, r] f64."""
    parts = [part.double() @ axes.double() for part in rows.split(ROWS)]
    return torch.cat(parts).numpy() if parts else np.zeros((0, axes.shape[1]))


def row_betas(measures: ViewMeasures) -> np.ndarray:
    """Return beta_i [rows] f64 of the theorem, ``sum_j A_ij |x_j - B_i|^2 / mu_i^2 - 1``.

    Infinite where only mu is zero, and NaN where the ray hits no splat.
    """
    ratio = np.ones_like(measures.surrogates)
    np.divide(measures.surrogates, measures.residuals, out=ratio, where=measures.residuals > 0)
    ratio[(measures.residuals == 0) & (measures.surrogates > 0)] = np.inf
    return np.where(np.isnan(measures.betas), np.nan, np.maximum(ratio - 1.0, 0.0))


def _bounds(measures: ViewMeasures) -> dict[str, Any]:
    beta = quantiles(row_betas(measures))
    residual, surrogate = measures.residuals.sum(), measures.surrogates.sum()
    return {
        "beta": beta,
        "bound": None if beta["max"] is None else 1.0 + beta["max"],
        "surrogate_bound": float(surrogate / residual) if residual > 0 and np.isfinite(surrogate) else None,
    }
