"""Every raster backend is held to the dense float64 oracle: tight inside, a counted band at the cut-offs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from liftcore.features.views import Regions, ViewFeatures
from liftcore.raster.base import CompositingParams, RayRows, Selection, ViewRequest, Weighting
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import ReferenceRaster, counted_weights, dense_view, reading_matrix, strided_rays
from liftcore.scene.splats import Kernel, Splats
from liftcore.solve.weights import RegionWeights
from tests.backends import Backend, every_backend
from tests.scenes import random_camera, random_grid, random_regions, random_splats, scenes

if TYPE_CHECKING:
    from liftcore.scene.cameras import Camera

INSIDE = 1e-5  # absolute, on weights
FLIPS = 1e-2  # of rays: on tiny random images one ray in a hundred; the pooled test below holds 1e-4
WALKS = (
    CompositingParams(),
    CompositingParams(opacity_logit_scale=1.2),
    CompositingParams(opacity_logit_scale=0.5),
    CompositingParams(alpha_cap=0.999, transmittance_stop=0.05),
)
SELECTIONS = (
    Weighting(1, Selection.TOP_K, count=2),
    Weighting(2, Selection.FRONT_MASS, mass=0.6, floor=0.02),
    Weighting(1, Selection.CENTRE),
)
FOOTPRINTS = {str(kernel): (kernel, False) for kernel in Kernel} | {"3dgs antialiased": (Kernel.GAUSSIAN_3D, True)}

pytestmark = pytest.mark.usefixtures("every_kernel")
every_footprint = pytest.mark.parametrize("footprint", FOOTPRINTS)


def drawn(
    data: st.DataObject, footprint: str, backend: Backend
) -> tuple[Splats, Camera, ViewFeatures, CompositingParams]:
    """A scene of the kernel, a view, what it observes, and a walk."""
    kernel, antialiased = FOOTPRINTS[footprint]
    splats, camera, observation = data.draw(scenes(kernel, backend.splats, backend.size))
    return splats, camera, observation, replace(data.draw(st.sampled_from(WALKS)), antialiased=antialiased)


def seeded(footprint: str, seed: int, count: int) -> tuple[Splats, CompositingParams]:
    """A random scene of the kernel, and its plain walk."""
    kernel, antialiased = FOOTPRINTS[footprint]
    return random_splats(seed, count, kernel=kernel), CompositingParams(antialiased=antialiased)


def dense(weights: RegionWeights, splats: int, rows: int) -> np.ndarray:
    """W as a dense [P, M] matrix."""
    W = np.zeros((splats, rows))
    lengths = np.diff(weights.indptr.numpy())
    W[np.repeat(weights.splats.numpy(), lengths), weights.region.numpy()] = weights.weight.numpy()
    return W


@every_footprint
@every_backend
def test_renders_equal_the_oracle(footprint, backend):
    @backend.holds(st.data())
    def check(data) -> None:
        splats, camera, _, walk = drawn(data, footprint, backend)
        values = torch.tensor(np.random.default_rng(0).uniform(0, 1, (splats.count, 3)), dtype=torch.float32)
        view = dense_view(splats, camera, walk)
        expected = (view.A @ values.double().numpy()).reshape(camera.height, camera.width, 3)
        image = backend.open(splats).render(camera, values, walk).numpy()
        inside = ~view.cut.reshape(camera.height, camera.width)
        assert np.abs(image - expected)[inside].max(initial=0) < INSIDE
        assert (np.abs(image - expected).max(axis=2) > INSIDE).mean() <= max(FLIPS, 1 / inside.size)


@every_footprint
@every_backend
def test_region_weights_equal_the_oracle(footprint, backend):
    @backend.holds(st.data(), st.sampled_from([0, 1, 2]))
    def check(data, power) -> None:
        splats, camera, observation, walk = drawn(data, footprint, backend)
        view = dense_view(splats, camera, walk)
        S, ray = reading_matrix(observation, camera.width, camera.height)
        if dense_view(splats, camera, replace(walk, opacity_logit_scale=1.0)).cut.any() or view.cut.any():
            return  # the pooled test counts the flips
        expected = np.where(view.A > 0, view.A**power, 0.0)[ray].T @ S
        weights = backend.open(splats).region_weights(camera, observation, walk, Weighting(power))
        W = dense(weights, splats.count, observation.codebook.shape[0])
        assert np.abs(W - expected).max(initial=0) < INSIDE * max(1.0, expected.max(initial=0))


@pytest.mark.parametrize("reading", ["regions", "grid"])
@every_backend
def test_a_region_or_a_cell_for_every_pixel_is_weighed_as_the_oracle_weighs_it(reading, backend):
    camera, splats = random_camera(3, *backend.size), random_splats(3, 60)
    pixels = camera.width * camera.height
    labels = torch.arange(pixels, dtype=torch.int32).reshape(1, camera.height, camera.width)
    if reading == "grid":
        observation = random_grid(3, (camera.height + 4, camera.width - 4))
    else:
        observation = Regions(torch.cat([labels, labels // 200]), torch.ones(pixels, 1))
    view = dense_view(splats, camera, CompositingParams())
    S, ray = reading_matrix(observation, camera.width, camera.height)
    weights = backend.open(splats).region_weights(camera, observation, CompositingParams(), Weighting())
    W = dense(weights, splats.count, observation.codebook.shape[0])
    assert not view.cut.any() and (W > 0).sum() > 2 * pixels
    assert np.abs(W - view.A[ray].T @ S).max() < INSIDE


@pytest.mark.parametrize("cells", [(4.0, 4.0), (0, 4.0), (4.0, 0), (0, 0), (2.05, 2.05)])  # a pixel, down and across
@every_backend
def test_grids_finer_than_pixels_and_of_one_cell_equal_the_oracle(cells, backend):
    # Four by four: each pixel reads four cells of its own.
    camera, splats = random_camera(3, *((18, 4) if backend.name == "gpu" else (20, 18))), random_splats(3, 60)
    down, across = (max(1, int(n * side)) for n, side in zip(cells, (camera.height, camera.width), strict=True))
    observation = random_grid(3, (down, across))
    view = dense_view(splats, camera, CompositingParams())
    S, ray = reading_matrix(observation, camera.width, camera.height)
    weights = backend.open(splats).region_weights(camera, observation, CompositingParams(), Weighting(2))
    W = dense(weights, splats.count, observation.codebook.shape[0])
    assert not view.cut.any() and W.max() > 0
    assert np.abs(W - (view.A**2)[ray].T @ S).max() < INSIDE


@every_footprint
@every_backend
def test_evidence_is_the_sum_of_plain_weights_whatever_the_gain(footprint, backend):
    @backend.holds(st.data())
    def check(data) -> None:
        splats, camera, observation, walk = drawn(data, footprint, backend)
        view = dense_view(splats, camera, replace(walk, opacity_logit_scale=1.0))
        weights = backend.open(splats).region_weights(camera, observation, walk, Weighting(2))
        evidence = np.zeros(splats.count)
        evidence[weights.evidence_splats.numpy()] = weights.evidence.numpy()
        if not view.cut.any():
            expected = view.A.sum(axis=0)
            assert np.abs(evidence - expected).max() < INSIDE * max(1.0, expected.max())


@every_footprint
@every_backend
def test_selections_and_strides_equal_the_oracle(footprint, backend):
    @backend.holds(st.data(), st.sampled_from(SELECTIONS), st.sampled_from([1, 3]))
    def check(data, weighting, stride) -> None:
        splats, camera, _, walk = drawn(data, footprint, backend)
        walk = replace(walk, stride=stride)
        view = dense_view(splats, camera, walk)
        chosen, hard = counted_weights(view.A, splats, camera, walk, weighting)
        rays = camera.width * camera.height
        labels = torch.arange(rays, dtype=torch.int32).reshape(1, camera.height, camera.width)
        one_a_ray = Regions(labels, torch.ones(rays, 1))
        W = dense(backend.open(splats).region_weights(camera, one_a_ray, walk, weighting), splats.count, rays)
        walked = strided_rays(camera, walk)
        assert W[:, ~walked].max(initial=0) == 0
        clear = walked & ~view.cut & ~hard
        assert np.abs(W.T - chosen)[clear].max(initial=0) < INSIDE


@every_footprint
@every_backend
def test_flips_at_the_cut_offs_are_rare_and_unbiased(footprint, backend):
    rays = flips = 0
    drift = 0.0
    for seed in range(backend.seeds):
        (splats, walk), camera = seeded(footprint, seed, 80), random_camera(seed, 64, 48)
        expected = dense_view(splats, camera, walk).A.sum(axis=1)
        error = backend.open(splats).render(camera, torch.ones(splats.count, 1), walk).numpy().ravel() - expected
        rays += error.size
        flips += int((np.abs(error) > INSIDE).sum())
        drift += float(error.sum())
    assert flips / rays < 1e-4
    assert abs(drift) / rays < 1e-6


@every_footprint
@every_backend
def test_ray_rows_are_rows_of_a(footprint, backend):
    @backend.holds(st.data())
    def check(data) -> None:
        splats, camera, _, walk = drawn(data, footprint, backend)
        view = dense_view(splats, camera, walk)
        y, x = np.mgrid[: camera.height, : camera.width]
        some = np.arange(view.A.shape[0])[:: -(-view.A.shape[0] // backend.rays)]
        pixels = torch.tensor(np.stack([x.ravel(), y.ravel()], axis=1)[some], dtype=torch.int32)
        rows = backend.open(splats).ray_rows(camera, pixels, walk)
        A = np.zeros((len(some), splats.count))
        A[np.repeat(np.arange(len(some)), np.diff(rows.indptr.numpy())), rows.splats.numpy()] = rows.weights.numpy()
        assert np.abs(A - view.A[some])[~view.cut[some]].max(initial=0) < INSIDE


def same_bits(one: RegionWeights | RayRows, other: RegionWeights | RayRows) -> bool:
    """Whether all tensors of the two are equal to the bit."""
    parts = ([part for part in vars(of).values() if isinstance(part, torch.Tensor)] for of in (one, other))
    return all(map(torch.equal, *parts))


@every_footprint
@every_backend
def test_views_walked_in_a_row_are_those_walked_alone_to_the_bit(footprint, backend):
    splats, walk = seeded(footprint, 7, 12)
    pixels = (torch.tensor([[3, 4], [10, 11]], dtype=torch.int32), torch.empty(0, 2, dtype=torch.int32))
    looks = [
        ViewRequest(
            random_camera(k, 14, 13),
            random_regions(k),
            replace(walk, opacity_logit_scale=1.0 + k % 2 / 5),
            Weighting(),
            pixels[k % 2],
        )
        for k in range(3)
    ]
    walked = list(backend.open(splats).iterate_views(iter(looks)))
    assert len(walked) == len(looks)
    alone = backend.open(splats)
    for look, found in zip(looks, walked, strict=True):
        assert same_bits(found.weights, alone.region_weights(look.camera, look.observation, look.params, Weighting()))
        if len(look.pixels):
            assert same_bits(found.rows, alone.ray_rows(look.camera, look.pixels, look.params))
        else:
            assert found.rows.indptr.tolist() == [0]


@every_footprint
@pytest.mark.parametrize("gain", [1.0, 1.2])
def test_the_number_of_threads_changes_no_bit(footprint, gain):
    (splats, walk), camera = seeded(footprint, 7, 3_000), random_camera(7, 200, 150)
    walk = replace(walk, opacity_logit_scale=gain)
    for observation in (random_regions(7, 4, 30, (75, 100)), random_grid(7, (10, 13))):
        runs = [
            CpuRaster(splats, threads=n).region_weights(camera, observation, walk, Weighting(2)) for n in (1, 2, 5)
        ]
        for other in runs[1:]:
            for name, own in runs[0].tensors().items():
                assert torch.equal(own, getattr(other, name)), name
    images = [CpuRaster(splats, threads=n).row_sums(camera, walk) for n in (1, 2, 5)]
    assert all(torch.equal(images[0], image) for image in images[1:])


@every_footprint
@every_backend
@pytest.mark.parametrize("seed", range(2))
def test_the_oracle_is_a_backend_that_gives_the_same_products(footprint, backend, seed):
    (splats, walk), camera = seeded(footprint, seed, 30), random_camera(seed)
    if dense_view(splats, camera, walk).cut.any():
        camera = random_camera(seed + 100)
    fast, plain = backend.open(splats), ReferenceRaster(splats)
    observation = random_regions(seed)
    rows = observation.codebook.shape[0]
    ours, theirs = (raster.region_weights(camera, observation, walk, Weighting(2)) for raster in (fast, plain))
    assert np.abs(dense(ours, 30, rows) - dense(theirs, 30, rows)).max() < INSIDE
    assert torch.equal(ours.evidence_splats, theirs.evidence_splats)
    assert torch.allclose(fast.row_sums(camera, walk), plain.row_sums(camera, walk), atol=INSIDE)
