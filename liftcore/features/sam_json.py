"""Masks in JSON, as segment-anything's ``SamAutomaticMaskGenerator`` returns them and SA-1B keeps them.

A list of objects whose ``segmentation`` is run lengths, alone or under ``annotations``. Mask k is the list's k-th.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

from liftcore.errors import InvalidFeatures
from liftcore.features.rle import mask_of_runs, read_runs

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

MAX_BYTES = 1 << 28  # of a file: some thousand masks of a large photo as plain numbers
EXPECTED = "a list of masks, or {'annotations': [...]}"


@dataclass(frozen=True)
class RunMasks(Sequence["np.ndarray"]):
    """Masks of one size, kept as run lengths; each is made anew, [h, w] bool, when it is asked for."""

    size: tuple[int, int]  # h, w
    runs: tuple[np.ndarray, ...]  # [n] i64 each, checked

    @overload
    def __getitem__(self, index: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, index: slice) -> RunMasks: ...
    def __getitem__(self, index: int | slice) -> np.ndarray | RunMasks:
        if isinstance(index, slice):
            return RunMasks(self.size, self.runs[index])
        return mask_of_runs(self.size, self.runs[index])

    def __len__(self) -> int:
        return len(self.runs)


def sam_masks(path: Path, count: int) -> RunMasks:
    """The masks of a file, in its order.

    Args:
        path: the file. count: how many vectors there are. Where the lists differ, nobody knows from which place on
            they ceased to match, so that is refused before anything is decoded.

    Raises:
        InvalidFeatures: no such JSON, not ``count`` masks, masks of several sizes, or as `read_runs`.
    """
    records = _records(path)
    if len(records) != count:
        hint = "leave out views without masks" if not records else "row k of the vectors is of mask k of the list"
        raise InvalidFeatures(str(path), expected=f"{count} masks, one a vector", got=str(len(records)), hint=hint)
    found = [
        read_runs(record.get("segmentation") if isinstance(record, dict) else None, f"{path} mask {number}")
        for number, record in enumerate(records)
    ]
    size = found[0][0]
    for number, (other, _) in enumerate(found):
        if other != size:
            got = f"{size[0]} x {size[1]} of mask 0 and {other[0]} x {other[1]} of mask {number}"
            raise InvalidFeatures(str(path), expected="masks of one size", got=got, hint="write those of one photo")
    return RunMasks(size, tuple(runs for _, runs in found))


def _records(path: Path) -> list[Any]:
    try:
        if path.stat().st_size > MAX_BYTES:
            got, hint = f"{path.stat().st_size} bytes", "output_mode='coco_rle' takes a fraction of them"
            raise InvalidFeatures(str(path), expected=f"at most {MAX_BYTES} bytes", got=got, hint=hint)
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise InvalidFeatures(str(path), expected=EXPECTED, got=f"no such file ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        got = f"no JSON ({str(error)[:120]})"
        raise InvalidFeatures(str(path), expected=EXPECTED, got=got, hint="write it anew with json.dump") from None
    records = content.get("annotations") if isinstance(content, dict) else content
    if not isinstance(records, list):
        got = f"an object of {', '.join(map(repr, list(content)[:3]))}"[:120] if isinstance(content, dict) else "none"
        raise InvalidFeatures(str(path), expected=EXPECTED, got=got, hint="files of no views belong elsewhere")
    return records
