"""COLMAP models and JSON documents of cameras for tests, and a comparison of cameras."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

import liftcore as lc

# Cameras by id (model id, model name, parameters); images (camera, quaternion, translation, name).
CAMERAS = {1: (1, "PINHOLE", (500.0, 510.0, 320.5, 239.5)), 7: (0, "SIMPLE_PINHOLE", (400.0, 320.0, 240.0))}
IMAGES = [
    (1, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0), "frame 1.jpg"),
    (7, (0.5, 0.5, 0.5, 0.5), (1.0, 2.0, 3.0), "left/frame_2.png"),
    (1, (0.0, 0.0, 2.0, 0.0), (0.5, -0.5, 1.0), "frame.0003.JPG"),
]


def binary_files(cameras=None, images=None) -> dict[str, bytes]:
    cameras = CAMERAS if cameras is None else cameras
    images = IMAGES if images is None else images
    first = struct.pack("<Q", len(cameras))
    for number, (model, _, parameters) in cameras.items():
        first += struct.pack("<IiQQ", number, model, 640, 480) + struct.pack(f"<{len(parameters)}d", *parameters)
    second = struct.pack("<Q", len(images))
    for i, (camera, quaternion, translation, name) in enumerate(images):
        second += struct.pack("<I7dI", i, *quaternion, *translation, camera) + name.encode() + b"\0"
        second += struct.pack("<Q", i) + struct.pack("<ddq", 1.0, 2.0, -1) * i
    return {"cameras.bin": first, "images.bin": second}


def text_files(cameras=None, images=None) -> dict[str, bytes]:
    cameras = CAMERAS if cameras is None else cameras
    images = IMAGES if images is None else images
    first = "# Camera list\n"
    for number, (_, model, parameters) in cameras.items():
        first += f"{number} {model} 640 480 {' '.join(map(str, parameters))}\n"
    second = "# Image list\n"
    for i, (camera, quaternion, translation, name) in enumerate(images):
        pose = " ".join(map(str, (*quaternion, *translation)))
        second += f"{i} {pose} {camera} {name}\n{'1.0 2.0 -1 ' * i}\n"
    return {"cameras.txt": first.encode(), "images.txt": second.encode()}


def write_files(folder: Path, files: dict[str, bytes]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


def with_json(tmp_path: Path, document: Any) -> Path:
    path = tmp_path / "document.json"
    path.write_text(json.dumps(document))
    return path


def assert_same(actual: lc.Cameras, expected: lc.Cameras) -> None:
    assert list(actual) == list(expected)
    for a, b in zip(actual.values(), expected.values(), strict=True):
        assert (a.width, a.height) == (b.width, b.height)
        assert np.allclose([a.fx, a.fy, a.cx, a.cy], [b.fx, b.fy, b.cx, b.cy], atol=1e-9)
        assert np.allclose(a.viewmat, b.viewmat, atol=1e-12)
