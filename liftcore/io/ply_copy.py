"""Copies of splat files that differ in one thing: some of the rows, or all of them in other colours.

They are made of the file's own bytes, a block of rows at a time: whatever else it holds stays as it is, and a scene
of any size takes a few MB of memory.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from liftcore.errors import InvalidSplats
from liftcore.io.ply import BLOCK_ROWS
from liftcore.io.ply_dialect import model_slots, recognise_kernel
from liftcore.io.ply_header import PlyHeader, read_header

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

LOBE_COLOURS = 3  # r g b, the first channels of a spherical beta lobe
DARK_LOBE = -10.0  # r g b of a lobe that adds nothing: its softplus of sharpness 10 ln 2 is 1e-31, and of zero 0.1


def some_rows(path: Path, kept: np.ndarray) -> Iterator[bytes]:
    """A splat file with some of its rows.

    Args:
        path: the file.
        kept: [P] bool, the rows to keep, in the order of the file.

    Yields:
        The bytes of the copy, in blocks.

    Raises:
        InvalidSplats: the file is malformed, or has another number of splats.
    """
    header = _header(path, len(kept))
    yield _head(header, int(np.count_nonzero(kept)))
    for first, rows in _blocks(path, header):
        yield rows[kept[first : first + len(rows)]].tobytes()


def recoloured(path: Path, colours: np.ndarray) -> Iterator[bytes]:
    """A splat file whose splats have one colour each, the same from everywhere.

    Higher harmonics become zero. The lobes of DBS become dark and not zero: a lobe of zeros shines.

    Args:
        path: the file.
        colours: [P, 3] f32, the constant terms of the spherical harmonics (``f_dc_*``, or ``sh0_*`` of DBS).

    Yields:
        The bytes of the copy, in blocks.

    Raises:
        InvalidSplats: the file is malformed, has another number of splats, or holds no colours.
    """
    header = _header(path, len(colours))
    constants, rest = _colour_columns(path, header)
    yield _head(header, header.count)
    for first, rows in _blocks(path, header):
        for name, value in rest.items():
            rows[name] = value
        for name, channel in constants.items():
            rows[name] = colours[first : first + len(rows), channel]
        yield rows.tobytes()


def _colour_columns(path: Path, header: PlyHeader) -> tuple[dict[str, int], dict[str, float]]:
    """The columns of the constant terms with their channels, and what all others that make colours become."""
    names = [column.name for column in header.properties]
    slots = model_slots(names, recognise_kernel(names), str(path))
    harmonics: Mapping[str, tuple[int, ...]] = {n: slot.index for n, slot in slots.items() if slot.field == "sh"}
    if not harmonics:
        raise InvalidSplats(str(path), expected="colours (f_dc_0, ...) to show scores in", got="a file without any")
    lobes = {name: slot.index for name, slot in slots.items() if slot.field == "sb_params"}
    rest = {name: 0.0 for name, (row, _) in harmonics.items() if row > 0}
    rest |= {name: DARK_LOBE for name, (_, channel) in lobes.items() if channel < LOBE_COLOURS}
    return {name: channel for name, (row, channel) in harmonics.items() if row == 0}, rest


def _header(path: Path, count: int) -> PlyHeader:
    header = read_header(path)
    if header.count != count:
        raise InvalidSplats(str(path), expected=f"{count} splats, as many as were lifted", got=str(header.count))
    return header


def _head(header: PlyHeader, count: int) -> bytes:
    return "".join(f"{line}\n" for line in header.lines_for(count)).encode("ascii")


def _blocks(path: Path, header: PlyHeader) -> Iterator[tuple[int, np.ndarray]]:
    """The number of the first row, and rows with a field a column. Read, not mapped: what was copied is let go."""
    dtype = np.dtype([(column.name, "<" + column.code) for column in header.properties])
    with path.open("rb", buffering=0) as source:
        source.seek(header.data_offset)
        for first in range(0, header.count, BLOCK_ROWS):
            yield first, np.fromfile(source, dtype, min(BLOCK_ROWS, header.count - first))
