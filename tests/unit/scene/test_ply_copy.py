"""Copies of splat files: what is kept is kept to the byte, and what is coloured looks the same from everywhere."""

from __future__ import annotations

import io
import tracemalloc
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from ply_files import DIALECTS, INRIA, ply_bytes, with_ply
from plyfile import PlyData

from liftcore.errors import InvalidSplats
from liftcore.io.ply import BLOCK_ROWS
from liftcore.io.splats import read_splats, recoloured, some_rows
from liftcore.query.colours import constant_terms
from liftcore.query.splat_colours import seen_colours
from tests.scenes import look_at

if TYPE_CHECKING:
    from pathlib import Path

DOUBLES = [*DIALECTS["inria degree 3"], "mask", "time"]
TYPES = {"f_dc_1": "double", "mask": "uchar", "time": "double"}


def rows_of(content: bytes) -> np.ndarray:
    return PlyData.read(io.BytesIO(content))["vertex"].data


@pytest.mark.parametrize("dialect", DIALECTS)
def test_some_rows_of_every_dialect_are_kept_to_the_byte(dialect: str, tmp_path: Path) -> None:
    path = with_ply(tmp_path, ply_bytes(DIALECTS[dialect], count=7, head="comment of somebody\n"))
    kept = np.array([True, False, True, True, False, False, True])
    copy = b"".join(some_rows(path, kept))
    whole = rows_of(path.read_bytes())
    assert rows_of(copy).dtype == whole.dtype
    assert rows_of(copy).tobytes() == whole[kept].tobytes()
    assert copy.startswith(b"ply\nformat binary_little_endian 1.0\ncomment of somebody\nelement vertex 4\n")
    assert b"".join(some_rows(path, np.ones(7, bool))) == path.read_bytes()


def test_rows_are_kept_over_blocks_and_in_their_own_types(tmp_path: Path) -> None:
    path = with_ply(tmp_path, ply_bytes(DOUBLES, count=2 * BLOCK_ROWS + 5, types=TYPES))
    kept = np.random.default_rng(1).random(2 * BLOCK_ROWS + 5) < 0.3
    copy = rows_of(b"".join(some_rows(path, kept)))
    assert copy.tobytes() == rows_of(path.read_bytes())[kept].tobytes()


def test_elements_behind_the_vertices_are_no_rows_of_a_copy(tmp_path: Path) -> None:
    plain = ply_bytes(INRIA)
    others = b"element version 200\nproperty uchar number\n"  # as many bytes as two splats and more
    path = with_ply(tmp_path, plain.replace(b"end_header", others + b"end_header") + bytes(200))
    assert b"".join(some_rows(path, np.ones(5, bool))) == plain
    copy = b"".join(recoloured(path, np.zeros((5, 3), np.float32)))
    assert len(copy) == len(plain) and len(rows_of(copy)) == 5


@pytest.mark.parametrize("dialect", [name for name in DIALECTS if name != "no colour"])
def test_colours_of_every_dialect_are_the_same_from_everywhere(dialect: str, tmp_path: Path) -> None:
    names = DIALECTS[dialect]
    path = with_ply(tmp_path, ply_bytes(names))
    wanted = np.random.default_rng(2).integers(0, 256, (5, 3)).astype(np.uint8)
    (tmp_path / "coloured.ply").write_bytes(b"".join(recoloured(path, constant_terms(wanted))))
    splats = read_splats(tmp_path / "coloured.ply")
    for centre in ([3.0, 1.0, -4.0], [-0.2, 0.1, 9.0], [0.0, -5.0, 0.3]):
        shown = seen_colours(splats, look_at("v", np.array(centre), 8, 8, 8.0))
        torch.testing.assert_close(shown, torch.from_numpy(wanted / 255).float(), atol=1e-6, rtol=0)
    before, after = rows_of(path.read_bytes()), rows_of((tmp_path / "coloured.ply").read_bytes())
    coloured = ("f_dc", "f_rest", "sh0", "sb_params")
    for name in names:
        assert name.startswith(coloured) or before[name].tobytes() == after[name].tobytes(), name
    directions = [name for name in names if name in {f"sb_params_{i}" for i in range(6, 12)}]
    assert all(before[name].tobytes() == after[name].tobytes() for name in directions)


def test_a_file_without_colours_or_with_another_count_is_refused(tmp_path: Path) -> None:
    path = with_ply(tmp_path, ply_bytes(DIALECTS["no colour"]))
    with pytest.raises(InvalidSplats, match="expected colours"):
        list(recoloured(path, np.zeros((5, 3), np.float32)))
    for copy in (some_rows(path, np.ones(4, bool)), recoloured(path, np.zeros((6, 3), np.float32))):
        with pytest.raises(InvalidSplats, match="as many as were lifted, got 5"):
            list(copy)


def test_a_copy_takes_the_memory_of_a_few_blocks(tmp_path: Path) -> None:
    names = DIALECTS["inria degree 3"]
    count = 10 * BLOCK_ROWS
    path = with_ply(tmp_path, ply_bytes(names, count=count))
    block = BLOCK_ROWS * 4 * len(names)
    for make in (lambda: some_rows(path, np.ones(count, bool)), lambda: recoloured(path, np.zeros((count, 3)))):
        tracemalloc.start()
        total = sum(map(len, make()))
        peak = tracemalloc.get_traced_memory()[1] - (24 * count)  # the colours, or less for the rows to keep
        tracemalloc.stop()
        assert total == path.stat().st_size
        assert peak < 4 * block
