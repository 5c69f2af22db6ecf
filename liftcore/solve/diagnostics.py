"""Diagnostics of a lift: measures on a sample of rays, and warnings.

All sums are over the sampled rays and the A of the lift: with its opacity gain, but with power 1 and all weights of
the ray, for any selection of weights. So the residual is that of the rendered features, not of the selected weights.
With a stride, rays are sampled among those of the lift; B is read at the lift's ``levels``::

    L(x') = mean_i || sum_j A_ij x_j - B_i ||^2          J(x') = mean_i sum_j A_ij || x_j - B_i ||^2
    Delta_ij = || x_j - B_i ||,  mu_i = sum_j a_ij Delta_ij,  beta_i = sum_j a_ij (Delta_ij^2 - mu_i^2) / mu_i^2

``L <= J`` (Jensen) where rows sum to one; a ray that hits no splat has ``L = ||B||^2`` and ``J = 0``.
Here ``a_ij = A_ij / sum_j A_ij``; a ray that hits no splat has no beta. A ray has a row i for each labelled level.
The paper defines beta at the optimum x^; here it is measured at the result x', so ``1 + beta`` is an indicator and
not a bound. `liftcore.solve.optimum` computes x^ and the beta of the theorem.
"""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.runtime.cores import cores
from liftcore.runtime.one_line import join_names
from liftcore.runtime.one_thread import one_thread
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import LOW_PASS, MAX_LOG_SCALE
from liftcore.scene.splats import Splats
from liftcore.solve.rays import SampledRays
from liftcore.values.pack import Views
from liftcore.values.settings import LiftSettings

_MU_FLOOR = 1e-6  # of the observation's length


@dataclass(frozen=True)
class ViewMeasures:
    """Per-row measures of sampled rays."""

    row_sums: np.ndarray  # [n] f64, one value per ray
    residuals: np.ndarray  # [rows] f64, ||A x - B||^2
    surrogates: np.ndarray  # [rows] f64, sum_j A ||x_j - B||^2
    betas: np.ndarray  # [rows] f64; NaN where the ray hits no splat


def compute_diagnostics(
    measures: ViewMeasures, sums: np.ndarray, total_weight: Tensor, settings: LiftSettings
) -> dict[str, Any]:
    """Summarise the measures of the sampled rays.

    Args:
        measures: of the rays of all views (`measure_samples`).
        sums: [P] f64, of rows of W. total_weight: [P] f32.

    Returns:
        Numbers for JSON; None if nothing was sampled, or squares overflow float32.
    """
    row_sums, residuals = measures.row_sums, measures.residuals
    beta = quantiles(measures.betas)
    return {
        "rays": int(row_sums.size),
        "rows": int(residuals.size),
        "alpha_gain": settings.gain,
        "row_sum_mean": _mean(row_sums),
        "row_sum_std": float(row_sums.std()) if row_sums.size else None,
        "row_sum_min": float(row_sums.min()) if row_sums.size else None,
        "residual": _mean(residuals),
        "surrogate": _mean(measures.surrogates),
        "beta": beta,
        "bound": None if beta["max"] is None else 1.0 + beta["max"],
        "feature_share": float((sums > 0).mean()),
        "total_weight_over_half_share": float((total_weight > 0.5).float().mean()),
    }


@one_thread()
def measure_samples(
    samples: Sequence[SampledRays], features: Tensor, codebooks: Sequence[Tensor], threads: int | None = None
) -> ViewMeasures:
    """Measure the sampled rays of all views, one view after the other: features [P, C], codebooks [M, C]."""
    with ThreadPoolExecutor(threads or cores()) as pool:
        views = list(pool.map(lambda sample, book: measure_view(sample, features, book), samples, codebooks))
    names = [part.name for part in fields(ViewMeasures)]
    return ViewMeasures(*(np.concatenate([getattr(view, name) for view in views]) for name in names))


def measure_view(sample: SampledRays, features: Tensor, codebook: Tensor) -> ViewMeasures:
    """Compute row sums, residuals, surrogates and betas of one view's sampled rays."""
    starts, splats = sample.rows.indptr.tolist(), sample.rows.splats.long()
    weights, readout = sample.rows.weights.double().numpy(), sample.readout
    B, order = readout.observed(codebook).double().numpy(), np.argsort(readout.rays, kind="stable")
    ends = np.searchsorted(readout.rays, np.arange(len(starts)), sorter=order)
    row_sums, measures = np.zeros(len(starts) - 1), np.zeros((B.shape[0], 3))
    for ray in range(row_sums.size):
        hits, rows = slice(starts[ray], starts[ray + 1]), order[ends[ray] : ends[ray + 1]]
        row_sums[ray] = weights[hits].sum()
        measures[rows] = measure_rows(weights[hits], features[splats[hits]].double().numpy(), B[rows])
    return ViewMeasures(row_sums, *measures.T)


def measure_rows(weights: np.ndarray, X: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return residual, surrogate and beta of the rows of one ray, [rows, 3] f64.

    Args:
        weights: [n] f64, of the ray's splats. X: [n, F] f64, of these. B: [rows, F] f64.
    """
    total = weights.sum()
    residuals = np.square(weights @ X - B).sum(axis=1)
    lengths = np.einsum("rf,rf->r", B, B)
    squares = (lengths[:, None] - 2.0 * (B @ X.T) + np.einsum("nf,nf->n", X, X)).clip(min=0.0)
    surrogates, distances = squares @ weights, np.sqrt(squares) @ weights
    # A row whose splats all equal its observation has no dispersion.
    disperse = distances > _MU_FLOOR * total * np.sqrt(lengths)
    betas = np.divide(surrogates * total, distances**2, out=np.ones_like(surrogates), where=disperse) - 1.0
    return np.stack([residuals, surrogates, betas.clip(min=0.0) if total else np.full(len(B), np.nan)], axis=1)


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if values.size and np.isfinite(values).all() else None


def quantiles(values: np.ndarray) -> dict[str, float | None]:
    """Return median, p99 and max of the values without NaN; None if there are none, or for infinite results."""
    values = values[~np.isnan(values)]
    if not values.size:
        return {"median": None, "p99": None, "max": None}
    with np.errstate(invalid="ignore"):  # NaN between two infinite values
        statistics = {"median": np.median(values), "p99": np.quantile(values, 0.99), "max": values.max()}
    return {name: float(value) if np.isfinite(value) else None for name, value in statistics.items()}


MOSTLY = 0.5  # share of the splats, or of the views, from which a warning is given
FAINT = 1e-30  # sum of weights whose terms are near the smallest float32 numbers
UNSEEN = "splats were reached by no labelled ray; they have no features of their own"
NAMES = 3  # printed in a warning
POSES = "poses are world to camera, with x right, y down and z forward"
SAMPLE = 10_000  # splats whose depths are checked, evenly over the file


def lift_warnings(
    splats: Splats,
    views: Sequence[Camera],
    sums: np.ndarray,
    requested: str,
    stored: torch.dtype,
    facts: Mapping[str, Any],
) -> list[str]:
    """Return the warnings of a lift.

    Args:
        views: the lifted cameras. sums: [P] f64, of the weights of labelled rays, to their power.
        requested, stored: requested and actual dtype of the features.
        facts: of the diagnostics: ``views_without_camera`` and ``views_without_splats``, names.
    """
    warnings = []
    without_camera, empty = facts["views_without_camera"], facts["views_without_splats"]
    if without_camera:
        message = f"{len(without_camera)} views have features but no camera and were skipped"
        warnings.append(f"{message}: {join_names(without_camera, NAMES)}{_folders_of(views)}")
    if empty:
        message = f"{len(empty)} of {len(views)} views meet no splat: {join_names(empty, NAMES)}"
        warnings.append(message + (f"; {POSES}" if len(empty) > MOSTLY * len(views) else ""))
    unseen, faint = int((sums == 0).sum()), int(((sums > 0) & (sums < FAINT)).sum())
    if unseen == len(sums):
        warnings.append("no labelled ray reached any splat: check that splats and cameras share their frame")
    elif unseen > MOSTLY * len(sums):
        warnings.append(f"{unseen} of {len(sums)} {UNSEEN}")
    if faint:
        warnings.append(f"{faint} of {len(sums)} splats weigh less than {FAINT:g}, where float32 loses digits")
    if requested not in str(stored):
        name = str(stored).removeprefix("torch.")
        warnings.append(f"features are stored as {name}: {requested} does not hold vectors of their length")
    return warnings + order_warnings(splats, views)


def order_warnings(splats: Splats, views: Sequence[Camera]) -> list[str]:
    """Return a warning if most splats are so far from a camera that float32 depths are coarser than their footprints.

    Depths are sorted as float32, whose spacing at z is about ``z 2^-23``; splats within one spacing are composited in
    the order of the file. A footprint has the size of its splat or of its low-pass, whichever is larger.
    """
    step = -(-splats.count // SAMPLE)
    size = np.exp(splats.log_scales[::step].amax(dim=1).double().numpy().clip(max=MAX_LOG_SCALE))
    means = splats.means[::step].double().numpy()
    coarse = []
    for camera in views:
        axis = camera.about(splats.origin).viewmat[2]
        z = means @ axis[:3] + axis[3]
        in_front = z > 0
        blur = math.sqrt(LOW_PASS) * z / max(camera.fx, camera.fy)
        steps = np.spacing(z.astype(np.float32))
        if in_front.any() and (steps > np.maximum(size, blur))[in_front].mean() > MOSTLY:
            coarse.append(camera.name)
    if not coarse:
        return []
    return [
        f"{len(coarse)} of {len(views)} views are so far from the splats that float32 depths cannot order most of "
        f"them: {join_names(coarse, NAMES)}"
    ]


def _folders_of(views: Sequence[Camera]) -> str:
    """Return advice if cameras are named with their folders, as those of a rig; else an empty text."""
    example = next((camera.name for camera in views if "/" in camera.name), None)
    return f"; cameras are named with their folders here, such as {example}: name views like them" if example else ""


CELL = 1  # cells of a map, and pixels of its image, by which rounding may change a side


def shape_warnings(packs: Views, views: Sequence[Camera]) -> list[str]:
    """Return a warning if maps are stretched over their images, else none.

    Maps of any aspect are stretched over their image unless their fit is recorded, as some encoders squeeze images
    into squares. These cannot be distinguished from crops, so no lift is refused.
    """
    unrecorded = [camera for camera in views if not packs.fit(camera.name)]
    stretched = [camera for camera in unrecorded if is_stretched(packs.map_size(camera.name), camera.photo_size)]
    if not stretched:
        return []
    (width, height), (W, H) = packs.map_size(stretched[0].name), stretched[0].photo_size
    return [
        f"{len(stretched)} of {len(views)} views have maps of another aspect than their images "
        f"({stretched[0].name}: {width}x{height} for {W}x{H}), over which they are stretched: check that they are "
        "[rows, columns], channels last, or say if the encoder's preprocessing stretched the photos, or did pad, "
        "pad-end or crop them (pack npy --map-fit, in Python FeatureGrid(map, fit=)); splatlift check compares these"
    ]


def is_stretched(size: tuple[int, int], photo: tuple[int, int]) -> bool:
    """Return True if no scale maps both sides of the image to those of the map, to one cell or one pixel."""
    (width, height), (W, H) = size, photo
    wide = (width - CELL) * (H - CELL) > (height + CELL) * (W + CELL)
    return wide or (height - CELL) * (W - CELL) > (width + CELL) * (H + CELL)
