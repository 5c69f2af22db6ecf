"""Splats and cameras by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Kernel, Splats

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike
    from torch import Tensor

IDENTITY = (1.0, 0.0, 0.0, 0.0)
TURNED = (0.9, 0.1, 0.3, 0.2)
ROW = tuple((0.3 * k - 0.6, 0.1 * k, 2.0 + 0.2 * k) for k in range(5))  # of five centres before a camera


def splats_at(
    means: Sequence[Sequence[float]] | np.ndarray,
    log_scales: ArrayLike = -2.0,
    logits: ArrayLike = 1.0,
    quats: ArrayLike = IDENTITY,
    kernel: Kernel = Kernel.GAUSSIAN_3D,
    betas: ArrayLike = 0.0,
) -> Splats:
    """Grey splats at the means; what is given once holds for all of them. Three scales, whatever the kernel keeps."""

    def column(values: ArrayLike, shape: tuple[int, ...]) -> Tensor:
        return torch.tensor(np.broadcast_to(np.asarray(values, np.float32), shape).copy())

    count = len(means)
    splats = Splats(
        column(np.asarray(means), (count, 3)),
        column(quats, (count, 4)),
        column(log_scales, (count, 3)),
        column(logits, (count,)),
        sh=torch.zeros(count, 1, 3),
    )
    return of_kernel(splats, kernel, column(betas, (count,)))


def of_kernel(splats: Splats, kernel: Kernel, betas: Tensor) -> Splats:
    """The same numbers read as splats of another kernel: 2DGS takes the first two scales, DBS the betas [P]."""
    if kernel is Kernel.GAUSSIAN_2D:
        return replace(splats, kernel=kernel, log_scales=splats.log_scales[:, :2].contiguous())
    return replace(splats, kernel=kernel, beta=betas) if kernel is Kernel.BETA else splats


def camera_at_origin(width: int = 16, height: int = 12, focal: float = 16.0, name: str = "v0") -> Camera:
    """A camera that looks along +z, with the middle of a pixel on its axis."""
    centre = (width // 2 + 0.5, height // 2 + 0.5)
    return Camera.pinhole(name, width, height, focal, focal, *centre, np.eye(4))
