"""Compilation of all kernels of a lift, outside its timings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.lifting.algebra import Algebra
from liftcore.lifting.engines import LocalEngine
from liftcore.lifting.geometry import Geometry
from liftcore.lifting.in_memory import scene_of
from liftcore.raster.cpu.warm_up import warm_up
from liftcore.runtime.progress import silent
from liftcore.solve.codebook import Codebook, ViewCodebook
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
    geometry = Geometry(W, Codebook((ViewCodebook(unit[None]),)), (), (), np.zeros(1, np.int8))
    scene = scene_of(geometry, torch.zeros(1, 3, dtype=torch.float32), settings, ("view",), threads=1)
    algebra = Algebra(scene, LocalEngine(1), silent, 1)
    if settings.objects:
        algebra.find_objects()
    if settings.robust:
        algebra.compare_masks()
        algebra.reweight(levels_apart=False)
    algebra.solve()
    if settings.smoothness:
        warm_up_smoothing()
