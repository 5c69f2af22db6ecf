"""Everything that a lift compiles, before its time is taken."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.raster.cpu.warm_up import warm_up

if TYPE_CHECKING:
    from liftcore.device import Device
    from liftcore.scene.splats import Kernel
    from liftcore.settings import LiftSettings


def warm_up_lift(kernel: Kernel, device: Device, settings: LiftSettings) -> None:
    """Compile what a lift with these settings runs, or load it from the disk cache; its diagnostics excepted."""
    warm_up(kernel, device, settings.lift_params, settings.weighting)
