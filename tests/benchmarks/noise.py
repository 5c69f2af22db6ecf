"""Ways to be wrong, by an explicit seed: poses that are a little off, and masks as segmenters get them wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from liftcore.features.views import NO_LABEL, Regions
from liftcore.scene.cameras import Camera, Cameras

POSE_DEGREES = 1.0  # standard deviation of roll, pitch and yaw (paper, appendix on pose noise)
POSE_SHIFT = 0.01  # standard deviation of each coordinate of the centre, in scene scales (the same)


def scene_scale(cameras: Cameras) -> float:
    """The largest distance of a camera's centre from the mean of all, scene units."""
    centres = np.stack([camera.centre for camera in cameras.values()])
    return float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def noisy_poses(cameras: Cameras, wrong: Sequence[str], seed: int) -> Cameras:
    """The cameras, those named in ``wrong`` turned and moved by Gaussian noise of the paper's size."""
    scale, chosen = scene_scale(cameras), set(wrong)
    random = np.random.default_rng(seed)
    moved = (_moved(view, random, scale) if name in chosen else view for name, view in cameras.items())
    return Cameras(moved)


def _moved(camera: Camera, random: np.random.Generator, scale: float) -> Camera:
    roll, pitch, yaw = np.deg2rad(random.normal(0, POSE_DEGREES, 3))
    turn = _about(2, roll) @ _about(0, pitch) @ _about(1, yaw)
    centre = camera.centre + random.normal(0, POSE_SHIFT * scale, 3)
    pose = np.eye(4)
    pose[:3, :3] = turn @ camera.viewmat[:3, :3]
    pose[:3, 3] = -pose[:3, :3] @ centre
    return replace(camera, viewmat=pose)


def _about(axis: int, angle: float) -> np.ndarray:
    """[3, 3] f64, a turn about one axis."""
    matrix = np.eye(3)
    i, j = [k for k in range(3) if k != axis]
    matrix[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return matrix


def noisy_masks(maps: Mapping[str, Regions], rate: float, seed: int) -> dict[str, Regions]:
    """Region maps in which each region of each level goes wrong with probability ``rate``.

    Equally often it is merged with the neighbour that it touches most (both get the mean of the two vectors), takes
    the vector of another region of the scene, or stays unlabelled.
    """
    random = np.random.default_rng(seed)
    vectors = torch.cat([regions.codebook for regions in maps.values()])
    return {view: _spoilt(regions, rate, vectors, random) for view, regions in maps.items()}


def _spoilt(regions: Regions, rate: float, vectors: torch.Tensor, random: np.random.Generator) -> Regions:
    labels, codebook = regions.labels.numpy().copy(), [regions.codebook]
    rows = regions.codebook.shape[0]
    for level in labels:
        for region in np.unique(level[level != NO_LABEL]):
            if random.random() >= rate:
                continue
            kind, other = random.integers(3), int(random.integers(vectors.shape[0]))
            area = level == region
            if kind == 0:
                neighbour = _neighbour(level, int(region))
                if neighbour == NO_LABEL:
                    continue
                both = torch.cat(codebook)[[int(region), neighbour]].float()
                vector = torch.nn.functional.normalize(both.mean(dim=0), dim=0)
                area |= level == neighbour
            elif kind == 1:
                vector = vectors[other].float()
            else:
                level[area] = NO_LABEL
                continue
            level[area] = rows
            rows += 1
            codebook.append(vector[None].to(regions.codebook.dtype))
    return Regions(torch.from_numpy(labels), torch.cat(codebook))


def _neighbour(level: np.ndarray, region: int) -> int:
    """The label that shares the longest border with a region; NO_LABEL where it touches none."""
    touching = []
    for one, other in ((level[1:], level[:-1]), (level[:, 1:], level[:, :-1])):
        touching += [other[one == region], one[other == region]]
    around = np.concatenate([part.ravel() for part in touching])
    around = around[(around != region) & (around != NO_LABEL)]
    return int(np.bincount(around).argmax()) if around.size else NO_LABEL
