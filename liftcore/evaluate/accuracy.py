"""How good lifted features are: classes of splats, masks of held-out views, rendered features beside given ones."""

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from liftcore.features.views import ViewFeatures
from liftcore.raster.base import CompositingParams, Raster
from liftcore.scene.cameras import Camera
from liftcore.solve.readout import read_pixels, sample_pixels

PIXELS = 1_000  # of a view, whose rendered features are compared with the given ones


def class_scores(features: Tensor, classes: Tensor) -> Tensor:
    """Cosine of every splat with every class vector: features [P, F], classes [K, F] unit -> [P, K] f32."""
    parts = []
    for block in features.split(65_536):
        rows = block.to(torch.float32)
        norms = torch.linalg.vector_norm(rows, dim=1, keepdim=True).clamp_min(1e-12)
        parts.append(rows / norms @ classes.to(torch.float32).T)
    return torch.cat(parts)


def splat_accuracy(scores: Tensor, truth: Tensor, counted: Tensor) -> float:
    """Share of the counted splats [P] bool whose best class equals the truth [P]."""
    return float((scores.argmax(dim=1) == truth.long())[counted].float().mean())


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


def mask_iou(mask: Tensor | np.ndarray, truth: Tensor | np.ndarray) -> float:
    """Intersection over union of two masks [H, W] bool; one where both are empty."""
    mask, truth = torch.as_tensor(mask), torch.as_tensor(truth)
    union = int((mask | truth).sum())
    return int((mask & truth).sum()) / union if union else 1.0


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
