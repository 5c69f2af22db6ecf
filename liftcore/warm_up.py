"""Everything that a lift compiles, before its time is taken."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.progress import silent
from liftcore.raster.base import RegionWeights
from liftcore.raster.cpu.warm_up import warm_up
from liftcore.solve.closed_form import warm_up_solution
from liftcore.solve.columns import warm_up_tuples
from liftcore.solve.host import Host
from liftcore.solve.robust import robust_weights
from liftcore.solve.view_weights import WeightStore

if TYPE_CHECKING:
    from liftcore.device import Device
    from liftcore.scene.splats import Kernel
    from liftcore.settings import LiftSettings


def warm_up_lift(kernel: Kernel, device: Device, settings: LiftSettings) -> None:
    """Compile what a lift with these settings runs, or load it from the disk cache; aggregation's sums excepted."""
    warm_up(kernel, device, settings.lift_params, settings.weighting)
    warm_up_tuples()
    if device.kind == "cpu":
        warm_up_solution()
    if settings.robust_steps:
        _warm_up_robust()


def _warm_up_robust() -> None:
    one = torch.zeros(1, dtype=torch.int32)
    with WeightStore() as store:
        store.append(RegionWeights(one, torch.tensor([0, 1]), one, torch.ones(1), one, torch.ones(1)))
        robust_weights(store, [torch.ones(1, 1)], np.ones(1), 1, silent, Host(1))
