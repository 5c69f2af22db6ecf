"""Masks as COCO writes them, the twin of what `liftcore.features.mask_files` reads."""

from __future__ import annotations

from typing import Any

import numpy as np


def sam_records(masks: np.ndarray, *, as_string: bool = False) -> list[dict[str, Any]]:
    """Return segment-anything output of masks [K, H, W]: as uncompressed_rle, or as coco_rle."""
    records = []
    for mask in masks:
        lengths = lengths_of(mask)
        counts = compressed(lengths) if as_string else lengths
        records.append({"segmentation": {"size": [*mask.shape], "counts": counts}, "area": int(mask.sum())})
    return records


def lengths_of(mask: np.ndarray) -> list[int]:
    """The run lengths of a mask down its columns, zeros first."""
    flat = mask.T.ravel().astype(bool)
    changes = np.flatnonzero(np.diff(flat, prepend=False))
    return np.diff(changes, prepend=0, append=flat.size).tolist()


def compressed(lengths: list[int]) -> str:
    """Lengths as COCO's string: from the fourth on, differences to the one two before."""
    numbers = [length - (lengths[place - 2] if place > 2 else 0) for place, length in enumerate(lengths)]
    return "".join(map(_characters, numbers))


def _characters(number: int) -> str:
    groups = next(n for n in range(1, 9) if -(1 << (5 * n - 1)) <= number < 1 << (5 * n - 1))
    bits = number % (1 << 5 * groups)
    parts = [bits >> 5 * group & 31 for group in range(groups)]
    return "".join(chr(48 + part + 32 * (place < groups - 1)) for place, part in enumerate(parts))
