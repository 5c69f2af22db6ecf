"""Accuracy against exact truth: classes of splats, and masks of held-out views."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.base import CompositingParams, Raster
    from liftcore.scene.cameras import Camera


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


def mask_iou(mask: Tensor, truth: Tensor) -> float:
    """Intersection over union of two masks [H, W] bool; one where both are empty."""
    union = int((mask | truth).sum())
    return int((mask & truth).sum()) / union if union else 1.0
