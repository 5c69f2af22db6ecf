"""How good lifted features are: beside an exact lift's, in masks of held-out views, rendered beside given ones."""

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from liftcore.features.views import ViewFeatures
from liftcore.raster.base import CompositingParams, Raster
from liftcore.scene.cameras import Camera
from liftcore.solve.geometry import read_pixels, sample_pixels

PIXELS = 1_000  # of a view, whose rendered features are compared with the given ones
LOW_QUANTILE = 0.05
ROWS = 1 << 16  # of features, compared at a time


def cosine_figures(features: Tensor, exact: Tensor, evidence: Tensor) -> dict[str, float | None]:
    """How near the features [P, F] are to the exact ones, over the splats that the exact run saw.

    The mean weighted by evidence, the plain mean, and the quantile below which LOW_QUANTILE of the splats lie. A
    splat that this run did not see counts zero. None where the exact run saw nothing.
    """
    nothing: dict[str, float | None] = {"cosine": None, "cosine_plain": None, "cosine_q05": None}
    if not exact.shape[0]:
        return nothing
    parts, seen = [], []
    for first in range(0, exact.shape[0], ROWS):
        one, other = features[first : first + ROWS].float(), exact[first : first + ROWS].float()
        parts.append(torch.nn.functional.cosine_similarity(one, other, dim=1).double())
        seen.append((other != 0).any(dim=1))
    chosen = torch.cat(seen)
    cosines, weights = torch.cat(parts)[chosen], evidence[chosen].double()
    if not float(weights.sum()) > 0:
        return nothing
    return {
        "cosine": float((cosines * weights).sum() / weights.sum()),
        "cosine_plain": float(cosines.mean()),
        "cosine_q05": float(np.quantile(cosines.numpy(), LOW_QUANTILE)),
    }


def rendered_scores(
    raster: Raster, camera: Camera, features: Tensor, classes: Tensor, walk: CompositingParams
) -> Tensor:
    """Cosine of the rendered features with every class vector, [H, W, K] f32: ``A X`` first, then the classes.

    Rendering is linear, so ``(A X) C^T = A (X C^T)``; only the norm of ``A X`` is left out, which no argmax sees.
    """
    return raster.render(camera, features.to(torch.float32) @ classes.to(torch.float32).T, walk)


def class_ious(labels: Tensor, truth: Tensor, count: int) -> Tensor:
    """IoU of every class over all pixels: labels, truth [...] int -> [count] f64, NaN where absent from both."""
    ious = torch.full((count,), float("nan"), dtype=torch.float64)
    for k in range(count):
        mine, real = labels == k, truth == k
        union = int((mine | real).sum())
        if union:
            ious[k] = int((mine & real).sum()) / union
    return ious


def view_cosines(
    raster: Raster, camera: Camera, observation: ViewFeatures, features: Tensor, walk: CompositingParams
) -> np.ndarray:
    """Cosine of ``A x`` with every row of B that PIXELS sampled pixels of a view read, [n] f32.

    A pixel has a row of B a labelled level, or one of a grid. One whose ray meets nothing counts as zero.

    Args:
        features: [P, F].
    """
    pixels = sample_pixels(camera, PIXELS, (0, 0), walk)
    rays = raster.ray_rows(camera, pixels, walk)
    readout = read_pixels(observation, camera, pixels)
    used, places = np.unique(rays.splats.numpy(), return_inverse=True)
    entries = (rays.weights.numpy(), places, rays.indptr.numpy())
    A = csr_array(entries, shape=(len(pixels), len(used)))
    rendered = torch.from_numpy((A @ features[torch.from_numpy(used).long()].float().numpy())[readout.rays])
    return torch.nn.functional.cosine_similarity(rendered, readout.observed(observation.codebook), dim=1).numpy()
