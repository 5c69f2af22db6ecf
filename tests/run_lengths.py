"""Masks as COCO and others write them, the twin of what `liftcore.features.mask_files` reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image


def sam_records(masks: np.ndarray, *, as_string: bool = False) -> list[dict[str, Any]]:
    """Return segment-anything output of masks [K, H, W]: as uncompressed_rle, or as coco_rle."""
    records = []
    for mask in masks:
        lengths = lengths_of(mask)
        counts = compressed(lengths) if as_string else lengths
        records.append({"segmentation": {"size": [*mask.shape], "counts": counts}, "area": int(mask.sum())})
    return records


def write_files(folder: Path, files: dict[str, Any]) -> Path:
    """Write bytes and texts as they are, arrays and pictures by the suffix of their name, and the rest as JSON."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, bytes):
            path.write_bytes(content)
        elif path.suffix == ".npy":
            np.save(path, content)
        elif path.suffix == ".npz":
            np.savez_compressed(path, content)
        elif path.suffix.lower() == ".png":
            (Image.fromarray(content) if isinstance(content, np.ndarray) else content).save(path)
        else:
            path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return folder


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
