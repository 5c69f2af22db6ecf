"""A small scene with exact truth, in the layout of the shared tabletop scene."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from liftcore.features.pack import write_pack
from liftcore.features.views import Regions
from liftcore.io.inria import write_inria_cameras
from liftcore.io.ply import write_splats
from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from tests.benchmarks.experiments import noisy_masks
from tests.scenes import centred, look_at

CLASSES = 4
A_CLASS = 60  # splats
CHANNELS = 16
VIEWS = 9
HELD_OUT = (2, 6)


def balls() -> tuple[Splats, torch.Tensor]:
    """Four opaque balls of small splats around the origin, and the class of every splat [P] i16."""
    random = np.random.default_rng(0)
    centres = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0.3], [0, -1, -0.3]])
    points = random.normal(0, 1, (CLASSES, A_CLASS, 3))
    points = centres[:, None] + 0.45 * points / np.linalg.norm(points, axis=2, keepdims=True)
    count = CLASSES * A_CLASS
    splats = Splats(
        means=torch.tensor(points.reshape(-1, 3), dtype=torch.float32),
        quats=torch.tensor(random.normal(0, 1, (count, 4)), dtype=torch.float32),
        log_scales=torch.full((count, 3), -2.2),
        opacity_logits=torch.full((count,), 3.0),
        sh=torch.zeros(count, 1, 3),
    )
    return splats, torch.arange(CLASSES, dtype=torch.int16).repeat_interleave(A_CLASS)


def write_truth_scene(folder: Path) -> Path:
    """Write the scene: splats, cameras, three packs of region maps, words and truth; gives the folder."""
    splats, classes = balls()
    angles = np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)
    cameras = Cameras(
        tuple(
            centred(look_at(f"v{k}", 4 * np.array([np.cos(a), 0.4 * np.sin(2 * a), np.sin(a)]), 40, 32, 40.0))
            for k, a in enumerate(angles)
        )
    )
    vectors = torch.nn.functional.normalize(torch.randn(CLASSES, CHANNELS, generator=torch.manual_seed(0)), dim=1)
    raster = CpuRaster(splats)
    masks = {camera.name: _mask(raster, camera, classes) for camera in cameras.values()}
    held_out = [f"v{k}" for k in HELD_OUT]
    maps = {name: Regions(mask[None].int(), vectors) for name, mask in masks.items() if name not in held_out}
    write_splats(splats, folder / "point_cloud.ply")
    write_inria_cameras(cameras, folder / "cameras.json")
    for name, rate in (("features_clean", 0.0), ("features", 0.15), ("features_hard", 0.4)):
        write_pack(folder / f"{name}.safetensors", noisy_masks(maps, rate, seed=1), {"normalised": "true"})
    words = [f"ball {k}" for k in range(CLASSES)]
    save_file({"embeddings": vectors}, folder / "text_table.safetensors", {"words": json.dumps(words)})
    truth = {"splat_object": classes} | {f"{name}/mask": masks[name].short() for name in held_out}
    save_file(truth, folder / "truth.safetensors")
    things = [{"id": k, "class": word, "lvis_row": k} for k, word in enumerate(words)]
    (folder / "truth.json").write_text(json.dumps({"held_out_views": held_out, "objects": things}))
    return folder


def _mask(raster: CpuRaster, camera: Camera, classes: torch.Tensor) -> torch.Tensor:
    """[H, W] i32, the class of the largest weight of a ray; -1 where a ray meets nothing."""
    each = torch.arange(raster.splats.count, dtype=torch.int32)
    ids = raster.strongest_labels(camera, each, CompositingParams()).long()
    return torch.where(ids >= 0, classes[ids.clamp_min(0)].long(), -1).int()
