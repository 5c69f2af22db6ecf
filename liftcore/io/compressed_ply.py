"""PlayCanvas's compressed PLY, as SuperSplat writes it: 16 bytes a splat, in chunks of 256 with their ranges.

An element ``chunk`` holds the least and largest value of means, log scales and, in newer files, colours. An element
``vertex`` holds four u32: means and scales in 11, 10 and 11 bits, the smallest three parts of the quaternion in 10
bits each behind two bits for the largest, and red, green, blue and opacity in 8. An element ``sh`` may hold the
higher harmonics, u8, channel-major. The writer sorts the rows; ours are the file's.
"""

from pathlib import Path

import numpy as np

from liftcore.io.ply import parse_elements, read_head, tail_warnings
from liftcore.io.quantised import Fields, decoded, logits, smallest_three
from liftcore.scene.harmonics import constant_terms
from liftcore.scene.render_mode import mode_of_comments

CHUNK_ROWS = 256
AXES = ("x", "y", "z")
SH_COLUMNS = (9, 24, 45)  # of degree 1 to 3
SH_RANGE = 8.0  # of a higher harmonic, from -4 to 4


def read_compressed_ply(path: Path, *, colour: bool) -> Fields:
    """Read the fields of a compressed PLY."""
    head, size = read_head(path)
    lines, elements, offset = parse_elements(head)
    mode, warnings = mode_of_comments(lines)
    tables: dict[str, np.ndarray] = {}
    total = offset + sum(element.count * element.dtype.itemsize for element in elements)
    if total > size or any(element.list_column for element in elements):
        raise ValueError(f"{total} bytes as its header says, got {size}")
    for element in elements:
        table = np.memmap(path, np.uint8, "r", 0)[offset : offset + element.count * element.dtype.itemsize]
        tables[element.name] = table.view(element.dtype)
        offset += element.count * element.dtype.itemsize
    chunks, vertices, harmonics = _check_tables(tables)
    higher = 0 if harmonics is None or not colour else len(harmonics.dtype.names or ()) // 3

    def decode(rows: slice) -> Fields:
        block = vertices[rows]
        chunk = chunks[np.arange(rows.start, rows.stop) // CHUNK_ROWS]
        rotation = block["packed_rotation"]
        parts = (np.stack([_unit(rotation, shift, 10) for shift in (20, 10, 0)], axis=1) - 0.5) * np.sqrt(2)
        rgba = np.stack([_unit(block["packed_color"], shift, 8) for shift in (24, 16, 8, 0)], axis=1)
        fields = {
            "means": _in_range(_three(block["packed_position"]), chunk, AXES),
            "log_scales": _in_range(_three(block["packed_scale"]), chunk, [f"scale_{axis}" for axis in AXES]),
            "quats": smallest_three(parts, (rotation >> 30).astype(np.int64)),
            "opacity_logits": logits(rgba[:, 3]),
        }
        if not colour:
            return fields
        colours = _in_range(rgba[:, :3], chunk, "rgb") if "min_r" in (chunks.dtype.names or ()) else rgba[:, :3]
        fields["sh"] = np.empty((len(block), 1 + higher, 3))
        fields["sh"][:, 0] = constant_terms(colours)
        if harmonics is not None and higher:
            levels = np.stack([harmonics[f"f_rest_{i}"][rows] for i in range(3 * higher)], axis=1).astype(np.float64)
            unit = np.where(levels == 0, 0.0, np.where(levels == 255, 1.0, (levels + 0.5) / 256))
            fields["sh"][:, 1:] = ((unit - 0.5) * SH_RANGE).reshape(-1, 3, higher).transpose(0, 2, 1)
        return fields

    fields = decoded(len(vertices), decode)
    return fields | {"render_mode": mode, "warnings": (*warnings, *tail_warnings(path, size, total))}


def _check_tables(tables: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return the tables of chunks, vertices and harmonics, which fit together."""
    chunks, vertices, harmonics = (tables.get(name) for name in ("chunk", "vertex", "sh"))
    if chunks is None or vertices is None or not len(vertices):
        raise ValueError("at least one splat in chunks, got an empty scene")
    if len(chunks) != -(-len(vertices) // CHUNK_ROWS):
        raise ValueError(f"a chunk for {CHUNK_ROWS} splats, got {len(chunks)} for {len(vertices)}")
    if harmonics is not None:
        columns = harmonics.dtype.names or ()
        is_bytes = all(harmonics.dtype[name] == "u1" for name in columns)
        if len(columns) not in SH_COLUMNS or len(harmonics) != len(vertices) or not is_bytes:
            expected = f"{' or '.join(map(str, SH_COLUMNS))} uchar f_rest_* of each splat in the element 'sh'"
            raise ValueError(f"{expected}, got {len(columns)} of {len(harmonics)} splats")
    return chunks, vertices, harmonics


def _unit(values: np.ndarray, shift: int, bits: int) -> np.ndarray:
    maximum = (1 << bits) - 1
    return ((values >> shift) & maximum) / maximum


def _three(values: np.ndarray) -> np.ndarray:
    """Unpack values [n] of 11, 10 and 11 bits to [n, 3] in 0..1."""
    return np.stack([_unit(values, 21, 11), _unit(values, 11, 10), _unit(values, 0, 11)], axis=1)


def _in_range(units: np.ndarray, chunk: np.ndarray, names: "list[str] | tuple[str, ...] | str") -> np.ndarray:
    """Scale values [n, 3] in 0..1 to the range that each row's chunk has of these columns."""
    low, high = (np.stack([chunk[f"{end}_{name}"] for name in names], axis=1).astype(float) for end in ("min", "max"))
    return low * (1 - units) + high * units
