"""PLYs of every dialect are read, written back and copied byte for byte, or refused in one line."""

from __future__ import annotations

import io
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData

from liftcore.errors import InvalidSplats
from liftcore.io.ply import BLOCK_ROWS
from liftcore.io.splats import read_splats, recoloured, some_rows, write_splats
from liftcore.query.splat_colours import view_colours
from liftcore.scene.splats import Kernel
from tests.scenes import look_at

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


def ply_bytes(
    names: list[str], count: int = 5, types: dict[str, str] | None = None, head: str = "", **columns: Any
) -> bytes:
    """Return a PLY of seeded numbers but for the columns; ``types`` other than float, ``head`` more header lines."""
    types = types or {}
    codes = {"float": "f4", "double": "f8", "uchar": "u1", "ushort": "u2", "int": "i4"}
    rows = np.zeros(count, np.dtype([(name, "<" + codes[types.get(name, "float")]) for name in names]))
    generator = np.random.default_rng(0)
    for name in names:
        numbers = generator.normal(size=count) if types.get(name, "float")[-1] in "te" else np.arange(count)
        rows[name] = columns.get(name, numbers)
    lines = [f"property {types.get(name, 'float')} {name}" for name in names]
    header = "\n".join(["ply", "format binary_little_endian 1.0", f"{head}element vertex {count}", *lines])
    return header.encode() + b"\nend_header\n" + rows.tobytes()


def rows_of(content: bytes) -> np.ndarray:
    return PlyData.read(io.BytesIO(content))["vertex"].data


def with_ply(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "splats.ply"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(("tail", "warning_count"), [(b"\n", 0), (bytes(20), 0), (b"abc", 1), (b"1" * 33, 1)])
def test_bytes_behind_the_rows_are_passed_over_and_said(tail: bytes, warning_count: int, tmp_path: Path) -> None:
    content = ply_bytes(INRIA)
    path = with_ply(tmp_path, content + tail)
    splats = read_splats(path)
    assert len(splats.warnings) == warning_count and all(f"{len(tail)} bytes" in text for text in splats.warnings)
    assert torch.equal(splats.means, read_splats(with_ply(tmp_path, content)).means)
    path.write_bytes(content + tail)
    assert b"".join(some_rows(path, np.ones(5, bool))) == content


def test_lobes_are_stored_a_channel_after_the_other(tmp_path: Path) -> None:
    content = ply_bytes(DIALECTS["dbs"])
    lobes, columns = read_splats(with_ply(tmp_path, content)).sb_params, rows_of(content)
    assert lobes is not None and lobes.shape == (5, 2, 6)
    for i in range(12):
        assert np.array_equal(lobes[:, i % 2, i // 2].numpy(), columns[f"sb_params_{i}"])


def test_forced_kernel_overrules_the_properties(tmp_path: Path) -> None:
    path = with_ply(tmp_path, ply_bytes(DIALECTS["dbs"]))
    splats = read_splats(path, Kernel.GAUSSIAN_3D)
    assert splats.kernel is Kernel.GAUSSIAN_3D
    assert splats.beta is None
    assert "beta" in splats.extras
    flat = read_splats(with_ply(tmp_path, ply_bytes(INRIA)), Kernel.GAUSSIAN_2D)
    assert flat.log_scales.shape == (5, 2)
    with pytest.raises(InvalidSplats, match=r"'scale_2' of a 3dgs splat.*nearest dialect is 2DGS"):
        read_splats(with_ply(tmp_path, ply_bytes(DIALECTS["2dgs"])), Kernel.GAUSSIAN_3D)


def test_elements_behind_the_vertices_are_passed_over(tmp_path: Path) -> None:
    vertices_alone = ply_bytes(INRIA, head="comment kept\n")
    other_elements = (
        b"element camera 2\nproperty float focal\nproperty uchar id\nelement version 3\nproperty uchar number\n"
    )
    content = vertices_alone.replace(b"end_header", other_elements + b"end_header") + bytes(2 * 5 + 3)
    write_splats(tmp_path / "again.ply", read_splats(with_ply(tmp_path, content)))
    assert (tmp_path / "again.ply").read_bytes() == vertices_alone
    with pytest.raises(InvalidSplats, match=r"and 13 bytes of other elements = 353 bytes.*got 352 bytes.*truncated"):
        read_splats(with_ply(tmp_path, content[:-1]))
    assert "1 bytes at the file's end" in read_splats(with_ply(tmp_path, content + b"x")).warnings[0]
    faces = b"element face 1\nproperty list uchar int vertex_indices\nend_header"  # of unknown length
    content = ply_bytes(INRIA).replace(b"end_header", faces) + b"\x03" + bytes(12)
    assert torch.equal(
        read_splats(with_ply(tmp_path, content)).means, read_splats(with_ply(tmp_path, ply_bytes(INRIA))).means
    )


@pytest.mark.parametrize("colour", [True, False])
def test_filter_of_mip_splatting_is_applied(colour: bool, tmp_path: Path) -> None:
    content = ply_bytes([*INRIA, "filter_3D"], filter_3D=[0.0, 0.5, 1e-3, 20.0, 1.0])
    splats = read_splats(with_ply(tmp_path, content), colour=colour)
    rows = {name: rows_of(content)[name].astype(np.float64) for name in (*SCALES, "opacity", "filter_3D")}
    squares = np.exp(2 * np.stack([rows[name] for name in SCALES], axis=1))
    wider = squares + rows["filter_3D"][:, None] ** 2
    opacity = 1 / (1 + np.exp(-rows["opacity"])) * np.sqrt(squares.prod(1) / wider.prod(1))
    np.testing.assert_allclose(torch.exp(splats.log_scales.double()), np.sqrt(wider), rtol=1e-6)
    np.testing.assert_allclose(torch.sigmoid(splats.opacity_logits.double()), opacity, rtol=1e-6)
    if colour:  # what is written has the filter in it, and is not filtered again
        write_splats(tmp_path / "plain.ply", splats)
        copy = read_splats(tmp_path / "plain.ply")
        assert "filter_3D" not in copy.layout
        assert torch.equal(copy.opacity_logits, splats.opacity_logits)


def test_rows_are_kept_to_the_byte_over_blocks_and_in_their_own_types(tmp_path: Path) -> None:
    names, count = [*INRIA, "mask", "time"], 2 * BLOCK_ROWS + 5
    types = {"f_dc_1": "double", "mask": "uchar", "time": "double"}
    path = with_ply(tmp_path, ply_bytes(names, count, types, head="comment of somebody\n"))
    mask = np.random.default_rng(1).random(count) < 0.3
    copy, rows = b"".join(some_rows(path, mask)), rows_of(path.read_bytes())
    assert rows_of(copy).dtype == rows.dtype and rows_of(copy).tobytes() == rows[mask].tobytes()
    first = f"ply\nformat binary_little_endian 1.0\ncomment of somebody\nelement vertex {mask.sum()}\n"
    assert copy.startswith(first.encode())
    assert b"".join(some_rows(path, np.ones(count, bool))) == path.read_bytes()


@pytest.mark.parametrize("dialect", [name for name in DIALECTS if name != "no colour"])
def test_colours_of_every_dialect_are_the_same_from_everywhere(dialect: str, tmp_path: Path) -> None:
    names = DIALECTS[dialect]
    path = with_ply(tmp_path, ply_bytes(names))
    expected = np.random.default_rng(2).integers(0, 256, (5, 3)).astype(np.uint8)
    (tmp_path / "coloured.ply").write_bytes(b"".join(recoloured(path, expected)))
    splats = read_splats(tmp_path / "coloured.ply")
    for centre in ([3.0, 1.0, -4.0], [-0.2, 0.1, 9.0], [0.0, -5.0, 0.3]):
        actual = view_colours(splats, look_at("v", np.array(centre), 8, 8, 8.0))
        torch.testing.assert_close(actual, torch.from_numpy(expected / 255).float(), atol=1e-6, rtol=0)
    before, after = rows_of(path.read_bytes()), rows_of((tmp_path / "coloured.ply").read_bytes())
    coloured = ("f_dc", "f_rest", "sh0", "sb_params")
    for name in names:
        assert name.startswith(coloured) or before[name].tobytes() == after[name].tobytes(), name
    directions = [name for name in names if name in {f"sb_params_{i}" for i in range(6, 12)}]
    assert all(before[name].tobytes() == after[name].tobytes() for name in directions)


@pytest.mark.parametrize(
    ("kind", "full", "channels"),
    [
        ("uchar", 255, ("red", "green", "blue")),  # nerfstudio's --ply-color-mode rgb
        ("float", 1, ("diffuse_red", "diffuse_green", "diffuse_blue")),
    ],
)
def test_red_green_and_blue_are_the_colour_where_no_harmonics_are(kind, full, channels, tmp_path: Path) -> None:
    levels = np.random.default_rng(3).integers(26, 230, (5, 3)) / 255
    stored = levels * full if kind == "float" else np.rint(levels * full)
    columns = dict(zip(channels, stored.T, strict=True))
    types = dict.fromkeys(channels, kind)
    content = ply_bytes([*DIALECTS["no colour"], *channels], types=types, **columns)
    path = with_ply(tmp_path, content)
    splats = read_splats(path)
    colours = view_colours(splats, look_at("v", np.array([3.0, 1.0, -4.0]), 8, 8, 8.0))
    torch.testing.assert_close(colours, torch.from_numpy(levels).float(), atol=2e-5, rtol=0)
    write_splats(tmp_path / "again.ply", splats)
    assert (tmp_path / "again.ply").read_bytes() == content
    expected = np.random.default_rng(2).integers(0, 256, (5, 3)).astype(np.uint8)
    expected[:3] |= 2  # most of them above 1 of 255
    copy = rows_of(b"".join(recoloured(path, expected)))
    actual = np.stack([copy[name] for name in channels], axis=1) / full
    np.testing.assert_allclose(actual, expected / 255, atol=1e-5)
    assert read_splats(path, colour=False).sh is None


def test_harmonics_are_the_colour_where_red_green_and_blue_are_too(tmp_path: Path) -> None:
    channels = ["red", "green", "blue"]
    content = ply_bytes([*DIALECTS["gsplat"], *channels], types=dict.fromkeys(channels, "uchar"), f_dc_0=np.arange(5))
    sh = read_splats(with_ply(tmp_path, content)).sh
    assert sh is not None and sh[:, 0, 0].tolist() == [0, 1, 2, 3, 4]


def peak_of(work: Callable[[], object]) -> int:
    """Return the peak of the bytes that Python and NumPy allocate during a call."""
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_splats_take_the_memory_of_their_file_and_a_copy_that_of_a_few_blocks(tmp_path: Path) -> None:
    names, count = DIALECTS["inria degree 3"], 10 * BLOCK_ROWS
    path = with_ply(tmp_path, ply_bytes(names, count=count))
    assert peak_of(lambda: read_splats(path)) < 1.15 * path.stat().st_size
    mask, black = np.ones(count, bool), np.zeros((count, 3), np.uint8)
    for copy in (some_rows(path, mask), recoloured(path, black)):
        peak = peak_of(lambda copy=copy: sum(map(len, copy)))
        assert peak - 24 * count < 4 * (BLOCK_ROWS * 4 * len(names))  # beside the colours, or the rows to keep
