"""A wall of opaque splats before two cameras with lenses, painted in quarters; the truth is known of every ray.

The wall lies four units ahead. Its quarters meet at (1.9, -1.3), far from the middle, where lenses bend most.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from liftcore.io.splats import write_splats
from liftcore.scene.distortion import Brown, Distortion, Fisheye, Lens
from liftcore.scene.splats import Splats
from liftcore.values.pack import write_pack
from liftcore.values.views import FeatureGrid, Regions, ViewFeatures

AWAY, MEETING = 4.0, (1.9, -1.3)  # of the wall, and of its quarters
WIDTH, HEIGHT, FX, FY, CX, CY = 160, 120, 110.0, 112.0, 83.0, 57.0
VIEWS = {"left": -0.3, "right": 0.2}  # name -> the camera's x
BARREL = {"k1": -0.25, "k2": 0.05, "p1": 0.002, "p2": -0.001}
PINCUSHION = {"k1": 0.2}
WIDE = {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": -0.01}
LENSES: dict[str, tuple[dict[str, Any], Distortion]] = {
    "barrel": (BARREL, Brown(k1=-0.25, k2=0.05, p1=0.002, p2=-0.001)),
    "pincushion": (PINCUSHION, Brown(k1=0.2)),
    "fisheye": (WIDE, Fisheye(k1=0.05, k2=-0.01)),
}


def quarter(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The quarter 0..3 of a place on the wall."""
    return (x > MEETING[0]).astype(np.int64) + 2 * (y > MEETING[1])


def is_clear(x: np.ndarray, y: np.ndarray, distance: float) -> np.ndarray:
    """Return True where a point on the wall is at least `distance` from the borders of its quarter."""
    return (np.abs(x - MEETING[0]) >= distance) & (np.abs(y - MEETING[1]) >= distance)


def wall() -> Splats:
    """[3,600] opaque balls, 0.1 apart."""
    y, x = np.meshgrid(np.arange(-30, 30) * 0.1 + 0.05, np.arange(-30, 30) * 0.1 + 0.05, indexing="ij")
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, AWAY)], axis=1)
    return Splats(
        means=torch.tensor(means, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1),
        log_scales=torch.full((len(means), 3), float(np.log(0.05))),
        opacity_logits=torch.full((len(means),), 4.0),
        sh=torch.zeros(len(means), 1, 3),
    )


def photo_of(view: str, lens: str, clear: float = 0.0) -> np.ndarray:
    """[H, W] i64, the quarter that each pixel of a photo shows; -1 beyond the wall, and nearer to a border."""
    photo_lens = Lens(WIDTH, HEIGHT, FX, FY, CX, CY, LENSES[lens][1])
    v, u = np.meshgrid(np.arange(HEIGHT) + 0.5, np.arange(WIDTH) + 0.5, indexing="ij")
    x, y = photo_lens.on_plane(u, v)
    x, y = AWAY * x + VIEWS[view], AWAY * y
    inside = (np.abs(x) < 2.9) & (np.abs(y) < 2.9)
    return np.where(inside & is_clear(x, y, clear), quarter(x, y), -1)


def write_distorted_scene(folder: Path, lens: str, *, grids: bool = False) -> tuple[Path, Path, Path]:
    """The files of the scene: splats, cameras, features, which are one-hot vectors of the quarters."""
    folder.mkdir(exist_ok=True)
    paths = folder / "splats.ply", folder / "transforms.json", folder / "features.safetensors"
    write_splats(paths[0], wall())
    frames = []
    for name, x in VIEWS.items():
        pose = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes of a camera that looks along z
        pose[0, 3] = x
        frames.append({"file_path": f"images/{name}.jpg", "transform_matrix": pose.tolist()})
    size = {"w": WIDTH, "h": HEIGHT, "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY}
    paths[1].write_text(json.dumps({**size, **LENSES[lens][0], "frames": frames}))
    one_hot = torch.eye(4)
    maps: dict[str, ViewFeatures] = {}
    for name in VIEWS:
        labels = torch.from_numpy(photo_of(name, lens))
        if grids:
            maps[name] = FeatureGrid(torch.where(labels[..., None] < 0, 0.0, one_hot[labels.clamp(0)]))
        else:
            maps[name] = Regions(labels[None].to(torch.int32), one_hot)
    write_pack(paths[2], maps, {"text_space": "quarters"})
    return paths
