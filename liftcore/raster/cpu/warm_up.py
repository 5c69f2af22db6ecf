"""Compile a device's kernels, or load them from the disk cache, before anything is timed."""

from __future__ import annotations

import numpy as np
import torch

from liftcore.raster import open_raster
from liftcore.runtime.device import CPU, Device
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.scene.kernel import Kernel, scale_count
from liftcore.scene.splats import Splats
from liftcore.values.views import FeatureGrid, Regions

PLAIN, ALL = CompositingParams(), Weighting()


def warm_up(
    kernel: Kernel = Kernel.GAUSSIAN_3D,
    device: Device = CPU,
    params: CompositingParams = PLAIN,
    weighting: Weighting = ALL,
) -> None:
    """Run on one splat what a lift and a query of a kernel need. The first run compiles, later ones load from disk.

    Each kernel is compiled for itself, so a scene waits for its own alone; so are plain logits, and selections of the
    weights. What few ask for (the adjoint, labels) is compiled when first called. A card compiles each weighting.

    Args:
        params: of the lift. weighting: likewise.
    """
    splats = Splats(
        torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float32),
        torch.zeros(1, 4, dtype=torch.float32),
        torch.zeros(1, scale_count(kernel), dtype=torch.float32),
        torch.zeros(1, dtype=torch.float32),
        kernel=kernel,
        beta=torch.zeros(1, dtype=torch.float32) if kernel is Kernel.BETA else None,
    )
    camera = Camera.pinhole("warm-up", 16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4))
    raster = open_raster(splats, device, threads=1)
    regions = Regions(torch.zeros(1, 1, 1, dtype=torch.int32), torch.ones(1, 1, dtype=torch.float32))
    for observation in (regions, FeatureGrid(torch.ones(1, 1, 1, dtype=torch.float32))):
        raster.region_weights(camera, observation, params, weighting)
    raster.row_sums(camera, CompositingParams())
    raster.ray_rows(camera, torch.zeros(1, 2, dtype=torch.int32), CompositingParams())
