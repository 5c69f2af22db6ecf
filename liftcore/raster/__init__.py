"""Rasterization of A, one view at a time: projection, depth order, compositing; and the float64 reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

from liftcore.errors import InvalidSplats
from liftcore.runtime.arguments import check_count

if TYPE_CHECKING:
    from liftcore.raster.base import Raster
    from liftcore.runtime.device import Device
    from liftcore.scene.splats import Splats


def open_raster(splats: Splats, device: Device, threads: int | None = None) -> Raster:
    """Return A for one scene on the device: numba kernels on the CPU, Triton kernels on a GPU.

    Args:
        threads: CPU threads; None uses the cores that this process may use. The result is bitwise identical for any.
    """
    if device.kind == "cpu":
        from liftcore.raster.cpu.raster import CpuRaster  # loads numba

        return CpuRaster(splats, threads)
    from liftcore.raster.gpu.raster import GpuRaster  # loads triton

    return GpuRaster(splats, device.place, threads)


def check_splats_and_threads(splats: Splats, threads: int | None) -> Splats:
    """Check the arguments that every rasterizing call of the library shares, and return the splats on the CPU.

    Raises:
        InvalidSplats: ``splats`` are of another type, such as a path.
        InvalidSettings: ``threads`` is neither None nor an integer of at least one.
    """
    from liftcore.scene.splats import Splats  # loads torch

    if not isinstance(splats, Splats):
        got, hint = f"{type(splats).__name__} {splats!r}"[:80], "read a file with read_splats(path)"
        raise InvalidSplats("splats", expected="Splats", got=got, hint=hint)
    check_count("threads", threads, "all cores")
    return splats.cpu()
