"""Products of a raster in the form of the dense float64 reference (`liftcore.raster.reference`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.values.views import Regions

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.base import RayRows
    from liftcore.scene.cameras import Camera
    from liftcore.values.region_weights import RegionWeights


def dense(weights: RegionWeights, splats: int, regions: int) -> np.ndarray:
    """Return W as a dense matrix [P, M] f64."""
    W = np.zeros((splats, regions))
    lengths = np.diff(weights.indptr.numpy())
    W[np.repeat(weights.splats.numpy(), lengths), weights.region.numpy()] = weights.weight.numpy()
    return W


def one_region_a_ray(camera: Camera) -> Regions:
    """Return a region map with one region per pixel, so that W^T is A'."""
    rays = camera.width * camera.height
    labels = torch.arange(rays, dtype=torch.int32).reshape(1, camera.height, camera.width)
    return Regions(labels, torch.ones(rays, 1))


def pixels_of(camera: Camera) -> Tensor:
    """Return all pixels (x, y) of a camera, [H * W, 2] i32."""
    y, x = np.mgrid[: camera.height, : camera.width]
    return torch.tensor(np.stack([x.ravel(), y.ravel()], axis=1), dtype=torch.int32)


def same_bits(left: RegionWeights | RayRows, right: RegionWeights | RayRows) -> bool:
    """Return True if all tensors of both are bitwise identical."""
    parts = ([part for part in vars(of).values() if isinstance(part, torch.Tensor)] for of in (left, right))
    return all(map(torch.equal, *parts))
