"""What one view observes: ``B = S E`` with a codebook E [M, F] and a sparse reading S [rays, M].

S is never built. A region map says for every pixel which codebook row each level reads; a feature grid is
read by bilinear interpolation, four rows a pixel.
"""

from dataclasses import dataclass
from typing import Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidFeatures
from liftcore.io.npy import without_unit_axes
from liftcore.scene.splats import shared_tensor

NO_LABEL = -1  # a pixel that a level leaves unlabelled
LARGEST = 1e15  # of a feature; float32 sums of squares over all channels stay finite far beyond
MAX_CHANNELS = 1 << 16
PLANES = "of masks [M, h, w] that do not overlap give numpy.where(masks.any(0), masks.argmax(0), -1), a row a mask"
INTEGERS = (torch.int32, torch.int16, torch.int64, torch.int8, torch.uint8)
WIDENED = (torch.uint16, torch.uint32)  # of pictures of 16 bits; torch does hardly anything with these
Array = Tensor | np.ndarray
FLOATS = (torch.float16, torch.float32, torch.float64, torch.bfloat16)
Numbers = TypeVar("Numbers", np.ndarray, Tensor)


def cells_under(pixels: Numbers, size: int, cells: int) -> Numbers:
    """``floor((p + 0.5) cells / size)`` of pixels p of a side of ``size``, in whole numbers: the cells they read."""
    return (2 * pixels + 1) * cells // (2 * size)


@dataclass(frozen=True, eq=False, init=False)
class Regions:
    """Regions with one embedding each; every labelled level of a ray is a row of its own.

    The map may have another size than the image: pixel (x, y) of a W x H image reads
    ``labels[:, floor((y + 0.5) h / H), floor((x + 0.5) w / W)]``.

    Args:
        labels: [L, h, w], or [h, w] for one level, of integers: rows of the codebook, -1 for none. Here and in the
            others, axes of length 1 before these are taken off.
        codebook: [M, F] of floats; float16 and float32 stay as they are, others become float32.
        where: what errors name before the argument.

    Both come from numpy or torch, on the CPU or a card, without a copy where type and order allow.

    Raises:
        InvalidFeatures: another shape or type, a label out of the codebook, or a value that is not finite.
    """

    labels: Tensor  # [L, h, w] i32
    codebook: Tensor  # [M, F] f16 or f32

    def __init__(self, labels: Array, codebook: Array, *, where: str = "") -> None:
        rows = _features(codebook, "M, F", f"{where} codebook".strip())
        object.__setattr__(self, "codebook", rows)
        object.__setattr__(self, "labels", _labels(labels, len(rows), f"{where} labels".strip()))

    def cpu(self) -> Self:
        """The same with its tensors on the CPU."""
        return self.unchecked(self.labels.cpu(), self.codebook.cpu())

    @classmethod
    def unchecked(cls, labels: Tensor, codebook: Tensor) -> Self:
        """Regions of tensors that are right by how they were made."""
        made = object.__new__(cls)
        object.__setattr__(made, "labels", labels)
        object.__setattr__(made, "codebook", codebook)
        return made


@dataclass(frozen=True, eq=False, init=False)
class FeatureGrid:
    """A dense feature map, read bilinearly with half-pixel centres and clamped borders.

    Pixel (x, y) of a W x H image samples the grid at ``u = (x + 0.5) w / W - 0.5`` and
    ``v = (y + 0.5) h / H - 0.5``, clamped to the grid (``align_corners=False``).
    Cell (r, c) is codebook row ``r * w + c``.

    Args:
        grid: [h, w, F] of floats, as the codebook of `Regions`. Maps [F, h, w] of torch are ``permute(1, 2, 0)``.
        where: what errors name before the argument.

    Raises:
        InvalidFeatures: another shape or type, or a value that is not finite.
    """

    grid: Tensor  # [h, w, F] f16 or f32

    def __init__(self, grid: Array, *, where: str = "") -> None:
        where = f"{where} grid".strip()
        found = _features(grid, "h, w, F", where)
        object.__setattr__(self, "grid", found)

    def cpu(self) -> Self:
        """The same with its tensor on the CPU."""
        return self.unchecked(self.grid.cpu())

    @classmethod
    def unchecked(cls, grid: Tensor) -> Self:
        """A grid of a tensor that is right by how it was made."""
        made = object.__new__(cls)
        object.__setattr__(made, "grid", grid)
        return made

    @property
    def codebook(self) -> Tensor:
        """[h * w, F], a view of the grid."""
        return self.grid.reshape(-1, self.grid.shape[-1])


ViewFeatures = Regions | FeatureGrid


def check_finite(values: Tensor, where: str) -> None:
    """Refuse NaN, infinity, and what no encoder gives and whose squares would be infinite.

    Raises:
        InvalidFeatures: some value is not finite or too large; the error says where and how many.
    """
    # The extremes carry NaN and infinity along, and cost a tenth of testing every value.
    low, high = torch.aminmax(values) if values.numel() else (torch.zeros(()), torch.zeros(()))
    if not (float(low) >= -LARGEST and float(high) <= LARGEST):  # in float64: float16 would take the bound for inf
        bad = int((~(values.float().abs() <= LARGEST)).sum())
        got = f"{bad} of {values.numel()} that are NaN, infinite or larger"
        raise InvalidFeatures(where, expected=f"finite values within +-{LARGEST:g}", got=got)


def _features(values: object, axes: str, where: str) -> Tensor:
    """[.., F] f16 or f32, contiguous and finite."""
    try:
        found = shared_tensor(values)
    except (TypeError, ValueError):
        raise InvalidFeatures(where, expected=f"floats [{axes}]", got=type(values).__name__) from None
    found = without_unit_axes(found, len(axes.split()))
    fits = found.ndim == len(axes.split()) and found.numel() and found.dtype in FLOATS
    if not fits or found.shape[-1] > MAX_CHANNELS:
        hint = f"at most {MAX_CHANNELS} channels, no side empty"
        raise InvalidFeatures(where, expected=f"floats [{axes}]", got=_kind(found), hint=hint)
    found = found if found.dtype in (torch.float16, torch.float32) else found.float()
    check_finite(found, where)
    return found.contiguous()


def _labels(values: object, rows: int, where: str) -> Tensor:
    """[L, h, w] i32, contiguous, each -1 or below ``rows``."""
    try:
        found = shared_tensor(values)
    except (TypeError, ValueError):
        raise InvalidFeatures(where, expected="integers [L, h, w]", got=type(values).__name__) from None
    found = without_unit_axes(found.to(torch.int64) if found.dtype in WIDENED else found, 3)
    if found.ndim == 3 and found.shape[-1] == 1 < len(found):  # [h, w, 1]: no photo is a pixel wide
        found = found[..., 0]
    if found.ndim not in (2, 3) or not found.numel() or found.dtype not in INTEGERS:
        hint = PLANES if found.dtype == torch.bool else ""
        raise InvalidFeatures(where, expected="integers [L, h, w], no side empty", got=_kind(found), hint=hint)
    low, high = (int(value) for value in torch.aminmax(found))
    if found.ndim == 3 and len(found) == rows > 2 and (low, high) == (0, 1):  # would be of the first two rows alone
        got = f"{_kind(found)} of zeros and ones, a plane for each of the {rows} rows"
        raise InvalidFeatures(where, expected="integers [L, h, w] of rows", got=got, hint=PLANES)
    if low < NO_LABEL or high >= rows:
        expected = f"rows of its codebook (0..{rows - 1}) or {NO_LABEL} for none"
        got = f"the label {low if low < NO_LABEL else high}"
        raise InvalidFeatures(where, expected=expected, got=got)
    return found.to(torch.int32).reshape(-1, *found.shape[-2:]).contiguous()


def _kind(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
