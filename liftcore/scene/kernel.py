"""Kernels of splats: their names, and the numbers of a lobe; without torch."""

from __future__ import annotations

from enum import StrEnum

from liftcore.errors import InvalidSplats
from liftcore.runtime.arguments import check_choice

LOBE_COLOURS = 3  # r g b, the first of the six numbers of a spherical beta lobe
NORMALS = ("nx", "ny", "nz")  # columns of files, which no kernel reads
DARK_LOBE = -10.0  # r g b of a lobe that adds nothing: its softplus of sharpness 10 ln 2 is 1e-31, and of zero 0.1


class Kernel(StrEnum):
    """The kernel of a splat along a ray."""

    GAUSSIAN_3D = "3dgs"
    GAUSSIAN_2D = "2dgs"
    BETA = "dbs"


def kernel_named(name: Kernel | str) -> Kernel:
    """Return the kernel of a name."""
    check_choice("kernel", name, Kernel, InvalidSplats)
    return Kernel(name)


def scale_count(kernel: Kernel) -> int:
    """Return the number of a splat's scales: two for the flat ones of 2DGS, three for others."""
    return 2 if kernel is Kernel.GAUSSIAN_2D else 3
