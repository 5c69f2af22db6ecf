"""The measures of A's conditioning equal their dense definitions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from liftcore.raster.base import CompositingParams
from liftcore.raster.cpu.raster import CpuRaster
from tests.benchmarks.conditioning import coupling, neighbourhood, noise_gain, rays_of, self_share, spectrum
from tests.benchmarks.stability.weights import exact_view
from tests.scenes import random_camera, random_splats

EVERY = np.arange(7)


def some_rays(seed: int = 0) -> np.ndarray:
    """A [50, 7] whose rows sum to less than one, half of it empty."""
    rng = np.random.default_rng(seed)
    A = rng.uniform(0, 0.25, (50, 7))
    A[rng.random(A.shape) < 0.5] = 0
    return A


def test_splats_that_share_no_ray_are_perfectly_conditioned():
    A = csr_array(np.repeat(np.eye(7) * 0.9, 4, axis=0))
    assert self_share(A, 1, np.ones(7)) == pytest.approx((1.0, 1.0))
    assert spectrum(A, 1, EVERY).condition == pytest.approx(1)
    assert coupling(A) == pytest.approx(1)
    assert noise_gain(A, 1, EVERY) == pytest.approx(0.5)  # a mean of four


@pytest.mark.parametrize("power", [1, 2])
def test_the_measures_equal_their_dense_definitions(power):
    A = some_rays()
    C, evidence = A**power, A.sum(axis=0)
    answer = (C.T @ A) / C.sum(axis=0)[:, None]  # the closed form of B = A X, as a matrix on X
    shares = np.diag(answer) / answer.sum(axis=1)
    mean, dominant = self_share(csr_array(A), power, evidence)
    assert mean == pytest.approx(np.average(shares, weights=evidence))
    assert dominant == pytest.approx((shares > 0.5).mean())
    noise = np.median(np.linalg.norm(C / C.sum(axis=0), axis=0))
    assert noise_gain(csr_array(A), power, EVERY) == pytest.approx(noise)
    G = C.T @ C
    unit = G / np.sqrt(np.outer(np.diag(G), np.diag(G)))
    found = spectrum(csr_array(A), power, EVERY)
    assert found.condition == pytest.approx(np.linalg.cond(unit))
    assert (found.hidden, found.lost) == (0, 0)
    if power == 1:
        assert coupling(csr_array(A)) == pytest.approx(np.linalg.norm(unit, 2), rel=1e-3)


def test_a_part_bounds_the_condition_of_the_whole_from_below():
    A = csr_array(some_rays())
    assert spectrum(A, 1, EVERY[:4]).condition <= spectrum(A, 1, EVERY).condition


def test_hidden_splats_are_counted_and_left_out():
    A = some_rays()
    A[:, 3] = 0
    assert spectrum(csr_array(A), 1, EVERY).hidden == 1
    assert np.isfinite(spectrum(csr_array(A), 1, EVERY).condition)


def test_rays_are_rows_of_the_scenes_matrix():
    splats, camera = random_splats(5), random_camera(5)
    dense = exact_view(splats, camera, CompositingParams(opacity_logit_scale=2.0)).A
    all_rays = rays_of(CpuRaster(splats), [camera], 2.0, camera.width * camera.height).toarray()
    assert np.abs(all_rays - dense).max() < 1e-5
    fewer = rays_of(CpuRaster(splats), [camera], 2.0, camera.width * camera.height // 9).toarray()
    y, x = np.mgrid[: camera.height : 3, : camera.width : 3]
    assert np.abs(fewer - dense[(y * camera.width + x).ravel()]).max() < 1e-5


def test_a_neighbourhood_is_of_heavy_splats_around_the_heaviest():
    means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [9, 0, 0]])
    assert neighbourhood(means, np.array([0.1, 1.0, 5.0, 1.0, 1.0]), 3).tolist() == [1, 2, 3]
