"""What a lift measured of itself, on a stated sample of rays, and what it cannot answer for, in sentences.

All sums are over the sampled rays and the A that the lift used: its opacity gain, but power 1 and every weight of
the ray, whatever the preset selects. So the residual says how the answer renders, not how well it fits the weights
that were kept. With a stride, rays are sampled among those that the lift saw; B is read as its ``levels`` say::

    L(x') = mean_i || sum_j A_ij x_j - B_i ||^2          J(x') = mean_i sum_j A_ij || x_j - B_i ||^2
    Delta_ij = || x_j - B_i ||,  mu_i = sum_j a_ij Delta_ij,  beta_i = sum_j a_ij (Delta_ij^2 - mu_i^2) / mu_i^2

``L <= J`` (Jensen) where rows sum to one; a ray that meets nothing has ``L = ||B||^2`` and ``J = 0``.
Here ``a_ij = A_ij / sum_j A_ij``; a ray that meets nothing has no beta. A ray has a row i for each labelled level.
The paper defines beta at the optimum x^; here it is measured at the answer x', which is what a user has, and so
``1 + beta`` here is a sign and no proof.
`least_squares.reference` finds x^, and says which beta the theorem is about.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.runtime.cores import cores
from liftcore.runtime.jit import vectorised
from liftcore.runtime.one_thread import one_thread
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import LOW_PASS, MAX_LOG_SCALE
from liftcore.scene.splats import Splats
from liftcore.solve.codebook import row_lengths
from liftcore.solve.rays import SampledRays
from liftcore.values.pack import Views
from liftcore.values.settings import LiftSettings

_CHUNK_VALUES = 1 << 21  # float32 values gathered at a time: 8 MB, as larger ones are fresh pages every time
_READS_A_RAY = 8  # levels or taps of a ray; few scenes have more
_MU_FLOOR = 1e-6  # of the longest vector: a row whose splats all equal what it observed has no dispersion
_SCALES = 120  # powers of two that float32 divides and multiplies by without a rounding


@dataclass(frozen=True)
class ViewMeasures:
    """Per-row measures of sampled rays."""

    row_sums: np.ndarray  # [n] f64, a value a ray
    residuals: np.ndarray  # [rows] f64, ||A x - B||^2
    surrogates: np.ndarray  # [rows] f64, sum_j A ||x_j - B||^2
    betas: np.ndarray  # [rows] f64; NaN where the ray meets nothing


def certify(measures: ViewMeasures, sums: np.ndarray, total_weight: Tensor, settings: LiftSettings) -> dict[str, Any]:
    """What the sampled rays say of a lift.

    Args:
        measures: of the rays of all views (`measure_samples`).
        sums: [P] f64, of rows of W. total_weight: [P] f32.

    Returns:
        Plain numbers, ready for JSON; None where nothing was sampled, or where float32 has no squares.
    """
    row_sums, residuals = measures.row_sums, measures.residuals
    beta = quantiles(measures.betas)
    return {
        "rays": int(row_sums.size),
        "rows": int(residuals.size),
        "alpha_gain": settings.lift_gain,
        "row_sum_mean": _mean(row_sums),
        "row_sum_std": float(row_sums.std()) if row_sums.size else None,
        "row_sum_min": float(row_sums.min()) if row_sums.size else None,
        "residual": _mean(residuals),
        "surrogate": _mean(measures.surrogates),
        "beta": beta,
        "bound": None if beta["max"] is None else 1.0 + beta["max"],
        "seen_share": float((sums > 0).mean()),
        "evidence_over_half_share": float((total_weight > 0.5).float().mean()),
    }


@one_thread()
def measure_samples(
    samples: Sequence[SampledRays], features: Tensor, codebooks: Sequence[Tensor], threads: int | None = None
) -> ViewMeasures:
    """The measures of all views' sampled rays, one view after the other: features [P, C], codebooks [M, C]."""
    with ThreadPoolExecutor(threads or cores()) as pool:
        return joined(list(pool.map(lambda sample, book: measure_view(sample, features, book), samples, codebooks)))


def joined(views: Sequence[ViewMeasures]) -> ViewMeasures:
    """The measures of all views, one view after the other."""
    names = [part.name for part in fields(ViewMeasures)]
    return ViewMeasures(*(np.concatenate([getattr(view, name) for view in views]) for name in names))


def measure_view(sample: SampledRays, features: Tensor, codebook: Tensor) -> ViewMeasures:
    """Row sums, residuals, surrogates and betas of one view's sampled rays."""
    starts = sample.rows.indptr.numpy()
    lengths = np.diff(starts)
    ray_of_entry = np.repeat(np.arange(lengths.size), lengths)
    weights = sample.rows.weights.numpy().astype(np.float64)
    row_sums = np.bincount(ray_of_entry, weights, minlength=lengths.size)
    readout, splats = sample.readout, sample.rows.splats.long()
    longest = float(row_lengths(codebook).max()) if codebook.numel() else 0.0
    scale = 2.0 ** round(math.log2(min(max(longest, 2.0**-_SCALES), 2.0**_SCALES)))  # squares of others have no place
    measures, by_ray = np.zeros((readout.rays.size, 3)), np.argsort(readout.rays, kind="stable")
    for first, last in _ray_chunks(starts, _CHUNK_VALUES // features.shape[1]):
        chosen = by_ray[slice(*np.searchsorted(readout.rays, [first, last], sorter=by_ray))]
        X = features[splats[starts[first] : starts[last]]].float()  # [entries, F]
        B = readout.rows(chosen).observed(codebook)  # [rows, F]
        if scale != 1.0:
            X, B = X.div_(scale), B.div_(scale)
        own_starts, own_weights = starts[first : last + 1] - starts[first], weights[starts[first] : starts[last]]
        measures[chosen] = measure_rows(readout.rays[chosen] - first, own_starts, own_weights, X.numpy(), B.numpy())
    measures[:, :2] *= scale**2
    measures[row_sums[readout.rays] == 0, 2] = np.nan
    return ViewMeasures(row_sums, measures[:, 0], measures[:, 1], measures[:, 2])


def _ray_chunks(starts: np.ndarray, entries: int) -> Iterator[tuple[int, int]]:
    """Ranges of rays that together have at most so many entries, or one ray each; and at most so many rays."""
    first, rays = 0, starts.size - 1
    while first < rays:
        fitting = int(np.searchsorted(starts, starts[first] + entries, side="right")) - 1
        last = min(max(fitting, first + 1), first + max(entries // _READS_A_RAY, 1), rays)
        yield first, last
        first = last


@vectorised
def measure_rows(rays, starts, weights, X, B):
    """Residual, surrogate and beta of every row, [rows, 3] f64.

    Args:
        rays: [rows] i64 ascending, the ray of a row. starts: [n + 1] i64, each ray's entries.
        weights: [entries] f64. X: [entries, F] f32, the entries' splats. B: [rows, F] f32.
    """
    measures = np.zeros((rays.shape[0], 3))
    channels = B.shape[1]
    rendered = np.empty(channels, np.float32)
    for row in range(rays.shape[0]):
        begin, end = starts[rays[row]], starts[rays[row] + 1]
        if row == 0 or rays[row] != rays[row - 1]:
            rendered[:] = 0
            for entry in range(begin, end):
                small_weight = np.float32(weights[entry])
                for c in range(channels):
                    rendered[c] += small_weight * X[entry, c]
        observed = B[row]
        surrogate = distance = total = 0.0
        for entry in range(begin, end):
            weight, lifted = weights[entry], X[entry]
            square = np.float32(0.0)
            for c in range(channels):
                difference = lifted[c] - observed[c]
                square += difference * difference
            surrogate += weight * square
            distance += weight * math.sqrt(square)
            total += weight
        residual = np.float32(0.0)
        for c in range(channels):
            difference = rendered[c] - observed[c]
            residual += difference * difference
        measures[row, 0] = residual
        measures[row, 1] = surrogate
        if distance > _MU_FLOOR * total:
            measures[row, 2] = max(surrogate * total / distance**2 - 1.0, 0.0)
    return measures


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if values.size and np.isfinite(values).all() else None


def quantiles(values: np.ndarray) -> dict[str, float | None]:
    """Median, p99 and max of what is a number; None where there is none, or no finite one."""
    values = values[~np.isnan(values)]
    if not values.size:
        return {"median": None, "p99": None, "max": None}
    with np.errstate(invalid="ignore"):  # between two infinite values NumPy finds no number
        found = {"median": np.median(values), "p99": np.quantile(values, 0.99), "max": values.max()}
    return {name: float(value) if np.isfinite(value) else None for name, value in found.items()}


MOSTLY = 0.5  # of the splats, or of the views; below it, what was not seen is most of the answer
FAINT = 1e-30  # of a sum of weights: its terms come near the smallest numbers of float32
UNSEEN = "splats were reached by no labelled ray; they have no features of their own"
NAMES = 3  # that a sentence shows
POSES = "poses are world to camera, with x right, y down and z forward"
SAMPLE = 10_000  # splats whose depths are looked at, evenly over the file


def lift_warnings(
    splats: Splats,
    views: Sequence[Camera],
    sums: np.ndarray,
    asked: str,
    stored: torch.dtype,
    facts: Mapping[str, Any],
) -> list[str]:
    """Warnings of a lift.

    Args:
        views: the cameras that were lifted. sums: [P] f64, of the weights of labelled rays, to their power.
        asked, stored: the type that features were to have, and have.
        facts: of the certificate: ``views_without_camera`` and ``views_without_splats``, names.
    """
    warnings = []
    skipped, empty = facts["views_without_camera"], facts["views_without_splats"]
    if skipped:
        told = f"{len(skipped)} views have features but no camera and were skipped: {_some(skipped)}"
        warnings.append(told + _folders_of(views))
    if empty:
        told = f"{len(empty)} of {len(views)} views meet no splat: {_some(empty)}"
        warnings.append(told + (f"; {POSES}" if len(empty) > MOSTLY * len(views) else ""))
    unseen, faint = int((sums == 0).sum()), int(((sums > 0) & (sums < FAINT)).sum())
    if unseen == len(sums):
        warnings.append("no labelled ray reached any splat: check that splats and cameras share their frame")
    elif unseen > MOSTLY * len(sums):
        warnings.append(f"{unseen} of {len(sums)} {UNSEEN}")
    if faint:
        warnings.append(f"{faint} of {len(sums)} splats weigh less than {FAINT:g}, where float32 loses digits")
    if asked not in str(stored):
        name = str(stored).removeprefix("torch.")
        warnings.append(f"features are stored as {name}: {asked} does not hold vectors of their length")
    return warnings + order_warnings(splats, views)


def order_warnings(splats: Splats, views: Sequence[Camera]) -> list[str]:
    """A warning where most splats lie so far from a camera that float32 depths are coarser than their footprints.

    Depths are sorted as float32, whose step at z is about ``z 2^-23``; splats within a step of each other are walked
    in the order of the file. A footprint is as large as its splat or its low-pass, whichever is larger.
    """
    step = -(-splats.count // SAMPLE)
    size = np.exp(splats.log_scales[::step].amax(dim=1).double().numpy().clip(max=MAX_LOG_SCALE))
    means = splats.means[::step].double().numpy()
    coarse = []
    for camera in views:
        axis = camera.about(splats.origin).viewmat[2]
        z = means @ axis[:3] + axis[3]
        ahead = z > 0
        blur = math.sqrt(LOW_PASS) * z / max(camera.fx, camera.fy)
        steps = np.spacing(z.astype(np.float32))
        if ahead.any() and (steps > np.maximum(size, blur))[ahead].mean() > MOSTLY:
            coarse.append(camera.name)
    if not coarse:
        return []
    return [
        f"{len(coarse)} of {len(views)} views are so far from the splats that float32 depths cannot order most of "
        f"them: {_some(coarse)}"
    ]


def _folders_of(views: Sequence[Camera]) -> str:
    """What to do where cameras are named with their folders, as those of a rig are."""
    example = next((camera.name for camera in views if "/" in camera.name), None)
    return f"; cameras are named with their folders here, such as {example}: name views like them" if example else ""


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:NAMES])


FEW_CELLS = 4  # on a side; of fewer a shape says little
FAR = 2.0  # times wider or narrower than the image: square maps of photos are nearer
CELL = 1  # cells of a map, and pixels of its image, that rounding to whole ones may add or take on a side
TURNED = 1.2  # times nearer to the image's shape when rows and columns are swapped


def shape_warnings(packs: Views, views: Sequence[Camera]) -> list[str]:
    """Warnings where maps are far from the shape of their images or nearer to it when turned, or else stretched.

    Maps of any shape are stretched over their image, as some encoders squeeze images into squares; what they cannot
    be told from is a crop, so no lift is refused.
    """
    odd, stretched = [], []
    for camera in views:
        size = packs.map_size(camera.name)
        photo = _photo(packs, camera)
        if _odd(size, photo):
            odd.append(camera)
        elif is_stretched(size, photo):
            stretched.append(camera)
    advice = {
        "of another shape than their images{}: see that they are [rows, columns], channels last": odd,
        "of another aspect than their images{}, over which they are stretched: maps must cover the whole image, and "
        "those of a centre crop do not": stretched,
    }
    return [
        f"{len(found)} of {len(views)} views have maps {text.format(_shapes(packs, found[0]))}"
        for text, found in advice.items()
        if found
    ]


def _shapes(packs: Views, camera: Camera) -> str:
    (width, height), (W, H) = packs.map_size(camera.name), _photo(packs, camera)
    return f" ({camera.name}: {width}x{height} for {W}x{H})"


def _photo(packs: Views, camera: Camera) -> tuple[int, int]:
    face = (packs.seeing(camera.name) or camera).face  # None of a map of the face itself
    return camera.photo_size if face is None else (face.width, face.height)


def _odd(size: tuple[int, int], photo: tuple[int, int]) -> bool:
    (width, height), (W, H) = size, photo
    if min(width, height) < FEW_CELLS:
        return False
    off, turned = (_factor(ratio * H / W) for ratio in (width / height, height / width))
    return off > FAR or off > TURNED * turned


def is_stretched(size: tuple[int, int], photo: tuple[int, int]) -> bool:
    """Whether no scale makes both sides of the image those of the map, to a cell, nor to a pixel of the image."""
    (width, height), (W, H) = size, photo
    wide = (width - CELL) * (H - CELL) > (height + CELL) * (W + CELL)
    return wide or (height - CELL) * (W - CELL) > (width + CELL) * (H + CELL)


def _factor(ratio: float) -> float:
    return max(ratio, 1.0 / ratio)
