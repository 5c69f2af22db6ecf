"""Noise is of the size it says, hits what it should and nothing else, and repeats with its seed."""

from __future__ import annotations

import numpy as np
import torch

from liftcore.features.views import Regions
from liftcore.scene.cameras import Cameras
from tests.benchmarks.noise import POSE_SHIFT, noisy_masks, noisy_poses, scene_scale
from tests.scenes import random_camera, random_regions

CAMERAS = Cameras(tuple(random_camera(k, name=f"v{k}") for k in range(400)))


def turns_in_degrees(one: Cameras, other: Cameras) -> np.ndarray:
    """How far each camera of one set is turned from its twin in the other."""
    products = [a.viewmat[:3, :3] @ b.viewmat[:3, :3].T for a, b in zip(one.values(), other.values(), strict=True)]
    return np.rad2deg(np.arccos([np.clip((np.trace(product) - 1) / 2, -1, 1) for product in products]))


def test_pose_noise_has_one_degree_and_a_hundredth_of_the_scene_an_axis():
    noisy = noisy_poses(CAMERAS, list(CAMERAS), seed=1)
    turns = turns_in_degrees(noisy, CAMERAS)
    shifts = np.stack([a.centre - b.centre for a, b in zip(noisy.values(), CAMERAS.values(), strict=True)])
    assert abs(np.sqrt((turns**2).mean() / 3) - 1) < 0.06
    assert abs(shifts.std() / (POSE_SHIFT * scene_scale(CAMERAS)) - 1) < 0.06


def test_pose_noise_leaves_the_other_views_alone():
    noisy = noisy_poses(CAMERAS, ["v3", "v7"], seed=1)
    changed = [a.name for a, b in zip(noisy.values(), CAMERAS.values(), strict=True) if a is not b]
    assert changed == ["v3", "v7"]


def two_halves() -> Regions:
    """A left and a right region with orthogonal vectors, and a column that nobody labelled."""
    labels = torch.tensor([[[0, 0, 1, 1, -1]] * 4], dtype=torch.int32)
    return Regions(labels, torch.eye(2))


def test_without_noise_the_masks_stay():
    maps = {"a": random_regions(3), "b": random_regions(4)}
    noisy = noisy_masks(maps, 0.0, seed=5)
    assert all(torch.equal(noisy[view].labels, maps[view].labels) for view in maps)


def test_each_way_of_going_wrong_occurs_and_is_what_it_says():
    kinds = set()
    for seed in range(60):
        noisy = noisy_masks({"a": two_halves()}, 0.4, seed)["a"]
        left, right, none = (int(noisy.labels[0, 0, x]) for x in (0, 2, 4))
        assert none == -1
        if left == right and left >= 0 and torch.allclose(noisy.codebook[left], torch.full((2,), 0.5**0.5)):
            kinds.add("merged")
        if left == -1 and right == 1:
            kinds.add("unlabelled")
        if left >= 2 and right == 1 and torch.equal(noisy.codebook[left], torch.tensor([0.0, 1.0])):
            kinds.add("wrong")
    assert kinds == {"merged", "unlabelled", "wrong"}


def test_the_rate_is_the_share_of_regions_that_change():
    labels = torch.arange(900, dtype=torch.int32).reshape(1, 30, 30).repeat_interleave(2, 1).repeat_interleave(2, 2)
    regions = Regions(labels, torch.nn.functional.normalize(torch.randn(900, 8), dim=1))
    noisy = noisy_masks({"a": regions}, 0.1, seed=2)["a"]
    changed = 900 - torch.isin(torch.arange(900), noisy.labels).sum().item()
    assert 60 < changed < 200  # a merge takes a neighbour along


def test_the_same_seed_gives_the_same_noise():
    maps = {"a": random_regions(3), "b": random_regions(4)}
    runs = [noisy_masks(maps, 0.5, seed=5) for _ in range(2)]
    assert all(torch.equal(runs[0][view].labels, runs[1][view].labels) for view in maps)
