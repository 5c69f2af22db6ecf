"""Splats by hand, and the comparison of every weight with the float64 oracle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.observe.observation import RegionMap
from liftcore.raster.cpu import CpuRaster
from liftcore.raster.oracle import DenseView, dense_view
from liftcore.raster.protocol import Walk, Weighting
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Kernel, Splats
from tests.scenes import of_kernel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

TOLERANCE = 1e-5  # absolute, on weights, away from the cut-offs
IDENTITY = (1.0, 0.0, 0.0, 0.0)


def splats_at(
    means: Sequence[Sequence[float]],
    log_scales: ArrayLike = -2.0,
    logits: ArrayLike = 1.0,
    quats: ArrayLike = IDENTITY,
    kernel: Kernel = Kernel.GAUSSIAN_3D,
    betas: ArrayLike = 0.0,
) -> Splats:
    """Splats at the means; what is given once holds for all of them. Three scales, whatever the kernel keeps."""

    def column(values: ArrayLike, shape: tuple[int, ...]) -> torch.Tensor:
        return torch.tensor(np.broadcast_to(np.asarray(values, np.float32), shape).copy())

    count = len(means)
    splats = Splats(
        column(np.asarray(means), (count, 3)),
        column(quats, (count, 4)),
        column(log_scales, (count, 3)),
        column(logits, (count,)),
    )
    return of_kernel(splats, kernel, column(betas, (count,)))


def camera_at_origin(width: int = 16, height: int = 12, focal: float = 16.0, name: str = "v0") -> Camera:
    """A camera that looks along +z, with the middle of a pixel on its axis."""
    centre = (width // 2 + 0.5, height // 2 + 0.5)
    return Camera(name, width, height, focal, focal, *centre, np.eye(4))


def exact_view(splats: Splats, camera: Camera, walk: Walk) -> DenseView:
    """The oracle; logits far below zero overflow its exponential on the way to an exact zero."""
    with np.errstate(over="ignore"):
        return dense_view(splats, camera, walk)


def weights_of(splats: Splats, camera: Camera, walk: Walk, power: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A^p [H * W, P] and the evidence [P], through region weights with one region a pixel."""
    rays = camera.width * camera.height
    labels = torch.arange(rays, dtype=torch.int32).reshape(1, camera.height, camera.width)
    every_ray = RegionMap(labels, torch.ones(rays, 1))
    got = CpuRaster(splats, threads=2).region_weights(camera, every_ray, walk, Weighting(power))
    A = np.zeros((rays, splats.count))
    rows = np.repeat(got.splats.numpy(), np.diff(got.row_starts.numpy()))
    A[got.columns.numpy(), rows] = got.weights.numpy()
    evidence = np.zeros(splats.count)
    evidence[got.evidence_splats.numpy()] = got.evidence.numpy()
    return A, evidence


def traced(splats: Splats, camera: Camera, walk: Walk) -> np.ndarray:
    """A [H * W, P] by single rays, as the certificate takes it."""
    y, x = np.mgrid[: camera.height, : camera.width]
    pixels = torch.tensor(np.stack([x.ravel(), y.ravel()], axis=1), dtype=torch.int32)
    rows = CpuRaster(splats, threads=1).ray_rows(camera, pixels, walk)
    A = np.zeros((camera.width * camera.height, splats.count))
    A[np.repeat(np.arange(A.shape[0]), np.diff(rows.row_starts.numpy())), rows.splats.numpy()] = rows.weights.numpy()
    return A


def assert_equals_the_oracle(splats: Splats, camera: Camera, walk: Walk | None = None) -> np.ndarray:
    """Every weight of every ray, by both ways to A, and the row sums; A of the oracle for further promises."""
    walk = walk or Walk()
    exact = exact_view(splats, camera, walk)
    inside = ~exact.cut
    for A in (weights_of(splats, camera, walk)[0], traced(splats, camera, walk)):
        assert np.isfinite(A).all()
        assert np.abs(A - exact.A)[inside].max(initial=0) < TOLERANCE
    sums = CpuRaster(splats, threads=2).row_sums(camera, walk).numpy().ravel()
    assert np.isfinite(sums).all()
    assert np.abs(sums - exact.A.sum(axis=1))[inside].max(initial=0) < TOLERANCE
    squares = weights_of(splats, camera, walk, power=2)[0]
    assert np.abs(squares - exact.A**2)[inside].max(initial=0) < TOLERANCE
    return exact.A
