"""Trained splats, as their files store them: logs and logits, validated once.

Trained files hold a few numbers that are none (NaN or infinite), and their rows must stay, since scores and exports
follow the rows. A splat whose place, size, turn or opacity is no number becomes one that no ray meets; a colour that
is no number becomes grey. Both are counted in ``warnings``.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidInput, InvalidSplats, reading
from liftcore.runtime.one_line import one_line
from liftcore.scene.harmonics import SH_C0, band_rotation
from liftcore.scene.kernel import DARK_LOBE, LOBE_COLOURS, NORMALS, Kernel, kernel_named, scale_count
from liftcore.scene.origin import FILE_ORIGIN, Origin, float32_step, local_origin, middle_and_extent, usual_size
from liftcore.scene.quaternions import product_matrix
from liftcore.scene.render_mode import RenderMode, RenderModel, render_mode_of
from liftcore.scene.similarity import Similarity
from liftcore.scene.world import UNKNOWN, WorldFrame

if TYPE_CHECKING:
    from liftcore.scene.similarity import Numbers

Array = Tensor | np.ndarray
Rows = Any  # a boolean mask [P], a slice, or whole numbers [n]; of numpy, torch on any device, or a list
SH_ROWS = (1, 4, 9, 16, 25)  # (degree + 1)^2
_BEYOND = {"opacity_logits": (True, True), "log_scales": (True, False)}  # True if -inf and +inf have a meaning
ROUNDED = 0.25  # of a splat's size: a coarser float32 has moved splats visibly
WIDEST = 4.0  # spacings of splats that lie spread over a square as wide as their scene
MIN_SAMPLE = 100  # splats: what all of so many have in common is no accident
_GEOMETRY = ("means", "quats", "log_scales", "opacity_logits", "beta")  # that rays depend on; all else is colour


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

    ``splats[keep]`` has the rows that a mask [P], a slice or row numbers choose, with all their columns.

    Raises:
        InvalidSplats: an array has another shape or holds no floats, or no splat is finite; the error names it.
    """

    means: Tensor
    """[P, 3] f32, world frame less the origin, scene units"""
    quats: Tensor
    """[P, 4] f32, w x y z, may be unnormalised; zero counts as identity"""
    log_scales: Tensor
    """[P, 3] f32 ([P, 2] for 2DGS), log of scene units"""
    opacity_logits: Tensor
    """[P] f32 (of [P] or [P, 1]), theta in alpha = sigmoid(theta)"""
    kernel: Kernel
    beta: Tensor | None
    """[P] f32, DBS only: b in beta = 4 exp(b)"""
    sh: Tensor | None
    """[P, K, 3] f32, K = (degree + 1)^2, spherical harmonics"""
    sb_params: Tensor | None
    """[P, S, 6] f32, DBS only: spherical beta lobes (r g b theta phi beta)"""
    extras: Mapping[str, Tensor]
    """name -> [P], columns we do not model"""
    layout: tuple[str, ...]
    """the file's property names in order; () = the kernel's usual layout"""
    header: tuple[str, ...]
    """the file's header lines verbatim; () = made from the layout"""
    render_mode: RenderMode | None
    """how they were trained, if known; a str is the model's name"""
    origin: Origin
    """[3] f64, world frame, scene units; zeros but for scenes in map coordinates"""
    world: WorldFrame
    """up axis and length of a unit, as far as their file has them"""
    warnings: tuple[str, ...]
    """of what in these splats, or in their file, is not as it should be"""

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
        extras: Mapping[str, Array] | None = None,
        layout: tuple[str, ...] = (),
        header: tuple[str, ...] = (),
        render_mode: RenderMode | str | None = None,
        origin: Sequence[float] | None = None,
        world: WorldFrame = UNKNOWN,
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
        origin, rounding = _move_to_origin(columns, means, origin)
        columns, repairs = _repair_columns(columns)
        extra_columns = {name: _extra(name, values, count) for name, values in (extras or {}).items()}
        fields: dict[str, Any] = {name: columns.get(name) for name in shapes}
        fields |= {"kernel": kernel, "extras": extra_columns, "layout": tuple(layout), "header": tuple(header)}
        mode = render_mode_of(render_mode)
        doubts = [*_kernel_warnings(mode, kernel), *_activation_warnings(columns)]
        all_warnings = tuple(dict.fromkeys((*warnings, *repairs, *doubts, *rounding)))
        fields |= {"render_mode": mode, "origin": origin, "world": world, "warnings": all_warnings}
        vars(self).update(fields)
        if self.sh is not None and self.sh.shape[1] not in SH_ROWS:
            raise InvalidSplats("sh", expected=f"{SH_ROWS} rows (degree 0..4)", got=str(self.sh.shape[1]))
        if (kernel is Kernel.BETA) != (beta is not None):
            got = f"{'none' if beta is None else 'values'} with kernel {kernel}"
            raise InvalidSplats("beta", expected="one value a splat for DBS and none for other kernels", got=got)

    @classmethod
    def from_gsplat(
        cls,
        means: Array,
        quats: Array,
        scales: Array,
        opacities: Array,
        colors: Array | None = None,
        *,
        activated: bool,
        kernel: Kernel | str = Kernel.GAUSSIAN_3D,
        sh0: Array | None = None,
        shN: Array | None = None,
        features_dc: Array | None = None,
        features_rest: Array | None = None,
        render_mode: RenderMode | str | None = None,
    ) -> Splats:
        """Return splats of the tensors of gsplat or nerfstudio, by their names there.

        With ``activated=False`` they are parameters of a training: ``from_gsplat(**splats, activated=False)`` of
        gsplat's trainer, ``from_gsplat(**model.gauss_params, activated=False)`` of nerfstudio's splatfacto. With
        ``activated=True`` they are what ``gsplat.rasterization`` takes.

        Args:
            means: [P, 3], the frame of the training. quats: [P, 4] w x y z, of any length.
            scales: [P, 3]; lengths where activated, else their logarithms. 2DGS takes the first two.
            opacities: [P] or [P, 1]; in 0..1 where activated, else logits.
            colors: [P, 3] RGB in 0..1, or [P, K, 3] spherical harmonics; or in place of it
            sh0, shN: [P, 1, 3] and [P, K - 1, 3], gsplat's; or features_dc, features_rest: [P, 3] and [P, K - 1, 3],
                nerfstudio's.
            activated: True if scales and opacities are lengths and opacities, not logarithms and logits.

        Raises:
            InvalidSplats: scales or opacities contradict ``activated``, colours come twice, or an array has
                another shape; the error names it. What may be and is unlikely is in ``warnings``.
        """
        scales, opacities = _floats("scales", scales), _floats("opacities", opacities)
        if activated:
            scales = _in_range("scales", scales, math.inf, "lengths of zero or more").log()
            opacities = _in_range("opacities", opacities, 1.0, "opacities in 0..1").double().logit().float()
        kernel = kernel_named(kernel)
        if scales.ndim == 2 and scales.shape[1] == 3:
            scales = scales[:, : scale_count(kernel)]
        colour_arguments = {"colors": colors, "sh0": sh0, "features_dc": features_dc}
        first = {name: _floats(name, values) for name, values in colour_arguments.items() if values is not None}
        if len(first) > 1:
            raise InvalidSplats(list(first)[1], expected="colours once", got=" and ".join(first))
        sh = first.get("colors")
        if sh is not None:
            sh = (sh[:, None] - 0.5) / SH_C0 if sh.ndim == 2 else sh
        elif "sh0" in first:
            sh = joined_harmonics(first["sh0"], shN, ("sh0", "shN"))
        elif "features_dc" in first:
            sh = joined_harmonics(first["features_dc"], features_rest, ("features_dc", "features_rest"))
        try:
            return cls(means, quats, scales, opacities, kernel, sh=sh, render_mode=render_mode)
        except InvalidSplats as error:
            name = {"log_scales": "scales", "opacity_logits": "opacities"}.get(error.argument, error.argument)
            raise InvalidSplats(name, expected=error.expected, got=error.got, hint=error.hint) from None

    def __repr__(self) -> str:
        colour = "no colour" if self.sh is None else f"sh degree {self.sh_degree}"
        origin = ", ".join(f"{value:.3g}" for value in self.origin)
        about = [] if self.origin == FILE_ORIGIN else [f"about ({origin})"]
        return one_line(self, f"{self.count} of {self.kernel}", colour, *about, f"on {self.means.device}")

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, keep: Rows) -> Splats:
        """Return the splats of a mask [P], a slice or row numbers [n], with all columns, extras and the origin.

        Raises:
            InvalidInput: they choose no splat, or are none of these (`chosen_rows`).
        """
        rows = chosen_rows(keep, self.count)
        return self._with_each(lambda column: column[rows.to(column.device)])

    def _with_each(self, change: Callable[[Tensor], Tensor]) -> Splats:
        """Return the same with every column changed."""
        columns = {name: change(value) for name, value in vars(self).items() if isinstance(value, torch.Tensor)}
        return replace(self, **columns, extras={name: change(column) for name, column in self.extras.items()})

    def transformed(self, matrix: Numbers) -> Splats:
        """Return the splats in another frame, ``p' = scale R p + translation``: places, sizes, turns and colours.

        Spherical harmonics of all degrees, the lobes of DBS and normals turn with them, so that cameras moved alike
        (`Camera.transformed`) see the same.

        Args:
            matrix: [4, 4] or [3, 4], (s R | t), scene units.

        Raises:
            InvalidInput: it is no similarity, such as a reflection or a scale for each axis.
        """
        move = Similarity.of(matrix)
        turn, place = torch.from_numpy(move.rotation), self.means.device
        fields: dict[str, Any] = {"log_scales": (self.log_scales.double() + math.log(move.scale)).float()}
        origin = None
        if self.origin == FILE_ORIGIN:
            fields["means"] = torch.from_numpy(move.points(self.positions().astype(np.float64))).to(place)
        else:  # values near the origin stay near it, and lose no digit
            fields["means"] = (move.scale * (self.means.double() @ turn.T.to(place))).float()
            origin = move.points(np.array([self.origin]))[0].tolist()
        if move.rotation.tolist() != np.eye(3).tolist():
            fields["quats"] = _rotate_quats(self.quats, move.rotation)
            if self.sh is not None:
                fields["sh"] = _rotate_harmonics(self.sh, move.rotation)
            if self.sb_params is not None:
                fields["sb_params"] = _rotate_lobes(self.sb_params, turn.to(place))
            if set(NORMALS) <= self.extras.keys():
                normals = torch.stack([self.extras[name].double() for name in NORMALS], dim=1)
                columns = (normals @ turn.T.to(normals.device)).unbind(dim=1)
                fields["extras"] = dict(self.extras)
                for name, column in zip(NORMALS, columns, strict=True):
                    fields["extras"][name] = column.to(self.extras[name].dtype)
        return replace(self, **fields, origin=origin, world=self.world.transformed(move))

    def cpu(self) -> Splats:
        """Return the same with its tensors on the CPU."""
        if self.means.device.type == "cpu":
            return self
        return self._with_each(lambda column: column.cpu())

    def positions(self, rows: Any = slice(None)) -> np.ndarray:
        """Return the means [n, 3] of these rows, or of all, in the world frame: f32, or f64 if an origin is added."""
        means = self.means.detach().cpu().numpy()[rows]
        return means if self.origin == FILE_ORIGIN else means.astype(np.float64) + self.origin

    @property
    def count(self) -> int:
        """Number of splats, P."""
        return self.means.shape[0]

    @property
    def antialiased(self) -> bool:
        """True if they were trained with the mip filter's opacity compensation, as far as is known."""
        model = None if self.render_mode is None else self.render_mode.model
        return model is RenderModel.ANTIALIASED and self.kernel is Kernel.GAUSSIAN_3D

    @property
    def sh_degree(self) -> int | None:
        """The degree of the spherical harmonics, None without colour."""
        return None if self.sh is None else int(self.sh.shape[1] ** 0.5) - 1


def _move_to_origin(
    columns: dict[str, Tensor], means: Array, origin: Sequence[float] | None
) -> tuple[Origin, list[str]]:
    """Return the origin of the means, which are shifted if it is chosen here, and a warning of rounded means."""
    stored = shared_tensor(means)
    if origin is not None and (any(origin) or stored.dtype != torch.float64):
        with reading("origin", InvalidSplats, "three finite numbers"):
            x, y, z = map(float, origin)
            if not all(map(math.isfinite, (x, y, z))):
                raise ValueError(repr(origin)[:80])
        return (x, y, z), []
    local = local_origin(stored, columns["log_scales"])
    if local == FILE_ORIGIN:
        return local, []
    offset = torch.tensor(local, dtype=torch.float64, device=stored.device)
    columns["means"] = (stored.double() - offset).to(torch.float32)
    step = float32_step(max(map(abs, local)))
    if stored.dtype == torch.float64 or step <= ROUNDED * usual_size(columns["log_scales"]):
        return local, []
    summary = f"positions came in float32, whose resolution is {step:.2g} scene units at the splats"
    return local, [f"{summary}, {max(map(abs, local)):.3g} from the origin of their file: store them as doubles"]


def _activation_warnings(columns: Mapping[str, Tensor]) -> list[str]:
    """Return warnings of numbers that look activated: files have logits of opacities and logarithms of scales.

    In a small unit all scales may be above 1. They are no logarithms where their exponentials are much larger than so
    many splats need to cover a scene of that extent.
    """
    if len(columns["means"]) < MIN_SAMPLE:
        return []
    logits, warnings = columns["opacity_logits"], []
    logits = logits[~logits.isneginf()]
    if len(logits) and bool(((logits >= 0) & (logits <= 1)).all()):
        warnings.append(
            "all opacities lie between 0 and 1, as if they were no logits: sigmoid makes them 0.5 to 0.73; if they "
            "are opacities o, give log(o / (1 - o))"
        )
    spacing = middle_and_extent(columns["means"])[1] / len(columns["means"]) ** 0.5
    if bool((columns["log_scales"] > 0).all()) and usual_size(columns["log_scales"]) > WIDEST * spacing:
        warnings.append(
            "all scales are above 0, as if they were no logarithms: exp makes them larger than 1; if they are "
            "lengths, give their logarithms"
        )
    return warnings


def _in_range(name: str, values: Tensor, maximum: float, expected: str) -> Tensor:
    """Check the range of activated values; NaN stays, as everywhere."""
    if bool(((values < 0) | (values > maximum)).any()):
        low, high = (float(end) for end in torch.aminmax(values[~values.isnan()]))
        hint = "parameters of a training, which are logarithms and logits, come with activated=False"
        raise InvalidSplats(
            name, expected=f"{expected}, as activated=True says", got=f"{low:.3g}..{high:.3g}", hint=hint
        )
    return values


def joined_harmonics(first: Tensor, rest: Array | None, names: tuple[str, str]) -> Tensor:
    """Return [P, K, 3] f32 of the constant terms [P, 3] or [P, 1, 3] and all others [P, K - 1, 3], or None."""
    terms = [first] if rest is None else [first, _floats(names[1], rest)]
    try:
        return torch.cat([array.reshape(len(array), -1, 3) for array in terms], dim=1)
    except (RuntimeError, TypeError):
        got = " and ".join(str(list(array.shape)) for array in terms)
        expected = "shapes [P, 1, 3] and [P, K, 3]"
        raise InvalidSplats(" and ".join(names), expected=expected, got=got) from None


def _rotate_quats(quats: Tensor, rotation: np.ndarray) -> Tensor:
    """Return [P, 4] f32, of splats that are turned: the product of a rotation's quaternion and theirs."""
    product = torch.from_numpy(product_matrix(rotation))
    stored = quats.double()
    largest = stored.abs().amax(dim=1, keepdim=True)
    identity = stored.new_tensor([1.0, 0.0, 0.0, 0.0])
    return (torch.where(largest > 0, stored, identity) @ product.T.to(stored.device)).float()


def _rotate_harmonics(sh: Tensor, rotation: np.ndarray) -> Tensor:
    """Return [P, K, 3] f32, coefficients of colours that are turned with the scene, band by band."""
    bands = [sh[:, :1]]
    for band in range(1, int(sh.shape[1] ** 0.5)):
        turn = torch.from_numpy(band_rotation(band, rotation)).to(sh)
        bands.append(torch.einsum("ij,pjc->pic", turn, sh[:, band**2 : (band + 1) ** 2]))
    return torch.cat(bands, dim=1)


def _rotate_lobes(lobes: Tensor, turn: Tensor) -> Tensor:
    """Return [P, S, 6] f32, with the directions (theta, phi) of beta lobes turned by [3, 3] f64."""
    theta, phi = lobes[..., 3].double(), lobes[..., 4].double()
    towards = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], dim=-1) @ turn.T
    across = torch.linalg.vector_norm(towards[..., :2], dim=-1)
    angles = torch.stack(
        [torch.atan2(across, towards[..., 2]), torch.atan2(towards[..., 1], towards[..., 0])], dim=-1
    )
    return torch.cat([lobes[..., :3], angles.float(), lobes[..., 5:]], dim=-1)


def _kernel_warnings(mode: RenderMode | None, kernel: Kernel) -> list[str]:
    """Warn if the kernel contradicts the render mode of the training."""
    if mode is None or mode.model is RenderModel.CLASSIC:
        return []
    expected = Kernel.GAUSSIAN_2D if mode.model is RenderModel.DISCS else Kernel.GAUSSIAN_3D
    return [] if expected is kernel else [f"{mode.source} says {mode.model}, but the splats are taken for {kernel}"]


def shared_tensor(values: object) -> Tensor:
    """Return a tensor over the same memory; arrays with negative strides or another byte order are copied."""
    if isinstance(values, torch.Tensor) or hasattr(values, "__cuda_array_interface__"):  # the latter as CuPy's are
        return torch.as_tensor(values).detach()
    array = np.asarray(values)
    if not array.dtype.isnative:
        array = array.astype(array.dtype.newbyteorder("="))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of read-only arrays: no caller writes to them
        return torch.from_numpy(np.ascontiguousarray(array))


def _extra(name: str, values: Array, count: int) -> Tensor:
    """Convert a further column [P] of any type."""
    with reading(f"extras[{name!r}]", InvalidSplats, f"numbers [{count}], one a splat"):
        column = shared_tensor(values)
        if column.shape != (count,):
            raise ValueError(f"shape {list(column.shape)}")
    return column


def _floats(name: str, values: Array) -> Tensor:
    """Convert values to f32 on their device, without a copy if they are f32."""
    with reading(name, InvalidSplats, "an array of torch or numpy"):
        tensor = shared_tensor(values)
        if not tensor.is_floating_point():
            raise ValueError(f"floats, got {str(tensor.dtype).removeprefix('torch.')}")
    return tensor.to(torch.float32)


def _column(name: str, values: Array, shape: tuple[Any, ...], device: torch.device) -> Tensor:
    """Convert values to f32 of a shape, whose ``...`` is any number."""
    column = _floats(name, values)
    if len(shape) == 1 and column.ndim == 2 and column.shape[1] == 1:  # as Inria's code keeps opacities
        column = column[:, 0]
    with reading(name, InvalidSplats, "floats"):
        sides = zip(shape, column.shape, strict=False)
        if column.ndim != len(shape) or any(expected not in (..., side) for expected, side in sides):
            expected_sides = ", ".join("any" if side is ... else str(side) for side in shape)
            raise ValueError(f"floats of shape [{expected_sides}], got shape {list(column.shape)}")
        if column.device != device:
            raise ValueError(f"an array on {device}, where the means are, got {column.device}")
    return column


def _repair_columns(columns: dict[str, Tensor]) -> tuple[dict[str, Tensor], list[str]]:
    """Replace NaN and infinity in columns (`Splats`), and return a warning of each kind."""
    count, warnings = len(columns["means"]), list[str]()
    bad_rows = {
        name: ~_meaningful(name, values).reshape(count, -1).all(dim=1)
        for name, values in columns.items()
        if not _all_meaningful(name, values)
    }
    geometry = [name for name in _GEOMETRY if name in bad_rows]
    columns = dict(columns)
    if geometry:
        unseen = torch.stack([bad_rows[name] for name in geometry]).any(dim=0)
        if bool(unseen.all()):
            got = f"{count} whose {' and '.join(geometry)} are NaN or infinite"
            raise InvalidSplats("splats", expected="at least one splat of finite numbers", got=got)
        for name in geometry:
            values, rows = columns[name], bad_rows[name].reshape(-1, *[1] * (columns[name].ndim - 1))
            columns[name] = torch.where(rows, values[int(bad_rows[name].int().argmin())], values)
        columns["opacity_logits"] = columns["opacity_logits"].masked_fill(unseen, -torch.inf)
        effect = "have a place, size, turn or opacity that is no number (NaN or infinite), and are invisible"
        warnings.append(_count_text(unseen, effect))
    if colours := [rows for name, rows in bad_rows.items() if name not in _GEOMETRY]:
        grey = torch.stack(colours).any(dim=0)
        for name in {"sh", "sb_params"} & columns.keys():
            columns[name] = columns[name].masked_fill(grey[:, None, None], 0.0)
        if "sb_params" in columns:
            columns["sb_params"][grey, :, :LOBE_COLOURS] = DARK_LOBE
        warnings.append(_count_text(grey, "have a colour that is no number (NaN or infinite), and are grey"))
    return columns, warnings


def _count_text(rows: Tensor, effect: str) -> str:
    """Return the sentence of a warning of some rows of a mask [P]."""
    return f"{int(rows.sum())} of {len(rows)} splats {effect}; the first is splat {int(rows.int().argmax())}"


def _all_meaningful(name: str, values: Tensor) -> bool:
    """Return True if all values are valid; the extremes propagate NaN, and need little memory."""
    return not values.numel() or all(bool(_meaningful(name, end)) for end in torch.aminmax(values))


def _meaningful(name: str, values: Tensor) -> Tensor:
    minus, plus = _BEYOND.get(name, (False, False))
    return torch.isfinite(values) | (torch.isneginf(values) & minus) | (torch.isposinf(values) & plus)


# ---- rows


def chosen_rows(keep: Rows, count: int) -> Tensor:
    """Return the numbers [n] i64, on the CPU, of the selected of P = ``count`` rows, in the order of the selection.

    Rows are booleans [P], a slice, or whole numbers [n], of which negative ones count from the end.
    """
    expected = f"booleans [{count}], a slice, or row numbers in 0..{count - 1}"
    selection = keep.detach().cpu().numpy() if isinstance(keep, torch.Tensor) else keep
    try:
        if not isinstance(selection, slice):
            selection = np.asarray(selection)
            selection = selection[:, 0] if selection.shape[1:] == (1,) else selection
            selection = selection if selection.size else slice(0)  # an empty list has no type
        is_slice = isinstance(selection, slice)
        rows = np.arange(*selection.indices(count)) if is_slice else np.arange(count)[selection]
        if rows.ndim != 1:
            raise IndexError(f"{keep!r}")
    except (IndexError, TypeError, ValueError) as error:
        hint = "a mask has an entry for each row; a single row is keep=[row]"
        raise InvalidInput("keep", expected=expected, got=str(error)[:120], hint=hint) from None
    if not len(rows):
        raise InvalidInput("keep", expected="at least one row", got=f"none of {count}")
    return torch.from_numpy(np.ascontiguousarray(rows))
