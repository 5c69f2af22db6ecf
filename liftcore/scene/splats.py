"""Trained splats, as their files store them: logs and logits, validated once."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.errors import InvalidSplats
from liftcore.scene.kernel import Kernel, kernel_named, scale_count

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    Array = Tensor | np.ndarray


SH_ROWS = (1, 4, 9, 16, 25)  # (degree + 1)^2
_BEYOND = {"opacity_logits": (True, True), "log_scales": (True, False)}  # whether -inf and +inf have a meaning


@dataclass(frozen=True, init=False)
class Splats:
    """P trained splats. Scales are logs and opacities logits, as in the files; the raster activates them.

    Arrays come of torch, on any device, or of numpy. They become float32 of torch where they lie, without a copy
    where they are that already, and without their gradients. A logit may be infinite (an opacity of 1 or 0, as
    converters of quantised splats write it), and a log scale minus infinity (flat); all else is finite.

    ``layout``, ``extras`` and ``header`` keep what the file had beyond the model (normals, SAGA's ``mask``,
    comments), so that writing gives back what was read.

    Raises:
        InvalidSplats: an array has another shape, holds no floats, or is not finite; the error names it.
    """

    means: Tensor  # [P, 3] f32, world frame, scene units
    quats: Tensor  # [P, 4] f32, w x y z, may be unnormalised; zero counts as identity
    log_scales: Tensor  # [P, 3] f32 ([P, 2] for 2DGS), log of scene units
    opacity_logits: Tensor  # [P] f32 (of [P] or [P, 1]), theta in alpha = sigmoid(theta)
    kernel: Kernel
    beta: Tensor | None  # [P] f32, DBS only: b in beta = 4 exp(b)
    sh: Tensor | None  # [P, K, 3] f32, K = (degree + 1)^2, spherical harmonics
    sb_params: Tensor | None  # [P, S, 6] f32, DBS only: spherical beta lobes (r g b theta phi beta)
    extras: Mapping[str, Tensor]  # name -> [P], columns we do not model
    layout: tuple[str, ...]  # the file's property names in order; () = the kernel's usual layout
    header: tuple[str, ...]  # the file's header lines verbatim; () = made from the layout

    def __init__(
        self,
        means: Array,
        quats: Array,
        log_scales: Array,
        opacity_logits: Array,
        kernel: Kernel | str = Kernel.GAUSSIAN_3D,
        *,
        beta: Array | None = None,
        sh: Array | None = None,
        sb_params: Array | None = None,
        extras: Mapping[str, Tensor] | None = None,
        layout: tuple[str, ...] = (),
        header: tuple[str, ...] = (),
    ) -> None:
        kernel = kernel_named(kernel)
        first = _floats("means", means)
        count = len(first) if first.ndim else 0
        if count == 0:
            raise InvalidSplats("splats", expected="at least one splat", got="an empty scene")
        shapes = {
            "means": (means, (count, 3)),
            "quats": (quats, (count, 4)),
            "log_scales": (log_scales, (count, scale_count(kernel))),
            "opacity_logits": (opacity_logits, (count,)),
            "beta": (beta, (count,)),
            "sh": (sh, (count, ..., 3)),
            "sb_params": (sb_params, (count, ..., 6)),
        }
        for name, (given, shape) in shapes.items():
            found = None if given is None else _column(name, given, shape, first.device)
            object.__setattr__(self, name, found)
        fixed = {"kernel": kernel, "extras": dict(extras or {}), "layout": tuple(layout), "header": tuple(header)}
        for name, value in fixed.items():
            object.__setattr__(self, name, value)
        if self.sh is not None and self.sh.shape[1] not in SH_ROWS:
            raise InvalidSplats("sh", expected=f"{SH_ROWS} rows (degree 0..4)", got=str(self.sh.shape[1]))
        if (kernel is Kernel.BETA) != (beta is not None):
            got = f"{'none' if beta is None else 'values'} with kernel {kernel}"
            raise InvalidSplats("beta", expected="one value a splat for DBS and none for other kernels", got=got)

    def cpu(self) -> Splats:
        """The same with its tensors on the CPU."""
        if self.means.device.type == "cpu":
            return self
        columns = {name: value.cpu() for name, value in vars(self).items() if isinstance(value, torch.Tensor)}
        return replace(self, **columns, extras={name: column.cpu() for name, column in self.extras.items()})

    @property
    def count(self) -> int:
        """P."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int | None:
        """The degree of the spherical harmonics, None without colour."""
        return None if self.sh is None else int(self.sh.shape[1] ** 0.5) - 1


def shared_tensor(values: object) -> Tensor:
    """A tensor over the same memory where torch can have it; a reversed array, or one of other bytes, is copied."""
    if isinstance(values, torch.Tensor) or hasattr(values, "__cuda_array_interface__"):  # the latter as CuPy's are
        return torch.as_tensor(values).detach()
    array = np.asarray(values)
    if not array.dtype.isnative:
        array = array.astype(array.dtype.newbyteorder("="))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of arrays that must not be written to: nobody does
        return torch.from_numpy(np.ascontiguousarray(array))


def _floats(name: str, values: Array) -> Tensor:
    """Values as f32 where they lie, without a copy where they are that already."""
    try:
        found = shared_tensor(values)
    except (TypeError, ValueError, RuntimeError) as error:
        expected, got = "an array of torch or numpy", f"{type(values).__name__} ({str(error)[:80]})"
        raise InvalidSplats(name, expected=expected, got=got) from None
    if not found.is_floating_point():
        raise InvalidSplats(name, expected="floats", got=str(found.dtype).removeprefix("torch."))
    return found.to(torch.float32)


def _column(name: str, values: Array, shape: tuple[Any, ...], device: torch.device) -> Tensor:
    """Values as f32 of a shape, whose ``...`` is any number, with no NaN nor an infinity that has no meaning."""
    found = _floats(name, values)
    if len(shape) == 1 and found.ndim == 2 and found.shape[1] == 1:  # as Inria's code keeps opacities
        found = found[:, 0]
    if found.ndim != len(shape) or any(
        want not in (..., side) for want, side in zip(shape, found.shape, strict=True)
    ):
        wanted = ", ".join("any" if side is ... else str(side) for side in shape)
        raise InvalidSplats(name, expected=f"floats of shape [{wanted}]", got=f"shape {list(found.shape)}")
    if found.device != device:
        raise InvalidSplats(name, expected=f"an array on {device}, where the means are", got=str(found.device))
    if not found.numel():
        return found
    # The extremes carry NaN and infinity along, and need no memory of the tensor's size.
    if not all(bool(_allowed(name, end)) for end in torch.aminmax(found)):
        bad = ~_allowed(name, found)
        row = int(bad.reshape(shape[0], -1).any(dim=1).nonzero()[0, 0])
        got = f"{int(bad.sum())} that are NaN or infinite, the first in splat {row}"
        hint = "prune the broken splats before the upload"
        raise InvalidSplats(name, expected="finite values", got=got, hint=hint)
    return found


def _allowed(name: str, values: Tensor) -> Tensor:
    minus, plus = _BEYOND.get(name, (False, False))
    return torch.isfinite(values) | (torch.isneginf(values) & minus) | (torch.isposinf(values) & plus)
