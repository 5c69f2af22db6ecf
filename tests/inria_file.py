"""Writes cameras.json as Inria's trainer does."""

from __future__ import annotations

import json
from pathlib import Path

from liftcore.scene.cameras import Cameras


def write_inria_cameras(cameras: Cameras, path: Path) -> None:
    """Write cameras without distortion, whose principal points are at the centre."""
    records = [
        {
            "id": number, "img_name": camera.name, "width": camera.width, "height": camera.height,
            "position": camera.centre.tolist(), "rotation": camera.viewmat[:3, :3].T.tolist(),
            "fx": camera.fx, "fy": camera.fy,
        }
        for number, camera in enumerate(cameras.values())
    ]  # fmt: skip
    path.write_text(json.dumps(records), encoding="utf-8")
