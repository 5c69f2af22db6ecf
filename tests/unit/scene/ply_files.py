"""Splat files of every dialect, with seeded numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

ROTATION = [f"rot_{i}" for i in range(4)]
SCALES = [f"scale_{i}" for i in range(3)]
INRIA = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *SCALES, *ROTATION]
LOBES = [f"sb_params_{i}" for i in range(12)]
DIALECTS = {
    "inria degree 0": INRIA,
    "inria degree 3": [*INRIA[:9], *(f"f_rest_{i}" for i in range(45)), *INRIA[9:]],
    "gsplat": [*"xyz", *INRIA[6:]],
    "saga": [*"xyz", "mask", *INRIA[3:]],
    "2dgs": [name for name in INRIA if name != "scale_2"],
    "dbs": [*INRIA[:6], "sh0_0", "sh0_1", "sh0_2", *LOBES, "opacity", "beta", *SCALES, *ROTATION],
    "no colour": [*"xyz", "opacity", *SCALES, *ROTATION],
}


def ply_bytes(names: list[str], count: int = 5, types: dict[str, str] | None = None, head: str = "") -> bytes:
    """Seeded numbers; ``types`` gives columns other types than float, ``head`` more header lines."""
    types = types or {}
    codes = {"float": "f4", "double": "f8", "uchar": "u1", "ushort": "u2", "int": "i4"}
    dtype = np.dtype([(name, "<" + codes[types.get(name, "float")]) for name in names])
    rows = np.zeros(count, dtype)
    generator = np.random.default_rng(0)
    for name in names:
        rows[name] = generator.normal(size=count) if types.get(name, "float")[-1] in "te" else np.arange(count)
    lines = [f"property {types.get(name, 'float')} {name}" for name in names]
    header = "\n".join(["ply", "format binary_little_endian 1.0", f"{head}element vertex {count}", *lines])
    return header.encode() + b"\nend_header\n" + rows.tobytes()


def ply_rows(names: list[str], count: int = 5) -> np.ndarray:
    """The rows of ``ply_bytes`` of float columns, to be changed."""
    content = ply_bytes(names, count)
    dtype = np.dtype([(name, "<f4") for name in names])
    return np.frombuffer(content[-count * dtype.itemsize :], dtype).copy()


def with_ply(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "splats.ply"
    path.write_bytes(content)
    return path
