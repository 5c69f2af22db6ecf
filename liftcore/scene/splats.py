"""Trained splats, as their files store them: logs and logits, validated once.

Trained files hold a few numbers that are none (NaN or infinite), and their rows must stay, since scores and exports
follow the rows. A splat whose place, size, turn or opacity is no number becomes one that no ray meets; a colour that
is no number becomes grey. Both are counted in ``warnings``.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from liftcore.errors import InvalidSplats
from liftcore.scene.kernel import DARK_LOBE, LOBE_COLOURS, Kernel, kernel_named, scale_count
from liftcore.scene.origin import FILE_ORIGIN, Origin, float32_step, local_origin, usual_size
from liftcore.scene.render_mode import RenderMode, RenderModel, render_mode_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from torch import Tensor

    Array = Tensor | np.ndarray


SH_ROWS = (1, 4, 9, 16, 25)  # (degree + 1)^2
_BEYOND = {"opacity_logits": (True, True), "log_scales": (True, False)}  # whether -inf and +inf have a meaning
ROUNDED = 0.25  # of a splat's size: a coarser float32 has moved splats visibly
_GEOMETRY = ("means", "quats", "log_scales", "opacity_logits", "beta")  # what rays meet; all else is colour


@dataclass(frozen=True, init=False)
class Splats:
    """P trained splats. Scales are logs and opacities logits, as in the files; the raster activates them.

    Arrays come of torch, on any device, or of numpy. They become float32 of torch where they lie, without a copy
    where they are that already, and without their gradients. A logit may be infinite (an opacity of 1 or 0, as
    converters of quantised splats write it), and a log scale minus infinity (flat). Splats with other numbers that
    are not finite are unseen: their opacity becomes 0 (a logit of minus infinity), and a place, size or turn that is
    no number becomes the first one that is. Colours that are not finite become grey.

    ``render_mode`` decides the setting ``antialiased`` of lifts and renders where that is left at auto.

    Means are about ``origin``. Without one it is chosen: zeros, so that they stay as they came, but for scenes so far
    from zero that float32 would round them coarsely, such as in map coordinates, whose means come in the file's frame
    (float64 loses nothing) and are kept about an origin near them (`liftcore.scene.origin`). With one they come
    relative to it; zeros count as none where they come in float64.

    ``layout``, ``extras`` and ``header`` keep what the file had beyond the model (normals, SAGA's ``mask``,
    comments), so that writing gives back what was read.

    Raises:
        InvalidSplats: an array has another shape or holds no floats, or no splat is finite; the error names it.
    """

    means: Tensor  # [P, 3] f32, world frame less the origin, scene units
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
    render_mode: RenderMode | None  # how they were trained, where that is said; of a str, the model's name
    origin: Origin  # [3] f64, world frame, scene units; zeros but for scenes in map coordinates
    warnings: tuple[str, ...]  # of what in these splats, or in their file, is not as it should be

    def __init__(  # noqa: PLR0913 - a field each
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
        render_mode: RenderMode | str | None = None,
        origin: Sequence[float] | None = None,
        warnings: tuple[str, ...] = (),
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
        columns = {
            name: _column(name, values, shape, first.device)
            for name, (values, shape) in shapes.items()
            if values is not None
        }
        origin, rounding = _moved_to_origin(columns, means, origin)
        columns, repairs = _repaired(columns)
        for name in shapes:
            object.__setattr__(self, name, columns.get(name))
        fixed = {"kernel": kernel, "extras": dict(extras or {}), "layout": tuple(layout), "header": tuple(header)}
        mode = render_mode_of(render_mode)
        doubts = _doubts(mode, kernel)
        told = tuple(dict.fromkeys((*warnings, *repairs, *doubts, *rounding)))
        fixed |= {"render_mode": mode, "origin": origin, "warnings": told}
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

    def positions(self, rows: Any = slice(None)) -> np.ndarray:
        """The means [n, 3] of these rows, or of all, in the world frame: f32, or f64 where an origin is added."""
        means = self.means.detach().cpu().numpy()[rows]
        return means if self.origin == FILE_ORIGIN else means.astype(np.float64) + self.origin

    @property
    def count(self) -> int:
        """P."""
        return self.means.shape[0]

    @property
    def antialiased(self) -> bool:
        """Whether they were trained with the mip filter's opacity compensation, as far as is said."""
        model = None if self.render_mode is None else self.render_mode.model
        return model is RenderModel.ANTIALIASED and self.kernel is Kernel.GAUSSIAN_3D

    @property
    def sh_degree(self) -> int | None:
        """The degree of the spherical harmonics, None without colour."""
        return None if self.sh is None else int(self.sh.shape[1] ** 0.5) - 1


def _moved_to_origin(
    columns: dict[str, Tensor], means: Array, origin: Sequence[float] | None
) -> tuple[Origin, list[str]]:
    """The origin of the means, which are moved to it where it is chosen here; a warning where they came rounded."""
    given = shared_tensor(means)
    if origin is not None and (any(origin) or given.dtype != torch.float64):
        try:
            x, y, z = (float(value) for value in origin)
        except (TypeError, ValueError):
            x = y = z = math.nan
        if not all(map(math.isfinite, (x, y, z))):
            raise InvalidSplats("origin", expected="three finite numbers", got=repr(origin)[:80])
        return (x, y, z), []
    chosen = local_origin(given, columns["log_scales"])
    if chosen == FILE_ORIGIN:
        return chosen, []
    offset = torch.tensor(chosen, dtype=torch.float64, device=given.device)
    columns["means"] = (given.double() - offset).to(torch.float32)
    step = float32_step(max(map(abs, chosen)))
    if given.dtype == torch.float64 or step <= ROUNDED * usual_size(columns["log_scales"]):
        return chosen, []
    what = f"positions came in float32, which tells {step:.2g} scene units apart where the splats lie"
    return chosen, [f"{what}, {max(map(abs, chosen)):.3g} from the origin of their file: store them as doubles"]


def _doubts(mode: RenderMode | None, kernel: Kernel) -> list[str]:
    """A warning where the kernel is not what is said of the training."""
    if mode is None or mode.model is RenderModel.CLASSIC:
        return []
    meant = Kernel.GAUSSIAN_2D if mode.model is RenderModel.DISCS else Kernel.GAUSSIAN_3D
    source = mode.source or f"render_mode={str(mode.model)!r}"
    return [] if meant is kernel else [f"{source} says {mode.model}, but the splats are taken for {kernel}"]


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
    """Values as f32 of a shape, whose ``...`` is any number."""
    column = _floats(name, values)
    if len(shape) == 1 and column.ndim == 2 and column.shape[1] == 1:  # as Inria's code keeps opacities
        column = column[:, 0]
    if column.ndim != len(shape) or any(
        want not in (..., side) for want, side in zip(shape, column.shape, strict=True)
    ):
        wanted = ", ".join("any" if side is ... else str(side) for side in shape)
        raise InvalidSplats(name, expected=f"floats of shape [{wanted}]", got=f"shape {list(column.shape)}")
    if column.device != device:
        raise InvalidSplats(name, expected=f"an array on {device}, where the means are", got=str(column.device))
    return column


def _repaired(columns: dict[str, Tensor]) -> tuple[dict[str, Tensor], list[str]]:
    """The columns with what is no number replaced (`Splats`), and a warning of each kind.

    Raises:
        InvalidSplats: no splat has a place, a size, a turn and an opacity.
    """
    bad = {name: ~_meaningful(name, values) for name, values in columns.items() if not _all_meaningful(name, values)}
    if not bad:
        return columns, []
    columns, warnings, count = dict(columns), [], len(columns["means"])
    rows = {name: mask.reshape(count, -1).any(dim=1) for name, mask in bad.items()}
    unseen = [rows[name] for name in _GEOMETRY if name in rows]
    if unseen:
        broken = torch.stack(unseen).any(dim=0)
        if bool(broken.all()):
            got = f"{count} whose {' and '.join(name for name in _GEOMETRY if name in rows)} are NaN or infinite"
            raise InvalidSplats("splats", expected="at least one splat of finite numbers", got=got)
        for name in set(bad).intersection(_GEOMETRY):
            values, row = columns[name], rows[name].reshape(-1, *[1] * (columns[name].ndim - 1))
            columns[name] = torch.where(row, values[(~rows[name]).nonzero()[0, 0]], values)
        columns["opacity_logits"] = columns["opacity_logits"].masked_fill(broken, -torch.inf)
        first = int(broken.nonzero()[0, 0])
        what = "have a place, size, turn or opacity that is no number (NaN or infinite), and are never seen"
        warnings.append(f"{int(broken.sum())} of {count} splats {what}; the first is splat {first}")
    grey = [rows[name] for name in rows if name not in _GEOMETRY]
    if grey:
        grey = torch.stack(grey).any(dim=0)
        if "sh" in columns:
            columns["sh"] = columns["sh"].masked_fill(grey[:, None, None], 0.0)
        if "sb_params" in columns:
            lobes = columns["sb_params"].masked_fill(grey[:, None, None], 0.0)
            lobes[..., :LOBE_COLOURS].masked_fill_(grey[:, None, None], DARK_LOBE)
            columns["sb_params"] = lobes
        what = "have a colour that is no number (NaN or infinite), and are grey"
        warnings.append(f"{int(grey.sum())} of {count} splats {what}; the first is splat {int(grey.nonzero()[0, 0])}")
    return columns, warnings


def _all_meaningful(name: str, values: Tensor) -> bool:
    """Whether all values have a meaning; the extremes carry NaN along, and need no memory of the tensor's size."""
    return not values.numel() or all(bool(_meaningful(name, end)) for end in torch.aminmax(values))


def _meaningful(name: str, values: Tensor) -> Tensor:
    minus, plus = _BEYOND.get(name, (False, False))
    return torch.isfinite(values) | (torch.isneginf(values) & minus) | (torch.isposinf(values) & plus)
