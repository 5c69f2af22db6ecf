"""Columns of projected splats that the compositing kernels read. The CPU projects (``cpu.project``).

Places [n, PLACE] f64 are used at a row's first pixel, where large numbers are subtracted; inks [n, INK] f32 at every
pixel. A row per projected splat, near to far.
"""

import torch
from torch import Tensor

from liftcore.raster.cpu import project as projected
from liftcore.raster.cpu.project import View, low_pass_curvature
from liftcore.scene.splats import Kernel

MX, MY, SLOPE, C = range(4)  # 3DGS and DBS, as in cpu.project
CENTRE_X, CENTRE_Y, S_X, S_Y, T_X, T_Y, D_ZERO, D_X, D_Y = range(9)  # 2DGS, likewise
PLACE = 9
_ELLIPSE = [projected.MX, projected.MY, projected.SLOPE, projected.C]
_FORMS = [projected.S_X, projected.S_Y, projected.T_X, projected.T_Y, projected.D_ZERO, projected.D_X, projected.D_Y]
_DISC = [projected.CENTRE_X, projected.CENTRE_Y, *_FORMS]

OPACITY, UNSCALED_OPACITY, A, BETA = range(4)  # A is the low-pass's curvature for 2DGS
S_STEP, S_STEP_REST, T_STEP, T_STEP_REST, D_STEP, D_STEP_REST = range(4, 10)  # 2DGS: change of the forms per pixel
INK = 10
_COARSE = -32  # mask of a float32's upper bits: 19 of the mantissa stay, so its product with a lane below 16 is exact


def kernel_inputs(splats: Tensor, kernel: Kernel, view: View) -> tuple[Tensor, Tensor]:
    """Return places and inks of projected splats [n, COLUMNS] f64."""
    columns = _DISC if kernel is Kernel.GAUSSIAN_2D else _ELLIPSE
    places, inks = (splats.new_zeros(len(splats), size) for size in (PLACE, INK))
    for at, column in enumerate(columns):
        places[:, at] = splats[:, column]
    inks[:, OPACITY], inks[:, UNSCALED_OPACITY] = splats[:, projected.OPACITY], splats[:, projected.UNSCALED_OPACITY]
    if kernel is Kernel.GAUSSIAN_2D:
        inks[:, A] = low_pass_curvature(view)
        for column, step in ((projected.S_X, S_STEP), (projected.T_X, T_STEP), (projected.D_X, D_STEP)):
            coarse = (splats[:, column].float().view(torch.int32) & _COARSE).view(torch.float32).double()
            inks[:, step], inks[:, step + 1] = coarse, splats[:, column] - coarse
    else:
        inks[:, A] = splats[:, projected.SQRT_A].square()
    if kernel is Kernel.BETA:
        inks[:, BETA] = splats[:, projected.BETA]
    return places, inks.float()
