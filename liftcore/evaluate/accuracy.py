"""How good lifted features are: beside an exact lift's, in masks of held-out views, rendered beside given ones."""

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

PIXELS = 1_000  # of a view, whose rendered features are compared with the given ones
LEAST_PIXELS = 5  # of them, for the mean of a region
EVERY_PIXEL = CompositingParams()
LOW_QUANTILE = 0.05
ROWS = 1 << 16  # of features, compared at a time


def cosine_figures(features: Tensor, exact: Tensor, total_weight: Tensor) -> dict[str, float | None]:
    """How near the features [P, F] are to the exact ones, over the splats that the exact run saw.

    The mean weighted by total weight, the plain mean, the quantile below which LOW_QUANTILE of the splats lie, and
    the share that has lost its feature, which counts zero. None where the exact run saw nothing.
    """
    nothing: dict[str, float | None] = dict.fromkeys(("cosine", "cosine_plain", "cosine_q05", "lost_share"))
    if not exact.shape[0]:
        return nothing
    parts, seen, lost = [], [], 0
    for first in range(0, exact.shape[0], ROWS):
        one, other = features[first : first + ROWS].float(), exact[first : first + ROWS].float()
        parts.append(torch.nn.functional.cosine_similarity(one, other, dim=1).double())
        seen.append((other != 0).any(dim=1))
        lost += int((seen[-1] & (one == 0).all(dim=1)).sum())
    chosen = torch.cat(seen)
    cosines, weights = torch.cat(parts)[chosen], total_weight[chosen].double()
    if not float(weights.sum()) > 0:
        return nothing
    return {
        "cosine": float((cosines * weights).sum() / weights.sum()),
        "cosine_plain": float(cosines.mean()),
        "lost_share": lost / len(weights),
        "cosine_q05": float(np.quantile(cosines.numpy(), LOW_QUANTILE)),
    }


def rendered_scores(
    raster: Raster, camera: Camera, features: Tensor, classes: Tensor, walk: CompositingParams
) -> Tensor:
    """Cosine of the rendered features with every class vector, [H, W, K] f32: ``A X`` first, then the classes.

    Rendering is linear, so ``(A X) C^T = A (X C^T)``; only the norm of ``A X`` is left out, which no argmax sees.
    """
    return raster.render(camera, features.to(torch.float32) @ classes.to(torch.float32).T, walk)


def shared_pixels(labels: Tensor, truth: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """[count] i64 each: pixels that labels and truth [...] int have in common, and that either has, by class."""
    both = [((labels == k), (truth == k)) for k in range(count)]
    pairs = [(int((mine & real).sum()), int((mine | real).sum())) for mine, real in both]
    shared, joined = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2).unbind(dim=1)
    return shared, joined


def class_ious(labels: Tensor, truth: Tensor, count: int) -> Tensor:
    """IoU of every class over all pixels: labels, truth [...] int -> [count] f64, NaN where absent from both."""
    shared, joined = shared_pixels(labels, truth, count)
    return torch.where(joined > 0, shared.double() / joined, float("nan"))


def centred_cosines(
    raster: Raster,
    views: Sequence[tuple[Camera, ViewFeatures]],
    features: Tensor,
    walk: CompositingParams,
) -> list[float]:
    """How like the features rendered into views are to what these observe: a mean cosine a view.

    Both are made unit and centred on the mean of what all the views observe: encoders' vectors share a cone, in which
    raw cosines are all high and those of blurred features the highest. Each region counts alike, or each pixel of a
    grid: a mask that merges two things is large, and pleases features that are merged as well. Of PIXELS sampled
    pixels a ray that meets nothing counts zero; regions of fewer than LEAST_PIXELS of them are left out, and so are
    views without any other.

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
        rays = raster.ray_rows(camera, pixels, walk)
        used, places = np.unique(rays.splats.numpy(), return_inverse=True)
        entries = (rays.weights.numpy(), places, rays.indptr.numpy())
        A = csr_array(entries, shape=(len(pixels), len(used)))
        rendered = torch.from_numpy((A @ features[torch.from_numpy(used).long()].float().numpy())[readout.rays])
        directions = torch.nn.functional.normalize(rendered, dim=1) - mean
        cosines = torch.nn.functional.cosine_similarity(directions, observed - mean, dim=1)
        found = torch.where((rendered != 0).any(dim=1), cosines, 0.0).numpy()
        if isinstance(view, Regions):
            _, region, counts = np.unique(readout.columns[:, 0], return_inverse=True, return_counts=True)
            found = (np.bincount(region, found) / counts)[counts >= LEAST_PIXELS]
        figures += [float(found.mean())] if found.size else []
    return figures


def _unit_rows(camera: Camera, view: ViewFeatures) -> tuple[Tensor, Readout, Tensor]:
    """Sampled pixels [n, 2], their rows of S, and those of B, made unit; a row a labelled level, or one of a grid."""
    pixels = sample_pixels(camera, PIXELS, (0, 0), EVERY_PIXEL)
    readout = read_pixels(view, camera, pixels)
    return pixels, readout, torch.nn.functional.normalize(readout.observed(view.codebook), dim=1)
