"""The warning: undamped least squares fits wrong masks and ruins the splats; the closed form and damping do not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.features.views import Regions
from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Splats
from liftcore.solve.least_squares import AllRays
from tests.benchmarks.experiments import Truth, closed_form, follow, scored
from tests.scenes import random_camera, random_splats

pytestmark = pytest.mark.slow

CLASSES = 4
WRONG = 0.3  # of the regions carry another class's vector


def soft_splats() -> Splats:
    """Many splats that let light through: long rays, where least squares has much to choose from."""
    splats = random_splats(11, 1_500)
    faint = torch.full_like(splats.opacity_logits, -1.0)
    return Splats(splats.means, splats.quats, splats.log_scales.clamp(-2.5, -1.5), faint)


def wrong_masks(raster: CpuRaster, camera: Camera, objects: torch.Tensor, seed: int) -> Regions:
    """The classes as the view shows them, a vector a region, some of them another class's."""
    rng = np.random.default_rng(seed)
    shown = raster.render(camera, torch.nn.functional.one_hot(objects.long(), CLASSES).float(), CompositingParams())
    labels = torch.where(shown.sum(dim=2) > 0.3, shown.argmax(dim=2), -1).to(torch.int32)
    told = np.where(rng.random(CLASSES) < WRONG, rng.integers(0, CLASSES, CLASSES), np.arange(CLASSES))
    noise = rng.normal(0, 0.1, (CLASSES, CLASSES))
    return Regions(labels[None], torch.tensor(np.eye(CLASSES)[told] + noise, dtype=torch.float32))


@pytest.fixture(scope="module")
def paths() -> dict[float, dict]:
    splats = soft_splats()
    raster = CpuRaster(splats, threads=2)
    objects = (splats.means[:, 0] > 0).int() + 2 * (splats.means[:, 1] > 0).int()
    views = [random_camera(k, 40, 32, name=f"v{k}") for k in range(12)]
    classes = torch.eye(CLASSES)
    seen = [scored(wrong_masks(raster, camera, objects, k), classes) for k, camera in enumerate(views)]
    rays = AllRays(raster, splats.count, views, seen.__getitem__, CompositingParams())
    truth = Truth(classes, objects, torch.from_numpy(rays.row_sums > 0.5))
    first = closed_form(rays, CLASSES)
    return {damping: follow(rays, first, truth, damping, 60)[0] for damping in (0.0, 1.0)}


def test_undamped_steps_lower_the_residual_and_ruin_the_splats(paths):
    path = paths[0.0]
    assert path["residual"][-1] < 0.8 * path["residual"][0]
    assert path["cosine"][-1] < path["cosine"][0] - 0.2
    assert path["accuracy"][-1] < path["accuracy"][0] - 0.1


def test_damped_steps_lower_the_residual_and_keep_the_splats(paths):
    path = paths[1.0]
    assert path["residual"][-1] < path["residual"][0]
    assert path["cosine"][-1] > path["cosine"][0] - 0.05
    assert path["accuracy"][-1] > path["accuracy"][0] - 0.05
