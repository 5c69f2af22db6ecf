"""Accuracy of lifted features: against an exact lift, in masks of held-out views, and rendered into views."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from liftcore.raster.base import Raster
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams
from liftcore.solve.rays import Readout, read_pixels, sample_pixels
from liftcore.values.views import Regions, ViewFeatures

PIXELS = 1_000  # of a view, whose rendered features are compared with the observed ones
LEAST_PIXELS = 5  # of these, for the mean of a region
EVERY_PIXEL = CompositingParams()
LOW_QUANTILE = 0.05
ROWS = 1 << 16  # of features, compared at a time


def cosine_figures(features: Tensor, exact: Tensor, total_weight: Tensor) -> dict[str, float | None]:
    """Compute the cosines of the features [P, F] to the exact ones, over the splats that have an exact feature.

    The mean weighted by total weight, the unweighted mean, the LOW_QUANTILE quantile, and the share of splats whose
    feature is lost; their cosine is zero. None if no splat has an exact feature.
    """
    no_figures: dict[str, float | None] = dict.fromkeys(("cosine", "cosine_plain", "cosine_q05", "lost_share"))
    if not exact.shape[0]:
        return no_figures
    parts, nonzero, lost_count = [], [], 0
    for first in range(0, exact.shape[0], ROWS):
        actual, expected = features[first : first + ROWS].float(), exact[first : first + ROWS].float()
        parts.append(torch.nn.functional.cosine_similarity(actual, expected, dim=1).double())
        nonzero.append((expected != 0).any(dim=1))
        lost_count += int((nonzero[-1] & (actual == 0).all(dim=1)).sum())
    mask = torch.cat(nonzero)
    cosines, weights = torch.cat(parts)[mask], total_weight[mask].double()
    if not float(weights.sum()) > 0:
        return no_figures
    return {
        "cosine": float((cosines * weights).sum() / weights.sum()),
        "cosine_plain": float(cosines.mean()),
        "lost_share": lost_count / len(weights),
        "cosine_q05": float(np.quantile(cosines.numpy(), LOW_QUANTILE)),
    }


def shared_pixels(labels: Tensor, truth: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Count the pixels of intersection and union of labels and truth [...] int, by class: [count] i64 each."""
    masks = [((labels == k), (truth == k)) for k in range(count)]
    pairs = [(int((predicted & true).sum()), int((predicted | true).sum())) for predicted, true in masks]
    shared, union = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2).unbind(dim=1)
    return shared, union


def centred_cosines(
    raster: Raster, views: Sequence[tuple[Camera, ViewFeatures]], features: Tensor, params: CompositingParams
) -> list[float]:
    """Compute the mean cosine of rendered and observed features, a figure a view.

    Both are normalised and centred on the mean of all observed features: an encoder's vectors lie in a cone, where
    raw cosines are all high, and highest for blurred features. Each region has the same weight, or each pixel of a
    grid: a mask that merges two objects is large, and would favour features that are merged as well. Of PIXELS
    sampled pixels a ray that hits nothing counts zero. Regions of fewer than LEAST_PIXELS of them are left out, and
    so are views without any other region.

    Args:
        features: [P, F].
    """
    total, count = torch.zeros(features.shape[1], dtype=torch.float64), 0
    for camera, view in views:
        observed = _unit_rows(camera, view)[2]
        total, count = total + observed.double().sum(dim=0), count + len(observed)
    mean, figures = (total / max(count, 1)).float(), list[float]()
    for camera, view in views:
        pixels, readout, observed = _unit_rows(camera, view)
        rays = raster.ray_rows(camera, pixels, params)
        splats, columns = np.unique(rays.splats.numpy(), return_inverse=True)
        entries = (rays.weights.numpy(), columns, rays.indptr.numpy())
        A = csr_array(entries, shape=(len(pixels), len(splats)))
        rendered = torch.from_numpy((A @ features[torch.from_numpy(splats).long()].float().numpy())[readout.rays])
        directions = torch.nn.functional.normalize(rendered, dim=1) - mean
        cosines = torch.nn.functional.cosine_similarity(directions, observed - mean, dim=1)
        values = torch.where((rendered != 0).any(dim=1), cosines, 0.0).numpy()
        if isinstance(view, Regions):
            _, region, counts = np.unique(readout.columns[:, 0], return_inverse=True, return_counts=True)
            values = (np.bincount(region, values) / counts)[counts >= LEAST_PIXELS]
        figures += [float(values.mean())] if values.size else []
    return figures


def _unit_rows(camera: Camera, view: ViewFeatures) -> tuple[Tensor, Readout, Tensor]:
    """Return sampled pixels [n, 2], their rows of S, and their unit rows of B, a row a level."""
    pixels = sample_pixels(camera, PIXELS, (0, 0), EVERY_PIXEL)
    readout = read_pixels(view, camera, pixels)
    return pixels, readout, torch.nn.functional.normalize(readout.observed(view.codebook), dim=1)
