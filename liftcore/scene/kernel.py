"""What a splat may be: the names of the kernels, for those who load no torch, too."""

from __future__ import annotations

from enum import StrEnum


class Kernel(StrEnum):
    """The footprint that a splat leaves on a ray."""

    GAUSSIAN_3D = "3dgs"
    GAUSSIAN_2D = "2dgs"
    BETA = "dbs"
