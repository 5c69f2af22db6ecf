"""Small random scenes, cameras and observations, reproducible by their seeds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from liftcore.scene.cameras import Camera
from liftcore.scene.kernel import Kernel
from liftcore.scene.splats import Splats
from liftcore.values.views import FeatureGrid, Regions


def of_kernel(splats: Splats, kernel: Kernel, betas: Tensor) -> Splats:
    """Return the splats as those of another kernel: 2DGS uses the first two scales, DBS the betas [P]."""
    if kernel is Kernel.GAUSSIAN_2D:
        return replace(splats, kernel=kernel, log_scales=splats.log_scales[:, :2].contiguous())
    return replace(splats, kernel=kernel, beta=betas) if kernel is Kernel.BETA else splats


def random_splats(seed: int, count: int = 40, spread: float = 1.0, kernel: Kernel = Kernel.GAUSSIAN_3D) -> Splats:
    """Return splats around the origin: needles, discs and balls, faint and opaque, with flat and steep falloffs."""
    rng = np.random.default_rng(seed)
    splats = Splats(
        means=torch.tensor(rng.normal(0, spread, (count, 3)), dtype=torch.float32),
        quats=torch.tensor(rng.normal(0, 1, (count, 4)), dtype=torch.float32),
        log_scales=torch.tensor(rng.uniform(-4.5, -0.5, (count, 3)), dtype=torch.float32),
        opacity_logits=torch.tensor(rng.normal(0, 3, count), dtype=torch.float32),
        sh=torch.tensor(rng.normal(0, 1, (count, 1, 3)), dtype=torch.float32),
    )
    betas = torch.tensor(rng.normal(0, 1.5, count), dtype=torch.float32)
    return of_kernel(splats, kernel, betas)


def look_at(name: str, centre: np.ndarray, width: int, height: int, focal: float) -> Camera:
    """Return a camera at ``centre`` that looks at the origin."""
    forward = -centre / np.linalg.norm(centre)
    helper = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    right = np.cross(helper, forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ centre
    return Camera.pinhole(name, width, height, focal, focal * 1.1, width / 2 + 0.7, height / 2 - 0.4, pose)


def random_camera(seed: int, width: int = 37, height: int = 29, name: str = "v0") -> Camera:
    """Return a random camera around the scene; its size is no multiple of a tile."""
    rng = np.random.default_rng(seed + 1_000)
    direction = rng.normal(0, 1, 3)
    centre = direction / np.linalg.norm(direction) * rng.uniform(2.5, 5.0)
    return look_at(name, centre, width, height, focal=rng.uniform(0.7, 1.5) * width)


def random_regions(
    seed: int, levels: int = 2, rows: int = 5, size: tuple[int, int] = (15, 18), F: int = 6
) -> Regions:
    """Return blocky label maps of another size than the image, with unlabelled pixels."""
    rng = np.random.default_rng(seed + 2_000)
    coarse = rng.integers(-1, rows, (levels, -(-size[0] // 3), -(-size[1] // 4)))
    labels = np.repeat(np.repeat(coarse, 3, axis=1), 4, axis=2)[:, : size[0], : size[1]]
    codebook = rng.normal(0, 1, (rows, F))
    codebook /= np.linalg.norm(codebook, axis=1, keepdims=True)
    return Regions(torch.tensor(labels.copy(), dtype=torch.int32), torch.tensor(codebook, dtype=torch.float32))


def random_grid(seed: int, size: tuple[int, int] = (7, 9), F: int = 6) -> FeatureGrid:
    """Return a grid of random vectors."""
    rng = np.random.default_rng(seed + 3_000)
    return FeatureGrid(torch.tensor(rng.normal(0, 1, (*size, F)), dtype=torch.float32))
