"""Cameras as JSON documents, and what makes them the same."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from liftcore.scene.cameras import Cameras

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def transforms_of(cameras: Cameras) -> dict[str, Any]:
    frames = []
    for camera in cameras.values():
        pose = np.linalg.inv(camera.viewmat) @ FLIP
        size = {"w": camera.width, "h": camera.height}
        lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
        frames.append({"file_path": f"images/{camera.name}.png", "transform_matrix": pose.tolist(), **size, **lens})
    return {"frames": frames}


def with_json(tmp_path: Path, document: Any) -> Path:
    path = tmp_path / "document.json"
    path.write_text(json.dumps(document))
    return path


def assert_same(one: Cameras, other: Cameras) -> None:
    assert list(one) == list(other)
    for a, b in zip(one.values(), other.values(), strict=True):
        assert (a.width, a.height) == (b.width, b.height)
        assert np.allclose([a.fx, a.fy, a.cx, a.cy], [b.fx, b.fy, b.cx, b.cy], atol=1e-9)
        assert np.allclose(a.viewmat, b.viewmat, atol=1e-12)
