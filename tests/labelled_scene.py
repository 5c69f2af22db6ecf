"""A wall of splats with an apple and a book on it, a lift that knows which splat is which, and labels of it.

The wall fills the image of a camera four units before it: 160 x 120 pixels, 25 pixels a unit. Objects are
rectangles of pixels of the first frame; the second camera stands 0.2 units to the right, so they move 5 pixels left.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from liftcore.io.splats import write_splats
from liftcore.query.result import LiftResult
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.values.lift import LiftMetadata
from liftcore.values.lift_file import input_file, save_lift
from liftcore.values.settings import LiftSettings
from tests.inria_file import write_inria_cameras

WIDTH, HEIGHT, FOCAL, DISTANCE = 160, 120, 100.0, 4.0
SPACING = 0.08  # units between splats: 2 pixels
OBJECTS = {"red apple": (20, 30, 60, 80), "book": (90, 20, 140, 100)}  # x1 y1 x2 y2 of the first frame, ends outside
WORDS = ("wall", *OBJECTS, "object", "things", "stuff", "texture", "unicorn")
FRAMES = {"frame_00001": 0, "frame_00002": 5}  # name -> disparity: pixels that objects lie further left
LIFTED = "frame_00001"


def write_lift(folder: Path, name: str = "kitchen.lift.safetensors") -> Path:
    """Write splats, cameras, words and a lift that is right about every splat; return the lift's path."""
    columns, rows = (np.arange(-0.6, size * DISTANCE / FOCAL + 0.6, SPACING) for size in (WIDTH, HEIGHT))
    x, y = (axis.ravel() for axis in np.meshgrid(columns, rows))
    pixels = np.stack([x, y], axis=1) * FOCAL / DISTANCE
    owner = np.zeros(len(x), np.int64)
    for row, (x1, y1, x2, y2) in enumerate(OBJECTS.values(), start=1):
        owner[((pixels >= (x1, y1)) & (pixels < (x2, y2))).all(axis=1)] = row
    count = len(x)
    middle = np.array([WIDTH, HEIGHT]) * DISTANCE / FOCAL / 2
    splats = Splats(
        means=torch.tensor(np.stack([x - middle[0], y - middle[1], np.full(count, DISTANCE)], axis=1)).float(),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), float(np.log(0.55 * SPACING))),
        opacity_logits=torch.full((count,), 4.0),
        sh=torch.zeros(count, 1, 3),
    )
    write_splats(folder / "splats.ply", splats)
    cameras = []
    for frame, disparity in FRAMES.items():
        pose = np.eye(4)
        pose[0, 3] = -disparity * DISTANCE / FOCAL
        cameras.append(Camera.pinhole(frame, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose))
    write_inria_cameras(Cameras(tuple(cameras)), folder / "cameras.json")
    words = torch.eye(len(WORDS))
    save_file({"embeddings": words}, str(folder / "words.safetensors"), metadata={"words": json.dumps(WORDS)})
    metadata = LiftMetadata(
        version="test",
        settings=LiftSettings.of(preset="row-sum"),
        splats=input_file(folder / "splats.ply"),
        cameras=input_file(folder / "cameras.json"),
        features=(),
        encoder="by hand",
        text_space=f"table:{folder / 'words.safetensors'}",
        views=(LIFTED,),
        diagnostics={},
        timings={},
    )
    has_feature, ones = torch.ones(count, dtype=torch.bool), torch.ones(count)
    path = folder / name
    save_lift(LiftResult(words[owner].half(), ones * 9, has_feature, metadata), path)
    return path


def truth(name: str, disparity: int = 0) -> np.ndarray:
    """Return the mask of an object in a frame, [120, 160] bool."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    x1, y1, x2, y2 = OBJECTS[name]
    mask[y1:y2, x1 - disparity : x2 - disparity] = True
    return mask
