"""Compilation of all kernels of a lift, outside its timings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.raster.cpu.warm_up import warm_up
from liftcore.solve.closed_form import solve
from liftcore.solve.codebook import Codebook, ViewCodebook
from liftcore.solve.consensus import mask_consensus
from liftcore.solve.objects import region_objects
from liftcore.solve.reweight import reweighting_factors
from liftcore.solve.smooth import warm_up_smoothing
from liftcore.values.region_weights import one_view

if TYPE_CHECKING:
    from liftcore.runtime.device import Device
    from liftcore.scene.splats import Kernel
    from liftcore.values.settings import LiftSettings


def warm_up_lift(kernel: Kernel, device: Device, settings: LiftSettings) -> None:
    """Compile the kernels of a lift with these settings, or load them from the disk cache; diagnostics excepted."""
    warm_up(kernel, device, settings.compositing, settings.weighting)
    first, unit = torch.zeros(1, dtype=torch.int32), torch.ones(1, dtype=torch.float32)
    W = one_view(first, torch.tensor([0, 1]), first, unit, first, unit, regions=1)
    book = Codebook((ViewCodebook(unit[None]),))
    solve(W, book, torch.float32, threads=1)
    if settings.objects:
        region_objects(W, np.zeros(1, np.int8), np.ones(1), 1)
    if settings.robust:
        mask_consensus(W, np.zeros(1, np.int8), 1)
        reweighting_factors(W, book, principal=1, threads=1, masks=torch.ones(1, dtype=torch.bool))
    if settings.smoothness:
        warm_up_smoothing()
