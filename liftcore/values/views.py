"""Observation of one view: ``B = S E`` with a codebook E [M, F] and a sparse reading S [rays, M].

S is never built. A region map says for every pixel which codebook row each level reads; a feature grid is
read by bilinear interpolation, four rows a pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidFeatures, reading
from liftcore.io.npy import without_unit_axes
from liftcore.runtime.arguments import check_choice
from liftcore.runtime.one_line import one_line
from liftcore.scene.splats import Array, shared_tensor
from liftcore.values.fit import FITS, Fit

NO_LABEL = -1  # a pixel that a level leaves unlabelled
DENSE_ROWS = 1 << 17  # of a view's codebook, beyond which a map is dense: near to a vector a pixel
LARGEST = 1e15  # of a feature; float32 sums of squares over all channels stay finite far beyond
MAX_CHANNELS = 1 << 16
PLANES = "masks [M, h, w], a plane for each row of vectors, are Regions.from_masks(masks.astype(bool), vectors)"
MAX_LEVELS = 32  # a hierarchy of four partitions, with masks 1 to 4 pixels over their neighbours, took 13 to 18
MOST_LEVELS = 127  # of label maps; a level's number takes a byte
INTEGERS = (torch.int32, torch.int16, torch.int64, torch.int8, torch.uint8)
WIDENED = (torch.uint16, torch.uint32)  # of pictures of 16 bits; torch does hardly anything with these
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
        context: text before the argument's name in errors, such as a view.

    Both come from numpy or torch, on the CPU or a GPU, without a copy where type and order allow.

    Raises:
        InvalidFeatures: another shape or type, a label out of the codebook, or a value that is not finite.
    """

    labels: Tensor
    """[L, h, w] i32"""
    codebook: Tensor
    """[M, F] f16 or f32"""

    def __init__(self, labels: Array, codebook: Array, *, context: str = "") -> None:
        with reading(f"{context} codebook".strip(), InvalidFeatures, "floats [M, F]"):
            vars(self).update(codebook=_features(codebook, "M, F"))
        with reading(f"{context} labels".strip(), InvalidFeatures, "integers [L, h, w]"):
            vars(self).update(labels=_labels(labels, len(self.codebook)))

    @classmethod
    def from_masks(cls, masks: Array | Sequence[Array], vectors: Array) -> Self:
        """Return regions of masks that may overlap, as those of SAM, with a vector each.

        A pixel under several masks has a label of each, on a level of its own (`label_levels`): it reads all their
        vectors, and none of them is lost. An empty mask is on no pixel; masks [0, H, W] with vectors [0, F] are a
        view without labels.

        Args:
            masks: [M, H, W] of booleans, or a sequence of M of [H, W]; also [M, 1, H, W], as SAM's predictor gives
                them. They need not have the photo's size.
            vectors: [M, F] of floats, row k of mask k.

        Raises:
            InvalidFeatures: masks that are no booleans, or of another number than the vectors; or as the constructor
                has it.
        """
        if np.ndim(vectors) == 2 and not len(vectors) and np.shape(masks)[:1] == (0,):  # nothing was found here
            size = np.shape(masks)[-2:] if np.ndim(masks) >= 3 else (1, 1)
            return cls(np.full(size, NO_LABEL, np.int32), np.zeros((1, vectors.shape[1]), np.float32))
        with reading("vectors", InvalidFeatures, "floats [M, F]"):
            codebook = _features(vectors, "M, F")
        with reading("masks", InvalidFeatures, "booleans [M, H, W]"):
            labels = label_levels(list(_planes(masks, len(codebook))))
        return cls.unchecked(torch.from_numpy(labels).to(codebook.device), codebook)

    def __repr__(self) -> str:
        sizes = f"labels={list(self.labels.shape)}, codebook={list(self.codebook.shape)}"
        return one_line(self, f"{sizes} {_dtype_name(self.codebook)}", f"on {self.codebook.device}")

    def cpu(self) -> Self:
        """Return the same with its tensors on the CPU."""
        return self.unchecked(self.labels.cpu(), self.codebook.cpu())

    @classmethod
    def unchecked(cls, labels: Tensor, codebook: Tensor) -> Self:
        """Return regions of tensors that are valid by construction."""
        instance = object.__new__(cls)
        vars(instance).update(labels=labels, codebook=codebook)
        return instance


@dataclass(frozen=True, eq=False, init=False)
class FeatureGrid:
    """A dense feature map, read bilinearly with half-pixel centres and clamped borders.

    Pixel (x, y) of a W x H image samples the grid at ``u = (x + 0.5) w / W - 0.5`` and
    ``v = (y + 0.5) h / H - 0.5``, clamped to the grid (``align_corners=False``).
    Cell (r, c) is codebook row ``r * w + c``.

    Args:
        grid: [h, w, F] of floats, as the codebook of `Regions`. Maps [F, h, w] of torch are ``permute(1, 2, 0)``.
        fit: of the map to its photo, one of ``FITS`` (`liftcore.values.fit`): what the encoder's preprocessing
            did to the photo. "": not known, read as ``stretch``, with a warning where shapes differ.
        context: text before the argument's name in errors, such as a view.

    Raises:
        InvalidFeatures: another shape or type, or a value that is not finite.
    """

    grid: Tensor
    """[h, w, F] f16 or f32"""
    fit: Fit | Literal[""]
    """of the map to its photo; "" for not known"""

    def __init__(self, grid: Array, *, fit: Fit | Literal[""] = "", context: str = "") -> None:
        with reading(f"{context} grid".strip(), InvalidFeatures, "floats [h, w, F]"):
            vars(self).update(grid=_features(grid, "h, w, F"), fit=fit)
        if fit:
            check_choice(f"{context} fit".strip(), fit, FITS, InvalidFeatures)

    def __repr__(self) -> str:
        dtype = _dtype_name(self.grid)
        return one_line(self, f"{list(self.grid.shape)} {dtype}", self.fit, f"on {self.grid.device}")

    def cpu(self) -> Self:
        """Return the same with its tensor on the CPU."""
        return self.unchecked(self.grid.cpu(), self.fit)

    @classmethod
    def unchecked(cls, grid: Tensor, fit: Fit | Literal[""] = "") -> Self:
        """Return a grid of a tensor that is right by how it was made."""
        instance = object.__new__(cls)
        vars(instance).update(grid=grid, fit=fit)
        return instance

    @property
    def codebook(self) -> Tensor:
        """[h * w, F], a view of the grid."""
        return self.grid.reshape(-1, self.grid.shape[-1])


ViewFeatures = Regions | FeatureGrid


def label_levels(masks: Sequence[np.ndarray]) -> np.ndarray:
    """Return [L, h, w] i32: label k where mask k is, -1 for none; an empty mask has no label.

    The largest mask comes first, of equals the one that was given first, and each goes to the first level on which
    none of its pixels is taken. No pixel of any mask is lost, and what lies alone is on level 0. A lift that takes
    levels as rows of their own needs only the masks of a pixel, so there their level does not matter.

    Args:
        masks: [h, w] bool each, at least one, all of one size; each is read twice.
    """
    boxes, areas = zip(*map(_extent, masks), strict=True)
    # Space for all levels that there may be: pages of those that are never written take no memory.
    labels = np.empty((min(MAX_LEVELS, len(masks)), *masks[0].shape), np.int32)
    labels[0] = NO_LABEL
    level_count = 1
    for number in sorted(range(len(masks)), key=lambda number: -areas[number]):
        if not areas[number]:
            break
        inside, windows = masks[number][boxes[number]], labels[:, *boxes[number]]
        level = next((k for k in range(level_count) if not ((windows[k] != NO_LABEL) & inside).any()), level_count)
        if level == MAX_LEVELS:
            depth = np.zeros(masks[0].shape, np.int32)
            for mask in masks:
                depth += mask
            got = f"{len(masks)} masks, up to {depth.max()} of them over one pixel"
            hint = "leave out those that are nearly the same, as SamAutomaticMaskGenerator does by box_nms_thresh"
            raise ValueError(f"masks that lie on {MAX_LEVELS} levels without overlap, got {got}; {hint}")
        if level == level_count:
            labels[level] = NO_LABEL
            level_count += 1
        windows[level][inside] = number
    return labels[:level_count]


def _extent(mask: np.ndarray) -> tuple[tuple[slice, slice], int]:
    """Return the rows and columns between which a mask's pixels lie, and how many it has."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return (slice(0), slice(0)), 0
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    return box, int(np.count_nonzero(mask[box]))


def _planes(masks: Array | Sequence[Array], count: int) -> np.ndarray:
    """Return masks [M, h, w] bool on the CPU, one for each of so many vectors."""
    tensors = [mask for mask in masks if isinstance(mask, Tensor)] if isinstance(masks, Sequence) else []
    try:
        planes = (torch.stack(tensors) if tensors else shared_tensor(masks)).cpu()
    except RuntimeError as error:
        raise ValueError(str(error)[:80]) from None
    planes = planes[:, 0] if planes.ndim == 4 and planes.shape[1] == 1 else without_unit_axes(planes, 3)
    if planes.ndim != 3 or planes.dtype != torch.bool or not planes.numel():
        expected = "booleans [M, H, W], at least one mask and no side empty"
        hint = "; masks of numbers are booleans by masks > 0.5" if planes.dtype != torch.bool else ""
        raise ValueError(f"{expected}, got {_kind(planes)}{hint}")
    if len(planes) != count:
        got = f"{len(planes)} of shape {list(planes.shape[1:])}"
        raise ValueError(f"{count} masks, one a vector, got {got}; row k of the vectors is of mask k")
    return planes.numpy()


def check_finite(values: Tensor) -> None:
    """Refuse NaN, infinity, and what no encoder gives and whose squares would be infinite."""
    # The extremes carry NaN and infinity along, and cost a tenth of testing every value.
    low, high = torch.aminmax(values) if values.numel() else values.new_zeros(2)
    if not (float(low) >= -LARGEST and float(high) <= LARGEST):  # in float64: float16 would take the bound for inf
        bad = int((~(values.float().abs() <= LARGEST)).sum())
        got = f"{bad} of {values.numel()} that are NaN, infinite or larger"
        raise ValueError(f"finite values within +-{LARGEST:g}, got {got}")


def _features(values: object, axes: str) -> Tensor:
    """Return [.., F] f16 or f32, contiguous and finite."""
    tensor = without_unit_axes(shared_tensor(values), len(axes.split()))
    fits = tensor.ndim == len(axes.split()) and tensor.numel() and tensor.dtype in FLOATS
    if not fits or tensor.shape[-1] > MAX_CHANNELS:
        hint = f"at most {MAX_CHANNELS} channels, no side empty"
        raise ValueError(f"floats [{axes}], got {_kind(tensor)}; {hint}")
    tensor = tensor if tensor.dtype in (torch.float16, torch.float32) else tensor.float()
    check_finite(tensor)
    return tensor.contiguous()


def _labels(values: object, rows: int) -> Tensor:
    """Return [L, h, w] i32, contiguous, each -1 or below ``rows``."""
    tensor = shared_tensor(values)
    tensor = without_unit_axes(tensor.to(torch.int64) if tensor.dtype in WIDENED else tensor, 3)
    if tensor.ndim == 3 and tensor.shape[-1] == 1 < len(tensor):  # [h, w, 1]: no photo is a pixel wide
        tensor = tensor[..., 0]
    if tensor.ndim not in (2, 3) or not tensor.numel() or tensor.dtype not in INTEGERS:
        hint = PLANES if tensor.dtype == torch.bool else ""
        raise ValueError(f"integers [L, h, w], no side empty, got {_kind(tensor)}; {hint}")
    if tensor.ndim == 3 and len(tensor) > MOST_LEVELS:
        hint = "put maps whose labels do not overlap together, or lift some of them"
        raise ValueError(f"at most {MOST_LEVELS} levels, got {_kind(tensor)}; {hint}")
    low, high = (int(value) for value in torch.aminmax(tensor))
    if tensor.ndim == 3 and len(tensor) == rows > 2 and (low, high) == (0, 1):  # would be of the first two rows alone
        got = f"{_kind(tensor)} of zeros and ones, a plane for each of the {rows} rows"
        raise ValueError(f"integers [L, h, w] of rows, got {got}; {PLANES}")
    if low < NO_LABEL or high >= rows:
        got = f"the label {low if low < NO_LABEL else high}"
        hint = "label k is row k of the vectors, through all levels; where 0 means none, save labels - 1"
        raise ValueError(f"rows of its codebook (0..{rows - 1}) or {NO_LABEL} for none, got {got}; {hint}")
    return tensor.to(torch.int32).reshape(-1, *tensor.shape[-2:]).contiguous()


def _kind(tensor: Tensor) -> str:
    return f"{_dtype_name(tensor)} {list(tensor.shape)}"


def _dtype_name(tensor: Tensor) -> str:
    return str(tensor.dtype).removeprefix("torch.")
