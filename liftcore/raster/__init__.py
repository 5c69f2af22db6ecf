"""A, one view at a time: projection, depth order, compositing; and the reference that every backend is held to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.errors import InvalidSplats
from liftcore.runtime.arguments import check_count

if TYPE_CHECKING:
    from liftcore.raster.base import Raster
    from liftcore.runtime.device import Device
    from liftcore.scene.splats import Splats


def open_raster(splats: Splats, device: Device, threads: int | None = None, kept: int = 0) -> Raster:
    """A for one scene, on the device: compiled kernels on the CPU, Triton's on a card.

    Args:
        threads: of the CPU; None takes the cores that this process may use. The number changes no bit.
        kept: bytes of region weights that stay on a card beside the views at work; 0 brings them back.
    """
    if device.kind == "cpu":
        from liftcore.raster.cpu.raster import CpuRaster  # loads numba

        return CpuRaster(splats, threads)
    from liftcore.raster.gpu.raster import GpuRaster  # loads triton

    return GpuRaster(splats, device.place, stays=kept > 0)


def check_given(splats: Splats, threads: int | None) -> Splats:
    """What callers of the library give to every call that rasterizes; the splats come back on the CPU.

    Raises:
        InvalidSplats: the splats are something else, such as a path.
        InvalidSettings: threads are no whole number of one or more, and not None.
    """
    from liftcore.scene.splats import Splats  # loads torch

    if not isinstance(splats, Splats):
        got, hint = f"{type(splats).__name__} {splats!r}"[:80], "read_splats(path) makes them of a file"
        raise InvalidSplats("splats", expected="Splats", got=got, hint=hint)
    check_count("threads", threads, "all cores")
    return splats.cpu()
