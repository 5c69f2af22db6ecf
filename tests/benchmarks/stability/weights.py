"""Every way to A, set beside the float64 oracle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.features.views import Regions
from liftcore.raster.base import CompositingParams, Weighting
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import DenseView, dense_view

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

FLIP = 1e-5  # a weight that differs by more, on a ray near a cut-off, was decided otherwise


@dataclass(frozen=True)
class Comparison:
    """One view in float32 beside float64."""

    A: np.ndarray  # [H * W, P] f64, of the oracle
    got: np.ndarray  # [H * W, P] f64, of the float32 walk
    error: float  # the largest of all weights, their squares and row sums, away from the cut-offs
    rays: int
    near: int  # rays with some value within 1e-4 of a cut-off
    flips: int  # those of them that float32 decided otherwise
    finite: bool


def exact_view(splats: Splats, camera: Camera, walk: CompositingParams) -> DenseView:
    """The oracle; logits far below zero overflow its exponential on the way to an exact zero."""
    with np.errstate(over="ignore"):
        return dense_view(splats, camera, walk)


def weights_of(
    splats: Splats, camera: Camera, walk: CompositingParams, power: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """A^p [H * W, P] and the evidence [P], through region weights with one region a pixel."""
    rays = camera.width * camera.height
    labels = torch.arange(rays, dtype=torch.int32).reshape(1, camera.height, camera.width)
    every_ray = Regions(labels, torch.ones(rays, 1))
    got = CpuRaster(splats, threads=2).region_weights(camera, every_ray, walk, Weighting(power))
    A = np.zeros((rays, splats.count))
    rows = np.repeat(got.splats.numpy(), np.diff(got.indptr.numpy()))
    A[got.columns.numpy(), rows] = got.weights.numpy()
    evidence = np.zeros(splats.count)
    evidence[got.evidence_splats.numpy()] = got.evidence.numpy()
    return A, evidence


def traced(splats: Splats, camera: Camera, walk: CompositingParams) -> np.ndarray:
    """A [H * W, P] by single rays, as the certificate takes it."""
    y, x = np.mgrid[: camera.height, : camera.width]
    pixels = torch.tensor(np.stack([x.ravel(), y.ravel()], axis=1), dtype=torch.int32)
    rows = CpuRaster(splats, threads=1).ray_rows(camera, pixels, walk)
    A = np.zeros((camera.width * camera.height, splats.count))
    A[np.repeat(np.arange(A.shape[0]), np.diff(rows.indptr.numpy())), rows.splats.numpy()] = rows.weights.numpy()
    return A


def compare(splats: Splats, camera: Camera, walk: CompositingParams | None = None) -> Comparison:
    """A by region weights, by single rays and squared, the row sums and the evidence, against the oracle."""
    walk = walk or CompositingParams()
    exact = exact_view(splats, camera, walk)
    weights, evidence = weights_of(splats, camera, walk)
    single, squares = traced(splats, camera, walk), weights_of(splats, camera, walk, power=2)[0]
    sums = CpuRaster(splats, threads=2).row_sums(camera, walk).numpy().ravel()
    errors = np.abs(np.concatenate([weights - exact.A, single - exact.A, squares - exact.A**2], axis=1)).max(axis=1)
    errors = np.maximum(errors, np.abs(sums - exact.A.sum(axis=1)))
    worst = float(errors[~exact.cut].max(initial=0))
    plain = (
        exact if walk.opacity_logit_scale == 1 else exact_view(splats, camera, replace(walk, opacity_logit_scale=1.0))
    )
    if not plain.cut.any():
        total = plain.A.sum(axis=0)
        worst = max(worst, float((np.abs(evidence - total) / np.maximum(total, 1)).max()))
    finite = all(bool(np.isfinite(part).all()) for part in (weights, single, squares, sums, evidence))
    flips = int((errors[exact.cut] > FLIP).sum())
    return Comparison(exact.A, weights, worst, len(errors), int(exact.cut.sum()), flips, finite)
