"""Every weighting and every stride is held to the dense float64 oracle, weight by weight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from liftcore.errors import InvalidInput
from liftcore.features.views import Regions
from liftcore.raster.base import CompositingParams, Selection, Weighting
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import ReferenceRaster, counted_weights, dense_view, strided_rays
from liftcore.solve.weights import RegionWeights
from tests.scenes import random_camera, random_grid, random_regions, random_splats, scenes

INSIDE = 1e-5  # absolute, on weights away from cut-offs, ties and borders
UNDECIDED = 0.03  # of rays that such a band may take, and no comparison sees
ALL = Weighting()
WEIGHTINGS = (
    Weighting(power=0),
    Weighting(floor=0.05),
    Weighting(2, floor=0.05),
    Weighting(1, Selection.TOP_K, count=1),
    Weighting(2, Selection.TOP_K, count=3),
    Weighting(0, Selection.TOP_K, count=2, floor=0.02),
    Weighting(1, Selection.TOP_K, count=64),
    Weighting(1, Selection.FRONT_MASS, mass=0.75),
    Weighting(2, Selection.FRONT_MASS, mass=0.3, floor=0.1),
    Weighting(1, Selection.FRONT_MASS, mass=1.0),
    Weighting(1, Selection.CENTRE),
    Weighting(0, Selection.CENTRE, floor=0.02),
)
NAMES = [f"{w.selection}-{w.count if w.selection is Selection.TOP_K else w.mass}-{w.power}" for w in WEIGHTINGS]

hypothesis_settings = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
weightings = st.sampled_from(WEIGHTINGS)
gains = st.sampled_from([CompositingParams(), CompositingParams(opacity_logit_scale=1.2)])


def every_ray(camera) -> Regions:
    """A region a pixel, so that W^T is A' itself."""
    rays = camera.width * camera.height
    labels = torch.arange(rays, dtype=torch.int32).reshape(1, camera.height, camera.width)
    return Regions(labels, torch.ones(rays, 1))


def matrix(weights: RegionWeights, splats: int, rows: int) -> np.ndarray:
    """W^T as a dense [M, P] matrix."""
    W = np.zeros((rows, splats))
    lengths = np.diff(weights.indptr.numpy())
    W[weights.region.numpy(), np.repeat(weights.splats.numpy(), lengths)] = weights.weight.numpy()
    return W


def chosen_of(splats, camera, walk, weighting=ALL) -> np.ndarray:
    """A' [H * W, P] of the CPU."""
    got = CpuRaster(splats, threads=2).region_weights(camera, every_ray(camera), walk, weighting)
    return matrix(got, splats.count, camera.width * camera.height)


def strides(camera) -> st.SearchStrategy[tuple[int, tuple[int, int]]]:
    """A stride and a first pixel that the image has."""
    first = st.tuples(st.integers(0, camera.width - 1), st.integers(0, camera.height - 1))
    pairs = st.tuples(st.integers(1, 5), first)
    return pairs.map(lambda pair: (pair[0], (pair[1][0] % pair[0], pair[1][1] % pair[0])))


@hypothesis_settings
@given(scenes(), gains, weightings)
def test_every_weight_that_counts_equals_the_oracle(scene, walk, weighting):
    splats, camera, _ = scene
    view = dense_view(splats, camera, walk)
    expected, undecided = counted_weights(view.A, splats, camera, walk, weighting)
    inside = ~(view.cut | undecided)
    assert np.abs(chosen_of(splats, camera, walk, weighting) - expected)[inside].max(initial=0) < INSIDE


@pytest.mark.parametrize("weighting", WEIGHTINGS, ids=NAMES)
def test_few_rays_are_too_close_to_call(weighting):
    rays, undecided, wrong = 0, 0, 0
    for seed in range(4):
        splats, camera = random_splats(seed, 60), random_camera(seed)
        view = dense_view(splats, camera, CompositingParams())
        expected, close = counted_weights(view.A, splats, camera, CompositingParams(), weighting)
        off = np.abs(chosen_of(splats, camera, CompositingParams(), weighting) - expected).max(axis=1) > INSIDE
        rays += off.size
        undecided += int((close & ~view.cut).sum())
        wrong += int((off & ~close & ~view.cut).sum())
    assert wrong == 0
    assert undecided / rays < UNDECIDED


@hypothesis_settings
@given(st.data(), scenes(), weightings)
def test_strided_rays_are_rays_of_the_full_view(data, scene, weighting):
    splats, camera, _ = scene
    stride, offset = data.draw(strides(camera))
    walk = CompositingParams(stride=stride, offset=offset)
    view = dense_view(splats, camera, walk)
    expected, undecided = counted_weights(view.A, splats, camera, walk, weighting)
    walked = strided_rays(camera, walk)
    got = chosen_of(splats, camera, walk, weighting)
    assert not got[~walked].any()
    assert np.abs(got - expected)[walked & ~(view.cut | undecided)].max(initial=0) < INSIDE


@hypothesis_settings
@given(st.data(), scenes())
def test_strided_pixels_read_what_they_read_at_full_resolution(data, scene):
    splats, camera, observation = scene
    stride, offset = data.draw(strides(camera))
    walk = CompositingParams(stride=stride, offset=offset)
    if dense_view(splats, camera, walk).cut.any():
        return
    rows = observation.codebook.shape[0]
    fast, plain = (
        raster(splats).region_weights(camera, observation, walk, ALL) for raster in (CpuRaster, ReferenceRaster)
    )
    expected = matrix(plain, splats.count, rows)
    assert np.abs(matrix(fast, splats.count, rows) - expected).max(initial=0) < INSIDE * max(
        1, expected.max(initial=0)
    )
    assert torch.equal(fast.evidence_splats, plain.evidence_splats)
    assert torch.allclose(fast.evidence, plain.evidence, rtol=1e-5, atol=INSIDE)


@pytest.mark.parametrize("weighting", WEIGHTINGS, ids=NAMES)
def test_the_evidence_is_the_same_in_every_weighting(weighting):
    splats, camera = random_splats(3, 400), random_camera(3, 90, 70)
    for walk in (CompositingParams(), CompositingParams(opacity_logit_scale=1.2)):
        usual, own = (CpuRaster(splats).region_weights(camera, random_regions(3), walk, w) for w in (ALL, weighting))
        assert torch.equal(usual.evidence_splats, own.evidence_splats)
        assert torch.allclose(usual.evidence, own.evidence, rtol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 5, 64])
@pytest.mark.parametrize(
    "walk", [CompositingParams(), CompositingParams(opacity_logit_scale=1.2)], ids=["plain", "gain"]
)
def test_exactly_k_weights_of_a_ray_count(count, walk):
    splats, camera = random_splats(11, 500), random_camera(11, 90, 70)
    every = chosen_of(splats, camera, walk, Weighting(0)).sum(axis=1)
    kept = chosen_of(splats, camera, walk, Weighting(0, Selection.TOP_K, count=count)).sum(axis=1)
    assert every.max() > 5
    assert np.array_equal(kept, np.minimum(every, count))


def test_of_equal_weights_the_nearest_counts():
    """Behind an alpha of 1/4, an alpha of 1/3 weighs 1/4 too; some float near log 1/2 makes it so to the bit."""
    camera = random_camera(0, 9, 9).replace(cx=4.5, cy=4.5, fx=9.0, fy=9.0, viewmat=np.eye(4))
    means, scales = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 2.0]]), torch.ones(2, 3)  # the second is the nearer
    ray, ties = 4 * 9 + 4, 0
    for step in range(-8, 9):
        behind = np.float32(np.log(0.5)) + step * np.spacing(np.float32(0.5))
        logits = torch.tensor([behind, np.log(1 / 3)], dtype=torch.float32)
        splats = replace(random_splats(0, 2), means=means, opacity_logits=logits, log_scales=scales)
        far, near = chosen_of(splats, camera, CompositingParams())[ray]
        if far == near:
            ties += 1
            kept = chosen_of(splats, camera, CompositingParams(), Weighting(1, Selection.TOP_K, count=1))[ray]
            assert kept.tolist() == [0.0, near]
            assert (
                np.count_nonzero(
                    chosen_of(splats, camera, CompositingParams(), Weighting(1, Selection.TOP_K, count=2))[ray]
                )
                == 2
            )
    assert ties > 0


@pytest.mark.parametrize("weighting", [ALL, *WEIGHTINGS], ids=["all", *NAMES])
@pytest.mark.parametrize(
    "walk",
    [CompositingParams(opacity_logit_scale=1.2), CompositingParams(stride=3, offset=(1, 2))],
    ids=["full", "strided"],
)
def test_the_number_of_threads_changes_no_bit(weighting, walk):
    splats, camera = random_splats(7, 2_000), random_camera(7, 200, 150)
    for observation in (random_regions(7, 4, 30, (75, 100)), random_grid(7, (10, 13))):
        runs = [CpuRaster(splats, threads=n).region_weights(camera, observation, walk, weighting) for n in (1, 2, 5)]
        for other in runs[1:]:
            for name, own in runs[0].tensors().items():
                assert torch.equal(own, getattr(other, name)), name


def test_images_and_traced_rays_are_whole_whatever_the_stride():
    splats, camera = random_splats(5, 300), random_camera(5, 61, 47)
    raster, walk = CpuRaster(splats), CompositingParams(stride=4, offset=(3, 1))
    assert torch.equal(raster.row_sums(camera, walk), raster.row_sums(camera, CompositingParams()))
    pixels = torch.tensor([[3, 1], [7, 5], [59, 45]], dtype=torch.int32)
    for asked in (pixels, torch.cat([pixels, torch.tensor([[0, 0]], dtype=torch.int32)])):
        got, full = (raster.ray_rows(camera, asked, own) for own in (walk, CompositingParams()))
        assert torch.equal(got.splats, full.splats)
        assert torch.allclose(got.weights, full.weights, atol=1e-6)


@pytest.mark.parametrize(
    ("weighting", "walk"),
    [
        (Weighting(3), CompositingParams()),
        (Weighting(1, Selection.TOP_K, count=0), CompositingParams()),
        (Weighting(1, Selection.TOP_K, count=65), CompositingParams()),
        (Weighting(1, Selection.FRONT_MASS, mass=0.0), CompositingParams()),
        (Weighting(floor=-1.0), CompositingParams()),
        (Weighting(floor=float("nan")), CompositingParams()),
        (ALL, CompositingParams(stride=0)),
        (ALL, CompositingParams(stride=2, offset=(2, 0))),
        (ALL, CompositingParams(stride=100, offset=(0, 40))),
    ],
)
def test_knobs_out_of_range_are_refused(weighting, walk):
    with pytest.raises(InvalidInput):
        CpuRaster(random_splats(0)).region_weights(random_camera(0), random_grid(0), walk, weighting)
