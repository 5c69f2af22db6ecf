"""Trained splats, as their files store them: logs and logits, validated once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch

from liftcore.errors import InvalidSplats
from liftcore.scene.kernel import Kernel

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor


SH_ROWS = (1, 4, 9, 16, 25)  # (degree + 1)^2
_BEYOND = {"opacity_logits": (True, True), "log_scales": (True, False)}  # whether -inf and +inf have a meaning


@dataclass(frozen=True)
class Splats:
    """P trained splats. Scales are logs and opacities logits, as in the files; the raster activates them.

    A logit may be infinite (an opacity of 1 or 0, as converters of quantised splats write it), and a log scale minus
    infinity (flat); all else is finite.

    ``layout``, ``extras`` and ``header`` keep what the file had beyond the model (normals, SAGA's ``mask``,
    comments), so that writing gives back what was read.
    """

    means: Tensor  # [P, 3] f32, world frame, scene units
    quats: Tensor  # [P, 4] f32, w x y z, may be unnormalised; zero counts as identity
    log_scales: Tensor  # [P, 3] f32 ([P, 2] for 2DGS), log of scene units
    opacity_logits: Tensor  # [P] f32, theta in alpha = sigmoid(theta)
    kernel: Kernel = Kernel.GAUSSIAN_3D
    beta: Tensor | None = None  # [P] f32, DBS only: b in beta = 4 exp(b)
    sh: Tensor | None = None  # [P, K, 3] f32, K = (degree + 1)^2, spherical harmonics
    sb_params: Tensor | None = None  # [P, S, 6] f32, DBS only: spherical beta lobes (r g b theta phi beta)
    extras: Mapping[str, Tensor] = field(default_factory=dict)  # name -> [P], columns we do not model
    layout: tuple[str, ...] = ()  # the file's property names in order; () = the kernel's usual layout
    header: tuple[str, ...] = ()  # the file's header lines verbatim; () = made from the layout

    def __post_init__(self) -> None:
        count = self.means.shape[0]
        if count == 0:
            raise InvalidSplats("splats", expected="at least one splat", got="an empty scene")
        scales = 2 if self.kernel is Kernel.GAUSSIAN_2D else 3
        shapes: dict[str, tuple[Tensor | None, tuple[int, ...]]] = {
            "means": (self.means, (count, 3)),
            "quats": (self.quats, (count, 4)),
            "log_scales": (self.log_scales, (count, scales)),
            "opacity_logits": (self.opacity_logits, (count,)),
            "beta": (self.beta, (count,)),
            "sh": (
                self.sh,
                (count, self.sh.shape[1], 3) if self.sh is not None and self.sh.ndim == 3 else (),
            ),
            "sb_params": (
                self.sb_params,
                (count, self.sb_params.shape[1], 6)
                if self.sb_params is not None and self.sb_params.ndim == 3
                else (),
            ),
        }
        for name, (tensor, shape) in shapes.items():
            if tensor is not None:
                _check_column(name, tensor, shape)
        if self.sh is not None and self.sh.shape[1] not in SH_ROWS:
            raise InvalidSplats("sh", expected=f"{SH_ROWS} rows (degree 0..4)", got=str(self.sh.shape[1]))
        if (self.kernel is Kernel.BETA) != (self.beta is not None):
            raise InvalidSplats(
                "beta",
                expected="one value a splat for DBS and none for other kernels",
                got=f"{'none' if self.beta is None else 'values'} with kernel {self.kernel}",
            )

    @property
    def count(self) -> int:
        """P."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int | None:
        """The degree of the spherical harmonics, None without colour."""
        return None if self.sh is None else int(self.sh.shape[1] ** 0.5) - 1


def _check_column(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    if not isinstance(tensor, torch.Tensor):
        hint = "torch.from_numpy makes one of a NumPy array"
        raise InvalidSplats(name, expected="a tensor of torch", got=str(type(tensor).__name__), hint=hint)
    if tuple(tensor.shape) != shape or tensor.dtype != torch.float32:
        wanted = f"float32 {list(shape)}" if shape else "three axes"
        raise InvalidSplats(
            name, expected=wanted, got=f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
        )
    # The extremes carry NaN and infinity along, and need no memory of the tensor's size.
    low, high = torch.aminmax(tensor) if tensor.numel() else (torch.zeros(()), torch.zeros(()))
    least, most = _BEYOND.get(name, (False, False))
    below, above = (torch.isfinite(low) | (low < 0) & least), (torch.isfinite(high) | (high > 0) & most)
    if not bool(below & above):
        bad = ~torch.isfinite(tensor) & ~(torch.isneginf(tensor) & least) & ~(torch.isposinf(tensor) & most)
        row = int(bad.reshape(shape[0], -1).any(dim=1).nonzero()[0, 0])
        total = int(bad.sum())
        raise InvalidSplats(
            name,
            expected="finite values",
            got=f"{total} that are NaN or infinite, the first in splat {row}",
            hint="prune the broken splats before the upload",
        )
