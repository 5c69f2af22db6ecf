"""``A^T Y`` against the dense oracle, and against the render as its transpose."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from liftcore.errors import InvalidInput
from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import ReferenceRaster, dense_view
from tests.backends import every_backend
from tests.properties.test_raster_conformance import INSIDE, WALKS
from tests.scenes import random_camera, random_splats, scenes

CHANNELS = st.sampled_from([1, 3, 32, 33, 70])  # within a pass of the raster, at its edge, over several


def random_image(camera, channels: int) -> torch.Tensor:
    values = np.random.default_rng(1).normal(0, 1, (camera.height, camera.width, channels))
    return torch.tensor(values, dtype=torch.float32)


@every_backend
def test_adjoints_equal_the_oracle(backend):
    @backend.holds(scenes(most=backend.splats, largest=backend.size), st.sampled_from(WALKS), CHANNELS)
    def check(scene, walk, channels) -> None:
        splats, camera, _ = scene
        view = dense_view(splats, camera, walk)
        Y = random_image(camera, channels)
        Y[torch.from_numpy(view.cut.reshape(camera.height, camera.width))] = 0  # the render's test counts the flips
        expected = view.A.T @ Y.double().numpy().reshape(-1, channels)
        got = backend.open(splats).adjoint(camera, Y, walk).numpy()
        assert got.shape == (splats.count, channels)
        assert np.abs(got - expected).max(initial=0) < INSIDE * max(1.0, view.A.sum(axis=0).max(initial=0))


@every_backend
def test_a_render_and_its_adjoint_agree_on_every_inner_product(backend):
    @backend.holds(scenes(most=backend.splats, largest=backend.size), st.sampled_from(WALKS))
    def check(scene, walk) -> None:
        splats, camera, _ = scene
        raster = backend.open(splats)
        X = torch.tensor(np.random.default_rng(2).normal(0, 1, (splats.count, 4)), dtype=torch.float32)
        Y = random_image(camera, 4)
        image, sums = raster.render(camera, X, walk), raster.adjoint(camera, Y, walk)
        left, right = float((image.double() * Y).sum()), float((X * sums.double()).sum())
        scale = float((raster.render(camera, X.abs(), walk).double() * Y.abs()).sum())  # no cancellation in it
        assert abs(left - right) <= 1e-6 * scale + 1e-12


@pytest.mark.parametrize("walk", WALKS[:2])
def test_the_number_of_threads_changes_no_bit_of_an_adjoint(walk):
    splats, camera = random_splats(7, 3_000), random_camera(7, 200, 150)
    runs = [CpuRaster(splats, threads=n).adjoint(camera, random_image(camera, 5), walk) for n in (1, 2, 5)]
    assert float(runs[0].abs().max()) > 0
    assert all(torch.equal(runs[0], run) for run in runs[1:])


def test_the_oracle_gives_the_same_adjoint():
    splats, camera = random_splats(3, 30), random_camera(3)
    Y = random_image(camera, 2)
    Y[torch.from_numpy(dense_view(splats, camera, CompositingParams()).cut.reshape(camera.height, camera.width))] = 0
    fast, plain = (raster(splats).adjoint(camera, Y, CompositingParams()) for raster in (CpuRaster, ReferenceRaster))
    assert torch.allclose(fast, plain, atol=1e-4)


def test_an_image_of_another_size_is_refused():
    splats, camera = random_splats(3, 5), random_camera(3)
    with pytest.raises(InvalidInput, match="values"):
        CpuRaster(splats).adjoint(camera, torch.zeros(3, 4, 1), CompositingParams())
