"""The demo's scene: the same every time, opaque, and with mistakes where they are asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from liftcore.demo.masks import Mistakes, observe, true_labels
from liftcore.demo.still_life import StillLife, still_life
from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.raster import CpuRaster

pytestmark = pytest.mark.slow

NONE = Mistakes(merged=0, split=0, misnamed=0, unlabelled=1e-9, displacement=0, noise=0)


class Letters:
    """Any text to a unit vector of its own."""

    name = "letters"
    channels = 26

    def encode(self, texts: Sequence[str]) -> np.ndarray:
        counts = np.array([[text.count(chr(97 + k)) + 0.01 for k in range(26)] for text in texts], np.float32)
        return counts / np.linalg.norm(counts, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def scene() -> StillLife:
    return still_life(seed=7, views=4)


@pytest.fixture(scope="module")
def raster(scene: StillLife) -> CpuRaster:
    return CpuRaster(scene.splats)


def test_the_same_seed_gives_the_same_scene(scene: StillLife) -> None:
    again = still_life(seed=7, views=4)
    other = still_life(seed=8, views=4)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        assert torch.equal(getattr(scene.splats, name), getattr(again.splats, name))
    assert not torch.equal(scene.splats.means, other.splats.means)
    assert 30_000 <= scene.splats.count <= 60_000


def test_every_ray_ends_in_the_scene(scene: StillLife, raster: CpuRaster) -> None:
    for camera in scene.cameras.values():
        sums = raster.row_sums(camera, CompositingParams())
        assert float(sums.mean()) > 0.99
        assert float(sums.min()) > 0.85


def test_every_object_is_seen(scene: StillLife, raster: CpuRaster) -> None:
    labels = true_labels(scene, raster, scene.held_out[0])
    assert set(np.unique(labels[0])) == set(range(len(scene.things)))


def test_masks_without_mistakes_are_the_truth(scene: StillLife, raster: CpuRaster) -> None:
    observed = observe(scene, raster, Letters(), NONE, seed=1)
    assert set(observed) == {camera.name for camera in scene.cameras.values()} - set(scene.held_out)
    view, regions = next(iter(observed.items()))
    truth = true_labels(scene, raster, view)
    words = [torch.from_numpy(Letters().encode(names)) for names in (scene.things, scene.parts)]
    for level in range(2):
        known = regions.labels[level] >= 0
        read = regions.codebook.float()[regions.labels[level][known].long()]
        named = words[level][torch.from_numpy(truth[level])[known].long()]
        assert known.float().mean() > 0.99
        assert float((read * named).sum(dim=1).mean()) > 0.99


def test_mistakes_are_made_and_are_the_same_at_every_run(scene: StillLife, raster: CpuRaster) -> None:
    first, again = (observe(scene, raster, Letters(), Mistakes(), seed=2) for _ in range(2))
    clean = observe(scene, raster, Letters(), NONE, seed=2)
    for view, regions in first.items():
        assert torch.equal(regions.labels, again[view].labels)
        assert torch.equal(regions.codebook, again[view].codebook)
        assert not torch.equal(regions.labels, clean[view].labels)
        assert int(regions.labels.max()) < len(regions.codebook)
        assert 0.005 < float((regions.labels < 0).float().mean()) < 0.12
