"""Every raster backend is held to the dense float64 oracle: tight inside, a counted band at the cut-offs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from liftcore.raster.cpu import CpuRaster
from liftcore.raster.oracle import OracleRaster, dense_view, reading_matrix
from liftcore.raster.protocol import RegionWeights, Walk, Weighting
from tests.scenes import random_camera, random_grid, random_regions, random_splats, scenes

INSIDE = 1e-5  # absolute, on weights
FLIPS = 1e-2  # of rays: on tiny random images one ray in a hundred; the pooled test below holds 1e-4
WALKS = (Walk(), Walk(gain=1.2), Walk(gain=0.5), Walk(alpha_cap=0.999, transmittance_stop=0.05))

hypothesis_settings = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def dense(weights: RegionWeights, splats: int, rows: int) -> np.ndarray:
    """W as a dense [P, M] matrix."""
    W = np.zeros((splats, rows))
    lengths = np.diff(weights.row_starts.numpy())
    W[np.repeat(weights.splats.numpy(), lengths), weights.columns.numpy()] = weights.weights.numpy()
    return W


@hypothesis_settings
@given(scenes(), st.sampled_from(WALKS))
def test_renders_equal_the_oracle(scene, walk):
    splats, camera, _ = scene
    values = torch.tensor(np.random.default_rng(0).uniform(0, 1, (splats.count, 3)), dtype=torch.float32)
    view = dense_view(splats, camera, walk)
    expected = (view.A @ values.double().numpy()).reshape(camera.height, camera.width, 3)
    image = CpuRaster(splats, threads=2).render(camera, values, walk).numpy()
    inside = ~view.cut.reshape(camera.height, camera.width)
    assert np.abs(image - expected)[inside].max(initial=0) < INSIDE
    assert (np.abs(image - expected).max(axis=2) > INSIDE).mean() <= max(FLIPS, 1 / inside.size)


@hypothesis_settings
@given(scenes(), st.sampled_from(WALKS), st.sampled_from([0, 1, 2]))
def test_region_weights_equal_the_oracle(scene, walk, power):
    splats, camera, observation = scene
    view = dense_view(splats, camera, walk)
    S, ray = reading_matrix(observation, camera.width, camera.height)
    if dense_view(splats, camera, Walk(1.0, walk.alpha_cap, walk.transmittance_stop)).cut.any() or view.cut.any():
        return  # the pooled test counts the flips
    expected = np.where(view.A > 0, view.A**power, 0.0)[ray].T @ S
    weights = CpuRaster(splats, threads=2).region_weights(camera, observation, walk, Weighting(power))
    W = dense(weights, splats.count, observation.codebook.shape[0])
    assert np.abs(W - expected).max(initial=0) < INSIDE * max(1.0, expected.max(initial=0))


@hypothesis_settings
@given(scenes(), st.sampled_from(WALKS))
def test_evidence_is_the_sum_of_plain_weights_whatever_the_gain(scene, walk):
    splats, camera, observation = scene
    view = dense_view(splats, camera, Walk(1.0, walk.alpha_cap, walk.transmittance_stop))
    weights = CpuRaster(splats, threads=2).region_weights(camera, observation, walk, Weighting(2))
    evidence = np.zeros(splats.count)
    evidence[weights.evidence_splats.numpy()] = weights.evidence.numpy()
    if not view.cut.any():
        expected = view.A.sum(axis=0)
        assert np.abs(evidence - expected).max() < INSIDE * max(1.0, expected.max())


def test_flips_at_the_cut_offs_are_rare_and_unbiased():
    rays = flips = 0
    drift = 0.0
    for seed in range(60):
        splats, camera = random_splats(seed, 80), random_camera(seed, 64, 48)
        values = torch.ones(splats.count, 1)
        expected = dense_view(splats, camera, Walk()).A.sum(axis=1)
        error = CpuRaster(splats).render(camera, values, Walk()).numpy().ravel() - expected
        rays += error.size
        flips += int((np.abs(error) > INSIDE).sum())
        drift += float(error.sum())
    assert flips / rays < 1e-4
    assert abs(drift) / rays < 1e-6


@hypothesis_settings
@given(scenes(), st.integers(1, 7))
def test_top_weights_are_the_largest_of_each_ray(scene, count):
    splats, camera, _ = scene
    view = dense_view(splats, camera, Walk())
    ids, weights = CpuRaster(splats).top_weights(camera, Walk(), count)
    expected = -np.sort(-view.A, axis=1)[:, :count]
    expected = np.pad(expected, ((0, 0), (0, count - expected.shape[1])))
    got = weights.numpy().reshape(-1, count)
    assert np.abs(got - expected)[~view.cut].max(initial=0) < INSIDE
    flat = ids.numpy().reshape(-1, count)
    named = np.where(flat >= 0, np.take_along_axis(view.A, np.maximum(flat, 0), axis=1), 0)
    assert np.abs(named - got)[~view.cut].max(initial=0) < INSIDE


@hypothesis_settings
@given(scenes())
def test_ray_rows_are_rows_of_a(scene):
    splats, camera, _ = scene
    view = dense_view(splats, camera, Walk())
    y, x = np.mgrid[: camera.height, : camera.width]
    pixels = torch.tensor(np.stack([x.ravel(), y.ravel()], axis=1), dtype=torch.int32)
    rows = CpuRaster(splats).ray_rows(camera, pixels, Walk())
    A = np.zeros_like(view.A)
    A[np.repeat(np.arange(A.shape[0]), np.diff(rows.row_starts.numpy())), rows.splats.numpy()] = rows.weights.numpy()
    assert np.abs(A - view.A)[~view.cut].max(initial=0) < INSIDE


@pytest.mark.parametrize("walk", WALKS)
def test_the_number_of_threads_changes_no_bit(walk):
    splats, camera = random_splats(7, 3_000), random_camera(7, 200, 150)
    for observation in (random_regions(7, 4, 30, (75, 100)), random_grid(7, (10, 13))):
        runs = [
            CpuRaster(splats, threads=n).region_weights(camera, observation, walk, Weighting(2)) for n in (1, 2, 5)
        ]
        for other in runs[1:]:
            for name in RegionWeights.__dataclass_fields__:
                assert torch.equal(getattr(runs[0], name), getattr(other, name)), name
        images = [CpuRaster(splats, threads=n).row_sums(camera, walk) for n in (1, 2, 5)]
        assert all(torch.equal(images[0], image) for image in images[1:])


@pytest.mark.parametrize("seed", range(4))
def test_the_oracle_is_a_backend_that_gives_the_same_products(seed):
    splats, camera, walk = random_splats(seed, 30), random_camera(seed), Walk()
    if dense_view(splats, camera, walk).cut.any():
        camera = random_camera(seed + 100)
    fast, plain = CpuRaster(splats), OracleRaster(splats)
    observation = random_regions(seed)
    rows = observation.codebook.shape[0]
    ours, theirs = (raster.region_weights(camera, observation, walk, Weighting(2)) for raster in (fast, plain))
    assert np.abs(dense(ours, 30, rows) - dense(theirs, 30, rows)).max() < INSIDE
    assert torch.equal(ours.evidence_splats, theirs.evidence_splats)
    assert torch.allclose(fast.row_sums(camera, walk), plain.row_sums(camera, walk), atol=INSIDE)
    mine, reference = (raster.top_weights(camera, walk, 3)[1] for raster in (fast, plain))
    assert torch.allclose(mine, reference, atol=INSIDE)
