"""Compilation of a device's kernels, or loading from the disk cache, ahead of the first lift or query."""

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

DEFAULT_PARAMS, ALL_WEIGHTS = CompositingParams(), Weighting()


def warm_up(
    kernel: Kernel = Kernel.GAUSSIAN_3D,
    device: Device = CPU,
    params: CompositingParams = DEFAULT_PARAMS,
    weighting: Weighting = ALL_WEIGHTS,
) -> None:
    """Run the products of a lift and a query on one splat. The first run compiles, later runs load from disk.

    Each splat kernel, unscaled opacities and top-k are compiled separately, so a scene waits only for what it uses.
    Rare products (labels) compile at their first call. On a GPU each weighting compiles.

    Args:
        params: compositing parameters of the lift. weighting: of the lift.
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
