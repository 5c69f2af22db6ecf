"""Maps of mask ids in ``.npy`` files: an id is a row of the vectors that belong to the masks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidFeatures
from liftcore.features.views import NO_LABEL

if TYPE_CHECKING:
    from pathlib import Path


def mask_ids(stored: np.ndarray, rows: int, path: Path) -> np.ndarray:
    """[L, H, W] i32 of ids, -1 for none, stored as integers or as floats.

    Args:
        stored: [L, H, W], or [H, W] for one level. rows: vectors that there are. path: named in errors.

    Raises:
        InvalidFeatures: other axes, an id without a vector, or one that is no whole number.
    """
    if stored.ndim not in (2, 3):
        raise InvalidFeatures(str(path), expected="mask ids [L, H, W]", got=str(list(stored.shape)))
    low, high = float(stored.min()), float(stored.max())
    # NaN fails every comparison, so it is refused here too.
    if not (low >= NO_LABEL and high < rows):
        got = f"ids from {low:g} to {high:g}"
        hint = "ids are counted on over the levels; those of each level alone must be shifted first"
        raise InvalidFeatures(str(path), expected=f"ids in -1..{rows - 1}", got=got, hint=hint)
    labels = stored.astype(np.int32)
    if stored.dtype.kind == "f" and not np.array_equal(labels, stored):
        raise InvalidFeatures(str(path), expected="whole numbers as mask ids", got="fractions")
    return labels if labels.ndim == 3 else labels[None]
