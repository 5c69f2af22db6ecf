"""antimatter15's ``.splat``: 32 bytes a splat, without a header; rows in their order, and one colour each.

Means and scales (linear) are f32, then red, green, blue and opacity u8, then the quaternion u8, ``128 q + 128``,
w x y z.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.io.quantised import Fields, decoded, field_shapes, gaussian_rows, logits
from liftcore.scene.harmonics import constant_terms

if TYPE_CHECKING:
    from liftcore.scene.splats import Splats

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colours", "u1", 4), ("quats", "u1", 4)])
LOOKED_AT = 1024  # rows by which a file is told to be one
FARTHEST = 1e9  # scene units, of what is no accident
QUAT_LENGTHS = (0.9, 1.1)  # of a unit quaternion in bytes


def looks_like_splat(head: bytes, size: int) -> bool:
    """Whether the first rows of a file of whole rows are splats that somebody could have trained."""
    rows = np.frombuffer(head[: len(head) // ROW.itemsize * ROW.itemsize], ROW)[:LOOKED_AT]
    if not len(rows) or size % ROW.itemsize:
        return False
    with np.errstate(invalid="ignore"):
        near = np.abs(rows["means"]).max() < FARTHEST and 0 <= rows["scales"].min() <= rows["scales"].max() < FARTHEST
        lengths = np.linalg.norm(rows["quats"] / 128.0 - 1, axis=1)
    return bool(near and np.mean((lengths > QUAT_LENGTHS[0]) & (lengths < QUAT_LENGTHS[1])) > 0.9)


def read_splat(path: Path, *, colour: bool = True) -> Fields:
    """The fields of a ``.splat`` file.

    Raises:
        InvalidSplats: it has no rows, or ends within one.
    """
    size = path.stat().st_size
    if not size or size % ROW.itemsize:
        got, hint = f"{size} bytes", "the file is truncated, or none of this format: export it again"
        raise InvalidSplats(str(path), expected=f"rows of {ROW.itemsize} bytes", got=got, hint=hint)
    table = np.memmap(path, ROW, "r")

    def decode(rows: slice) -> Fields:
        read = table[rows]
        with np.errstate(divide="ignore"):  # a scale of zero is flat; a negative one is refused as no number
            scales = np.log(read["scales"].astype(np.float64))
        rgba = read["colours"] / 255.0
        fields = {"means": read["means"], "log_scales": scales, "quats": read["quats"] / 128.0 - 1}
        fields["opacity_logits"] = logits(rgba[:, 3])
        return fields | ({"sh": constant_terms(rgba[:, None, :3])} if colour else {})

    return decoded(len(table), field_shapes(1 if colour else 0), decode)


def splat_blocks(splats: Splats) -> Iterator[bytes]:
    """The bytes of a ``.splat`` file of any splats (`gaussian_rows`), in blocks; colours are the constant ones."""
    for some in gaussian_rows(splats):
        rows = np.zeros(len(some.means), ROW)
        rows["means"], rows["scales"] = some.means, some.scales
        rows["colours"][:, :3] = np.round(255 * some.colours.clip(0, 1))
        rows["colours"][:, 3] = np.round(255 * some.opacities)
        rows["quats"] = np.round(128 + 128 * some.quats).clip(0, 255)
        yield rows.tobytes()
