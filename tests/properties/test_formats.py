"""Formats under arbitrary bytes and arbitrary damage."""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from liftcore.errors import InvalidCameras, InvalidFeatures, InvalidInput, InvalidSplats
from liftcore.io.cameras import read_cameras
from liftcore.io.npy import open_npy
from liftcore.io.ply import usual_layout
from liftcore.io.splats import read_splats
from liftcore.scene.cameras import Cameras
from liftcore.scene.splats import Kernel
from liftcore.values.pack import read_features, write_pack
from liftcore.values.views import FeatureGrid, Regions, ViewFeatures

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


def read_or_refused(reader: Callable[[Path], Any], path: Path, error: type[InvalidInput]) -> Any:
    """Read a file; return None if it is refused, in one line."""
    try:
        return reader(path)
    except error as refusal:
        assert "\n" not in str(refusal)
        return None


@given(st.one_of(st.binary(max_size=300), damaged, st.binary(max_size=100).map(lambda tail: b"ply\n" + tail)))
@settings(max_examples=300, deadline=None)
def test_any_bytes_are_splats_or_an_error_of_ours(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fuzz.ply"
        path.write_bytes(content)
        splats = read_or_refused(read_splats, path, InvalidSplats)
        assert splats is None or splats.count > 0


@given(st.floats(), st.floats(), st.integers(0, 15))
@settings(max_examples=100, deadline=None)
def test_any_number_in_a_pose_is_a_camera_or_an_error_of_ours(focal, value, place) -> None:
    pose = np.eye(4)
    pose.flat[place] = value
    frame = {"file_path": "a.png", "transform_matrix": pose.tolist()}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "transforms.json"
        path.write_text(json.dumps({"fl_x": focal, "w": 64, "h": 48, "frames": [frame]}))
        cameras = read_or_refused(read_cameras, path, InvalidCameras)
        assert cameras is None or np.isfinite(cameras["a"].centre).all()


def as_bytes(write: Callable[[Path], object]) -> bytes:
    """Return the bytes that ``write`` writes into a file."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "a.npy")
        return (Path(folder) / "a.npy").read_bytes()


def whole_pack(path: Path) -> list[ViewFeatures]:
    """Read every view of a pack."""
    packs = read_features(path)
    return [packs[view] for view in packs.views]


def whole_model(path: Path) -> Cameras:
    """Read the cameras of the folder of a file."""
    return read_cameras(path.parent)


POSE = np.eye(4).tolist()
FRAMES = [{"file_path": name, "transform_matrix": POSE} for name in ("a.png", "b.png")]
RECORD = {"id": 0, "img_name": "a", "width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "position": [0.0, 0.0, 0.0]}
PACK = {
    "a": Regions(torch.tensor([[[0, -1], [1, 0]]], dtype=torch.int32), torch.eye(2, 3)),
    "b": FeatureGrid(torch.ones(1, 2, 3)),
}
CAMERAS_BIN = struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 50.0, 50.0, 32.0, 24.0)
IMAGES_BIN = struct.pack("<QI7dI", 1, 1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1) + b"a.png\0" + bytes(8)
CAMERAS_TXT = b"# list\n1 PINHOLE 64 48 50 50 32 24\n"
IMAGES_TXT = b"1 1 0 0 0 0 0 1 1 a.png\n\n2 1 0 0 0 0 0 1 1 b.png\n1 2 -1\n"
# A name, a good file of it, the files beside it, and what reads it or says why not.
FILES = [
    ("transforms.json", json.dumps({"fl_x": 50.0, "w": 64, "h": 48, "frames": FRAMES}).encode(), {}, read_cameras),
    ("cameras.json", json.dumps([{**RECORD, "rotation": np.eye(3).tolist()}]).encode(), {}, read_cameras),
    ("cameras.bin", CAMERAS_BIN, {"images.bin": IMAGES_BIN}, whole_model),
    ("images.bin", IMAGES_BIN, {"cameras.bin": CAMERAS_BIN}, whole_model),
    ("cameras.txt", CAMERAS_TXT, {"images.txt": IMAGES_TXT}, whole_model),
    ("images.txt", IMAGES_TXT, {"cameras.txt": CAMERAS_TXT}, whole_model),
    ("pack.safetensors", as_bytes(lambda path: write_pack(path, PACK, {"encoder": "e"})), {}, whole_pack),
    ("a.npy", as_bytes(lambda path: np.save(path, np.ones((3, 4), np.float32))), {}, open_npy),
]
EDITS = st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=6)


@given(st.sampled_from(FILES), EDITS, st.integers(0, 2_000), st.one_of(st.none(), st.binary(max_size=60)))
@settings(max_examples=1_000, deadline=None)
def test_any_damage_to_a_file_is_read_or_an_error_of_ours(file, changes, keep, noise) -> None:
    name, content, siblings, reader = file
    damaged = bytearray(content)
    for place, value in changes:
        damaged[place % len(damaged)] = value
    with tempfile.TemporaryDirectory() as folder:
        for other, data in {
            **siblings,
            name: bytes(damaged[:keep]) if noise is None else content[:8] + noise,
        }.items():
            (Path(folder) / other).write_bytes(data)
        error = InvalidCameras if reader in (read_cameras, whole_model) else InvalidFeatures
        output = read_or_refused(reader, Path(folder) / name, error)
        assert output is None or len(output) > 0
