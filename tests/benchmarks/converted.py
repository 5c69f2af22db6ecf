"""A trained 3DGS scene read as discs or as beta kernels, to compare kernels on one's own scene.

These are conversions, not trained scenes: a scene that was trained with a kernel fits its photos better than one that
was brought into its form afterwards. What they show is what the kernel does to the lift, all else equal.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from liftcore.errors import InvalidSplats
from liftcore.scene.splats import Kernel

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.scene.splats import Splats

# Turns by a third about (1, 1, 1): R q has the columns (1, 2, 0) of R, or (2, 0, 1); w x y z.
_TURNS = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))
_ORDERS = ((1, 2, 0), (2, 0, 1), (0, 1, 2))  # the axes that stay, then the one that goes: 0, 1 or 2

CONVERTED_BETA = 0.0  # b of every converted splat: beta = 4, with which beta splatting starts its training


def to_discs(splats: Splats) -> Splats:
    """2DGS: every splat loses its shortest axis, which becomes the disc's normal; opacities and colours stay.

    Raises:
        InvalidSplats: the splats are no 3D Gaussians.
    """
    _check(splats)
    shortest = splats.log_scales.argmin(dim=1)
    kept = torch.tensor(_ORDERS)[shortest][:, :2]
    quats = _product(_unit(splats.quats), torch.tensor(_TURNS)[shortest])
    log_scales = splats.log_scales.gather(1, kept).contiguous()
    return replace(
        splats, kernel=Kernel.GAUSSIAN_2D, quats=quats, log_scales=log_scales, layout=(), header=(), extras={}
    )


def to_betas(splats: Splats) -> Splats:
    """DBS: beta = 4 and axes that give every footprint the area of its Gaussian; opacities and colours stay.

    In the image plane, ``(1 - r^2 / R^2)^beta`` sums to ``pi R^2 / (beta + 1)`` and ``exp(-r^2 / 2)`` to ``2 pi``:
    the axes grow by ``R = sqrt(2 (beta + 1))``. The low-pass of 0.3 px^2 is not converted, for a scene cannot say it.

    Raises:
        InvalidSplats: the splats are no 3D Gaussians.
    """
    _check(splats)
    beta = 4.0 * math.exp(CONVERTED_BETA)
    return replace(
        splats,
        kernel=Kernel.BETA,
        log_scales=splats.log_scales + 0.5 * math.log(2.0 * (beta + 1.0)),
        beta=torch.full((splats.count,), CONVERTED_BETA),
        layout=(),
        header=(),
        extras={},
    )


def _check(splats: Splats) -> None:
    if splats.kernel is not Kernel.GAUSSIAN_3D:
        raise InvalidSplats("splats", expected="3D Gaussians to convert", got=f"kernel {splats.kernel}")


def _unit(quats: Tensor) -> Tensor:
    """[P, 4] w x y z of length one; zero counts as identity, as everywhere."""
    lengths = quats.norm(dim=1, keepdim=True)
    return torch.where(lengths > 0, quats / lengths.clamp_min(1e-38), quats.new_tensor(_TURNS[2]))


def _product(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton products [P, 4]: the rotation of q, then that of p."""
    pw, px, py, pz = p.unbind(dim=1)
    qw, qx, qy, qz = q.unbind(dim=1)
    return torch.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        dim=1,
    )
