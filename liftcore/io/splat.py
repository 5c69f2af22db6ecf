"""antimatter15's ``.splat``: 32 bytes a splat, without a header; rows in their order, and one colour each.

Means and scales (linear) are f32, then red, green, blue and opacity u8, then the quaternion u8, ``128 q + 128``,
w x y z.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from liftcore.io.quantised import Fields, decoded, gaussian_rows, logits
from liftcore.scene.harmonics import constant_terms

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colours", "u1", 4), ("quats", "u1", 4)])
CHECKED_ROWS = 1024  # first rows, by which a file is recognised
FARTHEST = 1e9  # scene units; a larger mean is no splat's
QUAT_LENGTHS = (0.9, 1.1)  # of a unit quaternion in bytes


def looks_like_splat(head: bytes, size: int) -> bool:
    """Return True if the file has whole rows, and the first ones are plausible splats."""
    rows = np.frombuffer(head[: len(head) // ROW.itemsize * ROW.itemsize], ROW)[:CHECKED_ROWS]
    if not len(rows) or size % ROW.itemsize:
        return False
    with np.errstate(invalid="ignore"):
        near = np.abs(rows["means"]).max() < FARTHEST and 0 <= rows["scales"].min() <= rows["scales"].max() < FARTHEST
        lengths = np.linalg.norm(rows["quats"] / 128.0 - 1, axis=1)
    return bool(near and np.mean((lengths > QUAT_LENGTHS[0]) & (lengths < QUAT_LENGTHS[1])) > 0.9)


def read_splat(path: Path, *, colour: bool) -> Fields:
    """Read the fields of a ``.splat`` file."""
    size = path.stat().st_size
    if not size or size % ROW.itemsize:
        raise ValueError(f"rows of {ROW.itemsize} bytes, got {size} bytes")
    table = np.memmap(path, ROW, "r")

    def decode(rows: slice) -> Fields:
        block = table[rows]
        with np.errstate(divide="ignore"):  # a scale of zero is flat; a negative one is refused as no number
            scales = np.log(block["scales"].astype(np.float64))
        rgba = block["colours"] / 255.0
        fields = {"means": block["means"], "log_scales": scales, "quats": block["quats"] / 128.0 - 1}
        fields["opacity_logits"] = logits(rgba[:, 3])
        return fields | ({"sh": constant_terms(rgba[:, None, :3])} if colour else {})

    return decoded(len(table), decode)


def splat_blocks(splats: Splats) -> Iterator[bytes]:
    """Yield the bytes of a ``.splat`` file of any splats (`gaussian_rows`), in blocks, with constant colours."""
    for block in gaussian_rows(splats):
        rows = np.zeros(len(block.means), ROW)
        rows["means"], rows["scales"] = block.means, block.scales
        rows["colours"][:, :3] = np.round(255 * block.colours.clip(0, 1))
        rows["colours"][:, 3] = np.round(255 * block.opacities)
        rows["quats"] = np.round(128 + 128 * block.quats).clip(0, 255)
        yield rows.tobytes()
