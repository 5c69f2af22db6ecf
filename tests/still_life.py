"""A still life as files: a mug, a bowl and a lamp on a table, with exact masks of what stands there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file

import liftcore as lc
from liftcore.values.pack import write_pack
from tests.inria_file import write_inria_cameras

THINGS = {  # name -> centre x, y, z in decimetres, z up; radius; height
    "mug": ((-2.5, -1.5, 0.6), 0.55, 1.2),
    "bowl": ((0.1, -0.1, 0.4), 1.2, 0.8),
    "lamp": ((3.2, 1.3, 1.7), 0.8, 3.4),
}
WORDS = ("table", *THINGS)
VIEWS, WIDTH, HEIGHT, FOCAL = 5, 480, 360, 430.0


def splats_and_owners() -> tuple[lc.Splats, np.ndarray]:
    """Return round splats on the surfaces of the things, and the row of WORDS of each [P]."""
    rng = np.random.default_rng(7)
    points, owners = [rng.uniform((-7, -4, 0), (7, 3, 0), (5000, 3))], [np.zeros(5000, int)]
    for number, (centre, radius, height) in enumerate(THINGS.values(), start=1):
        angle, along = rng.uniform(0, 2 * np.pi, 1500), rng.uniform(-height / 2, height / 2, 1500)
        points.append(np.array(centre) + np.stack([radius * np.cos(angle), radius * np.sin(angle), along], axis=1))
        owners.append(np.full(1500, number))
    means = np.concatenate(points).astype(np.float32)
    log_scales, quats = np.full(means.shape, np.log(0.09)), np.tile([1.0, 0, 0, 0], (len(means), 1))
    colours = np.random.default_rng(1).uniform(-1, 1, (len(WORDS), 1, 3))[np.concatenate(owners)]
    return lc.Splats(means, quats, log_scales, np.full(len(means), 4.0), sh=colours), np.concatenate(owners)


def upright_camera(name: str, angle: float) -> lc.Camera:
    """Return a camera before the table that looks at the origin, z up."""
    centre = np.array([9 * np.sin(angle), -9 * np.cos(angle), 5.0])
    forward = -centre / np.linalg.norm(centre)
    right = np.array([np.cos(angle), np.sin(angle), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return lc.Camera.pinhole(name, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)


def write_still_life(folder: Path) -> None:
    """Write ``point_cloud.ply``, ``cameras.json``, ``features.safetensors`` and a table of words."""
    folder.mkdir(exist_ok=True)
    splats, owners = splats_and_owners()
    cameras = lc.Cameras([upright_camera(f"v{k}", np.radians(26 * k - 52)) for k in range(VIEWS)])
    vectors = np.random.default_rng(7).standard_normal((len(WORDS), 64)).astype(np.float32)
    shares = torch.nn.functional.one_hot(torch.from_numpy(owners), len(WORDS)).float()
    views = {}
    for name, camera in cameras.items():
        image = lc.render(splats, camera, shares)
        labels = torch.where(image.sum(dim=2) > 0.5, image.argmax(dim=2), -1)
        views[name] = lc.Regions(labels.int(), vectors)
    lc.write_splats(folder / "point_cloud.ply", splats)
    write_inria_cameras(cameras, folder / "cameras.json")
    write_pack(folder / "features.safetensors", views, {"encoder": "exact masks", "text_space": "words"})
    save_file({"embeddings": vectors}, folder / "text_table.safetensors", metadata={"words": json.dumps(WORDS)})
