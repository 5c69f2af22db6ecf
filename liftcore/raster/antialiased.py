"""Where the opacity compensation of the mip filter may be asked for.

The low-pass makes a small splat larger on the screen; the compensation takes as much of its opacity, so that alpha is
``sigmoid(gain theta) sqrt(det(cov) / det(cov + low-pass))`` at the centre: the gain acts on the logit first, the
compensation on what comes of it, and the alpha floor on both together. Scenes trained so (gsplat's ``antialiased``,
Mip-Splatting) are to be walked so.
"""

from __future__ import annotations

from liftcore.errors import InvalidSettings
from liftcore.scene.kernel import Kernel


def check_antialiased(kernel: Kernel, antialiased: bool) -> None:
    """Refuse the mip filter's compensation where it has no meaning.

    Raises:
        InvalidSettings: the splats are no 3D Gaussians.
    """
    if antialiased and kernel is not Kernel.GAUSSIAN_3D:
        raise InvalidSettings(
            "antialiased",
            expected="false for splats that are no 3D Gaussians",
            got=f"true with kernel {kernel}",
            hint="the opacity compensation of the mip filter is defined for 3DGS alone",
        )
