"""Scenes of any size, as in `tests.tiny_scene`: three clusters with a word each."""

from __future__ import annotations

import json

import numpy as np

from tests import tiny_scene


def small_scene() -> dict[str, bytes]:
    """60 splats, 3 views of 32 x 24 pixels: kind -> bytes."""
    return scene(splats=60, views=3, width=32, channels=8)


def long_scene() -> dict[str, bytes]:
    """A scene whose lift takes seconds."""
    return scene(splats=20_000, views=16, width=240, channels=32)


def scene(*, splats: int, views: int, width: int, channels: int) -> dict[str, bytes]:
    """A scene with views of 4:3: kind -> bytes."""
    rows = np.repeat(tiny_scene.splat_rows(), -(-splats // 60), axis=0)[:splats]
    rows[:, :3] += np.random.default_rng(1).normal(0, 0.02, (splats, 3))
    height, focal = width * 3 // 4, width * tiny_scene.FOCAL / tiny_scene.WIDTH
    frames, labels = [], {}
    for k in range(views):
        pose = np.eye(4)
        pose[0, 3] = x = 0.2 * k / max(views - 1, 1) - 0.1
        frames.append({"file_path": f"images/v{k}.png", "transform_matrix": pose.tolist()})
        columns = (np.arange(width) + 0.5 - width / 2) * tiny_scene.DISTANCE / focal + x
        labels[f"v{k}"] = np.broadcast_to(np.digitize(columns, [-0.6, 0.6]).astype(np.int32), (1, height, width))
    cameras = {"w": width, "h": height, "fl_x": focal, "fl_y": focal, "frames": frames}
    return {
        "splats": tiny_scene.ply(rows),
        "cameras": json.dumps(cameras).encode(),
        "features": tiny_scene.pack(labels, tiny_scene.codebook(channels)),
        "table": tiny_scene.text_table(channels),
    }
