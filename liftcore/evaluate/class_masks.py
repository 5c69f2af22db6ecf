"""Masks that lifts are evaluated by: a ``.safetensors`` file with ``VIEW/mask`` [h, w] of class numbers, -1 for none.

In u8 none is 255. Other tensors in the file are ignored. Masks need not have the image's size.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from liftcore.errors import InvalidMasks, reading
from liftcore.io.safetensors_file import check_header
from liftcore.scene.views import composed
from liftcore.values.pack import U8_NO_LABEL

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from torch import Tensor

NO_CLASS = -1
MASK_TYPES = ("U8", "I8", "I16", "I32", "I64")
EXPECTED = "labels, as VIEW/mask [h, w] (.safetensors)"


def read_masks(path: Path, classes: int) -> dict[str, Tensor]:
    """Read masks: view -> [h, w] i64 of numbers below ``classes``, NO_CLASS for none.

    Raises:
        InvalidMasks: no such file, not a safetensors file, or a mask that is no image of class numbers.
    """
    return {view: mask for view, mask, _ in _masks(path, classes)}


def describe_masks(path: Path) -> dict[str, Any]:
    """Read every mask: counts, sizes and warnings. ``classes`` is one more than the largest number.

    Raises:
        InvalidMasks: as `read_masks`; or there is none.
    """
    views, sizes, none, highest = list[str](), set[str](), 0, NO_CLASS
    unlabelled = 0.0
    for view, mask, top in _masks(path, None):
        views.append(view)
        sizes.add(f"{mask.shape[1]}x{mask.shape[0]}")
        none += top == NO_CLASS
        highest = max(highest, top)
        unlabelled += float((mask == NO_CLASS).double().mean())
    if not views:
        raise InvalidMasks(str(path), expected=EXPECTED, got="no VIEW/mask")
    return {
        "views": len(views),
        "names": views,
        "classes": highest + 1,
        "sizes": sorted(sizes),
        "unlabelled": unlabelled / len(views),
        "warnings": [f"{none} of {len(views)} masks name no class"] if none else [],
    }


def _masks(path: Path, classes: int | None) -> Iterator[tuple[str, Tensor, int]]:
    """Iterate over views in order, with their mask [h, w] i64 and its highest number."""
    from safetensors import SafetensorError, safe_open

    with reading(path, InvalidMasks, EXPECTED):
        check_header(path)
    try:
        with safe_open(str(path), framework="pt") as handle:
            for name in sorted(name for name in tuple(handle.keys()) if name.endswith("/mask")):
                location, part = f"{path} {name[:80]!r}", handle.get_slice(name)
                _check_kind(location, part.get_dtype(), part.get_shape())
                mask = handle.get_tensor(name).long()
                if part.get_dtype() == "U8":  # as in the labels of feature packs: it has no -1
                    mask[mask == U8_NO_LABEL] = NO_CLASS
                yield composed(name.removesuffix("/mask")), mask, _highest(location, mask, classes)
    except (SafetensorError, OSError) as error:
        got = f"a file that does not open as one ({str(error)[:120]})"
        raise InvalidMasks(str(path), expected=EXPECTED, got=got) from None


def _check_kind(location: str, dtype: str, shape: list[int]) -> None:
    if len(shape) != 2 or not all(shape) or dtype not in MASK_TYPES:
        raise InvalidMasks(
            location, expected="labels as integers [h, w], no side empty", got=f"{dtype} {shape}"[:120]
        )


def _highest(location: str, mask: Tensor, classes: int | None) -> int:
    """Return the highest number in a mask, after a check that all are classes or none."""
    low, high = (int(value) for value in torch.aminmax(mask))
    if low < NO_CLASS or (classes is not None and high >= classes):
        top = "0.." if classes is None else f"0..{classes - 1}"
        got = f"the number {low if low < NO_CLASS else high}"
        raise InvalidMasks(location, expected=f"labels of {NO_CLASS} or classes {top}", got=got)
    return high
