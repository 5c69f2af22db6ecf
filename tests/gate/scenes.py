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
    places = {f"v{k}": float(x) for k, x in enumerate(np.linspace(-0.1, 0.1, views))}
    return {
        "splats": tiny_scene.ply(rows),
        "cameras": json.dumps(tiny_scene.cameras_document(places, width)).encode(),
        "features": tiny_scene.pack(tiny_scene.labels(places, width), tiny_scene.codebook(channels)),
        "table": tiny_scene.text_table(channels),
    }
