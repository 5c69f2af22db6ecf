"""The number of views that a view noise estimate recommends, and its accuracy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.io.splats import write_splats
from liftcore.lifting.files import lift_files
from liftcore.lifting.planning.plan import FEW_VIEWS
from liftcore.lifting.planning.views import NOISE_VIEWS, ViewNoiseEstimate
from liftcore.scene.cameras import Cameras
from liftcore.values.pack import write_pack
from liftcore.values.settings import LiftSettings
from liftcore.values.views import Regions
from tests.inria_file import write_inria_cameras
from tests.scenes import centred, random_splats
from tests.unit.plan.test_views import ring

pytestmark = pytest.mark.slow

VIEWS, CHANNELS = FEW_VIEWS + 8, 48


def disagreeing(folder, error: float):
    """Write a scene on a ring of cameras, a vector a view, with errors of this relative length; return its paths."""
    folder.mkdir()
    generator = torch.Generator().manual_seed(3)
    truth, labels = torch.eye(CHANNELS)[:1], torch.zeros(1, 6, 8, dtype=torch.int32)
    errors = torch.randn(VIEWS, CHANNELS, generator=generator)
    errors *= error / CHANNELS**0.5
    cameras = [centred(camera) for camera in ring(VIEWS)]
    observed = {camera.name: Regions(labels, truth + offset) for camera, offset in zip(cameras, errors, strict=True)}
    paths = folder / "splats.ply", folder / "cameras.json", folder / "features.safetensors"
    write_splats(paths[0], random_splats(1, 80, 0.4))
    write_inria_cameras(Cameras(tuple(cameras)), paths[1])
    write_pack(paths[2], observed, {})
    return paths


def test_the_more_views_disagree_the_more_are_lifted(tmp_path):
    counts = []
    for error in (0.0, 0.5, 1.0, 4.0):
        splats, cameras, pack = disagreeing(tmp_path / str(error), error)
        lifted = lift_files(splats, cameras, [pack], LiftSettings.of(view_cosine=0.99))
        counts.append(len(lifted.metadata.views))
    assert counts == sorted(set(counts))
    assert counts[0] <= 2
    assert counts[-1] > 0.9 * VIEWS


def pilot_of(areas: list[list[float]], errors: list[float], weights: list[float]) -> ViewNoiseEstimate:
    return ViewNoiseEstimate(np.array(areas, np.float32), np.array(errors), np.array(weights))


def test_cosines_are_those_of_the_variance_and_of_the_splats_that_views_show():
    views, variance = 20, 2.0
    estimate = pilot_of([[1.0]] * views, [variance / (variance + views)], [1.0])
    among = variance / (1 + variance / views)
    for count, cosine in enumerate(estimate.cosines(range(views)), start=1):
        assert 1 / cosine**2 - 1 == pytest.approx(among * (1 / count - 1 / views), abs=1e-9)
    partly_visible = pilot_of([[1.0, 0.0], [0.0, 1.0]], [0.0, 0.0], [3.0, 1.0])  # total weight weighs splats
    assert list(partly_visible.cosines([0, 1])) == pytest.approx([0.75, 1.0])
    assert list(partly_visible.cosines([1, 0])) == pytest.approx([0.25, 1.0])
    assert pilot_of([[1.0]] * 100, [1.0], [1.0]).views_for(0.9, range(100)) == (81, pytest.approx(0.9))  # all error


def test_with_coverage_beside_it_a_cosine_takes_no_fewer_views_and_no_pilot_flies_for_few(tmp_path):
    paths = disagreeing(tmp_path / "scene", 0.3)
    counts, expected = [], []
    for coverage in (0, 12, 20, VIEWS - NOISE_VIEWS):
        result = lift_files(*paths[:2], [paths[2]], LiftSettings.of(view_cosine=0.95, coverage=coverage))
        counts.append(len(result.metadata.views))
        expected.append(result.metadata.diagnostics["plan"]["view_cosine"])
    assert counts[0] < 12
    assert counts[1:] == [12, 20, VIEWS]
    assert expected[0] < expected[1] < expected[2]
    assert expected[3] is None
