"""Formats under arbitrary bytes and arbitrary scenes."""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from liftcore.errors import InvalidCameras, InvalidFeatures, InvalidInput, InvalidSplats
from liftcore.features.pack import read_features, write_pack
from liftcore.features.views import FeatureGrid, Regions
from liftcore.io.cameras import read_cameras
from liftcore.io.npy import open_npy
from liftcore.io.ply import usual_layout, write_splats
from liftcore.io.splats import read_splats
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


def read_or_refused(read: Callable[[Path], Any], path: Path, error: type[InvalidInput]) -> Any:
    """What the file is read as; None where it is refused, in one line."""
    try:
        return read(path)
    except error as told:
        assert "\n" not in str(told)
        return None


@given(st.one_of(st.binary(max_size=300), damaged, st.binary(max_size=100).map(lambda tail: b"ply\n" + tail)))
@settings(max_examples=300, deadline=None)
def test_any_bytes_are_splats_or_an_error_of_ours(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fuzz.ply"
        path.write_bytes(content)
        found = read_or_refused(read_splats, path, InvalidSplats)
        assert found is None or found.count > 0


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
    header = "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {count}", *lines, "end_header\n"])
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


def camera_documents() -> list[bytes]:
    """One valid file of each camera format, each a few hundred bytes."""
    pose = np.eye(4).tolist()
    frame = {"file_path": "a.png", "transform_matrix": pose}
    transforms = {"fl_x": 50.0, "w": 64, "h": 48, "frames": [frame, {**frame, "file_path": "b.png"}]}
    record = {"id": 0, "img_name": "a", "width": 64, "height": 48, "fx": 50.0, "fy": 50.0}
    inria = [{**record, "position": [0.0, 0.0, 0.0], "rotation": np.eye(3).tolist()}]
    return [json.dumps(document).encode() for document in (transforms, inria)]


COLMAP = {
    "cameras.bin": struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 50.0, 50.0, 32.0, 24.0),
    "images.bin": struct.pack("<QI7dI", 1, 1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1) + b"a.png\0" + bytes(8),
    "cameras.txt": b"# list\n1 PINHOLE 64 48 50 50 32 24\n",
    "images.txt": b"1 1 0 0 0 0 0 1 1 a.png\n\n2 1 0 0 0 0 0 1 1 b.png\n1 2 -1\n",
}
edits = st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=6)


def edited(content: bytes, changes: list[tuple[int, int]], keep: int) -> bytes:
    """The content with some bytes changed, cut after ``keep``."""
    changed = bytearray(content)
    for place, value in changes:
        changed[place % len(changed)] = value
    return bytes(changed[:keep])


@given(st.sampled_from(camera_documents()), edits, st.integers(0, 1000))
@settings(max_examples=200, deadline=None)
def test_any_damage_to_camera_json_is_cameras_or_an_error_of_ours(content, changes, keep) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cameras.json"
        path.write_bytes(edited(content, changes, keep))
        found = read_or_refused(read_cameras, path, InvalidCameras)
        assert found is None or len(found) > 0


@given(st.floats(), st.floats(), st.integers(0, 15))
@settings(max_examples=100, deadline=None)
def test_any_number_in_a_pose_is_a_camera_or_an_error_of_ours(focal, value, place) -> None:
    pose = np.eye(4)
    pose.flat[place] = value
    frame = {"file_path": "a.png", "transform_matrix": pose.tolist()}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "transforms.json"
        path.write_text(json.dumps({"fl_x": focal, "w": 64, "h": 48, "frames": [frame]}))
        found = read_or_refused(read_cameras, path, InvalidCameras)
        assert found is None or np.isfinite(found["a"].centre).all()


@given(st.sampled_from(["bin", "txt"]), st.booleans(), edits, st.integers(0, 1000))
@settings(max_examples=300, deadline=None)
def test_any_damage_to_a_sparse_model_is_cameras_or_an_error_of_ours(kind, images, changes, keep) -> None:
    with tempfile.TemporaryDirectory() as folder:
        names = [f"cameras.{kind}", f"images.{kind}"]
        for name in names:
            damage = name == names[images]
            (Path(folder) / name).write_bytes(edited(COLMAP[name], changes, keep) if damage else COLMAP[name])
        found = read_or_refused(read_cameras, Path(folder), InvalidCameras)
        assert found is None or len(found) > 0


def whole_pack(path: Path) -> None:
    """Read every view of a pack."""
    packs = read_features(path)
    for view in packs.views:
        assert packs[view].codebook.shape[-1] == packs.channels


@given(edits, st.integers(0, 2000), st.binary(max_size=60))
@settings(max_examples=200, deadline=None)
def test_any_damage_to_a_pack_is_a_pack_or_an_error_of_ours(changes, keep, noise) -> None:
    labels = torch.tensor([[[0, -1], [1, 0]]], dtype=torch.int32)
    views = {"a": Regions(labels, torch.eye(2, 3)), "b": FeatureGrid(torch.ones(1, 2, 3))}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pack"
        write_pack(path, views, {"encoder": "e"})
        content = edited(path.read_bytes(), changes, keep)
        for damaged_content in (content, noise, content[:8] + noise):
            path.write_bytes(damaged_content)
            read_or_refused(whole_pack, path, InvalidFeatures)


@given(edits, st.integers(0, 300))
@settings(max_examples=150, deadline=None)
def test_any_damage_to_an_array_is_an_array_or_an_error_of_ours(changes, keep) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npy"
        np.save(path, np.ones((3, 4), np.float32))
        path.write_bytes(edited(path.read_bytes(), changes, keep))
        found = read_or_refused(open_npy, path, InvalidFeatures)
        assert found is None or found.size > 0
