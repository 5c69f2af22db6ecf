"""Formats under arbitrary bytes and arbitrary scenes."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liftcore.errors import InvalidSplats
from liftcore.scene.ply import read_splats, write_splats
from liftcore.scene.ply_dialect import usual_layout
from liftcore.scene.ply_header import parse_header
from liftcore.scene.splats import Kernel

LINES = [
    "ply",
    "format binary_little_endian 1.0",
    "format ascii 1.0",
    "element vertex 1",
    "element vertex 0",
    "element vertex -1",
    "element vertex 99999999999999999",
    "element face 2",
    "comment hello",
    "obj_info x",
    "property list uchar int a",
    "property",
    "",
    "end_header",
    *(f"property float {name}" for name in usual_layout(Kernel.GAUSSIAN_3D, 1, 0)),
    "property double x",
    "property uchar opacity",
    "property float beta",
    "property float f_rest_3",
]
plausible = st.lists(st.sampled_from(LINES), max_size=40).map(
    lambda lines: "\n".join(["ply", *lines, "end_header\n"])
)
damaged = st.tuples(plausible.map(str.encode), st.binary(max_size=80)).map(b"".join)


@given(st.one_of(st.binary(max_size=300), damaged, st.binary(max_size=100).map(lambda tail: b"ply\n" + tail)))
@settings(max_examples=300, deadline=None)
def test_any_bytes_are_a_header_or_an_error_of_ours(content: bytes) -> None:
    try:
        header = parse_header(content, "fuzz")
    except InvalidSplats as error:
        assert "\n" not in str(error)
    else:
        assert header.count >= 0
        assert header.stride > 0


@given(damaged)
@settings(max_examples=150, deadline=None)
def test_any_file_is_splats_or_an_error_of_ours(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fuzz.ply"
        path.write_bytes(content)
        try:
            assert read_splats(path).count > 0
        except InvalidSplats as error:
            assert "\n" not in str(error)


@given(
    st.sampled_from(list(Kernel)),
    st.sampled_from([0, 1, 4, 9, 16, 25]),
    st.integers(0, 3),
    st.integers(1, 6),
    st.permutations(["mask", "label", "semantic_0"]),
    st.randoms(use_true_random=False),
)
@settings(max_examples=100, deadline=None)
def test_every_layout_is_written_back_to_the_byte(kernel, sh_rows, lobes, count, extras, random) -> None:
    lobes = lobes if kernel is Kernel.BETA else 0
    names = [*usual_layout(kernel, sh_rows, lobes), *extras]
    random.shuffle(names)
    codes = {name: ("u1" if name == "mask" else "i4" if name == "label" else "f4") for name in names}
    words = {"u1": "uchar", "i4": "int", "f4": "float"}
    rows = np.zeros(count, np.dtype([(name, "<" + codes[name]) for name in names]))
    for i, name in enumerate(names):
        rows[name] = np.arange(count) + i
    lines = [f"property {words[codes[name]]} {name}" for name in names]
    header = "\n".join(
        ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *lines, "end_header\n"]
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "splats.ply"
        path.write_bytes(header.encode() + rows.tobytes())
        splats = read_splats(path)
        assert splats.kernel is kernel
        write_splats(splats, path.with_name("again.ply"))
        assert path.with_name("again.ply").read_bytes() == path.read_bytes()


@given(st.integers(0, 400))
@settings(max_examples=40, deadline=None)
def test_file_cut_anywhere_is_refused(cut: int) -> None:
    names = usual_layout(Kernel.GAUSSIAN_3D, 1, 0)
    lines = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 3\n{lines}end_header\n".encode()
    content = header + bytes(3 * 4 * len(names))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cut.ply"
        path.write_bytes(content[: min(cut, len(content) - 1)])
        with pytest.raises(InvalidSplats):
            read_splats(path)
