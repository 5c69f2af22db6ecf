"""Raster backends compared with the dense float64 reference: close inside, a counted band at the cut-offs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from liftcore.errors import InvalidInput, InvalidSettings
from liftcore.raster.base import ViewRequest
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import ReferenceRaster, dense_view, reading_matrix, selected_weights, strided_rays
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.scene.splats import Kernel, Splats
from liftcore.values.views import Regions, ViewFeatures
from tests.backends import Backend, every_backend
from tests.properties.oracle import dense, one_region_a_ray, pixels_of, same_bits
from tests.scenes import look_at, random_camera, random_grid, random_regions, random_splats, scenes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.scene.cameras import Camera

INSIDE = 1e-5  # absolute, on weights
FLIPS = 1e-2  # of rays: on tiny random images one ray in a hundred may fall on the other side of a cut-off
UNDECIDED = 0.03  # of rays too close to call in a weighting, which no comparison sees
GAIN = CompositingParams(opacity_logit_scale=1.2)
UNSCALED = (CompositingParams(), CompositingParams(alpha_cap=0.999, transmittance_stop=0.05))
PARAMS = (*UNSCALED, GAIN, CompositingParams(opacity_logit_scale=0.5))
SELECTIONS = (Weighting(1, top_k=1), Weighting(2, top_k=3), Weighting(1, top_k=2), Weighting(1, top_k=64))
POWERS = (Weighting(1), Weighting(2))
FOOTPRINTS = {str(kernel): (kernel, False) for kernel in Kernel} | {"3dgs antialiased": (Kernel.GAUSSIAN_3D, True)}

pytestmark = pytest.mark.usefixtures("every_kernel")
every_footprint = pytest.mark.parametrize("footprint", FOOTPRINTS)


def draw_case(
    data: st.DataObject,
    footprint: str,
    backend: Backend,
    choices: Sequence[CompositingParams] = PARAMS,
    *,
    strided: bool = False,
) -> tuple[Splats, Camera, ViewFeatures, CompositingParams]:
    """Draw a scene of the kernel, a view with its features, and parameters, with a stride if ``strided``."""
    kernel, antialiased = FOOTPRINTS[footprint]
    splats, camera, observation = data.draw(scenes(kernel, backend.splats, backend.size))
    params = replace(data.draw(st.sampled_from(choices)), antialiased=antialiased)
    if strided:
        stride = data.draw(st.integers(1, 5))
        left, top = (data.draw(st.integers(0, min(stride, side) - 1)) for side in (camera.width, camera.height))
        params = replace(params, stride=stride, offset=(left, top))
    return splats, camera, observation, params


def seeded(footprint: str, seed: int, count: int) -> tuple[Splats, CompositingParams]:
    """Return a random scene of the footprint, and its parameters."""
    kernel, antialiased = FOOTPRINTS[footprint]
    return random_splats(seed, count, kernel=kernel), CompositingParams(antialiased=antialiased)


@every_footprint
@every_backend
def test_renders_equal_the_oracle(footprint, backend):
    @backend.holds(st.data())
    def check(data) -> None:
        splats, camera, _, params = draw_case(data, footprint, backend)
        values = torch.tensor(np.random.default_rng(0).uniform(0, 1, (splats.count, 3)), dtype=torch.float32)
        view = dense_view(splats, camera, params)
        expected = (view.A @ values.double().numpy()).reshape(camera.height, camera.width, 3)
        error = np.abs(backend.open(splats).render(camera, values, params).numpy() - expected).max(axis=2)
        assert error.ravel()[~view.cut].max(initial=0) < INSIDE
        assert (error > INSIDE).mean() <= max(FLIPS, 1 / error.size)


@every_footprint
@every_backend
def test_splats_that_a_ray_meets_have_a_footprint(footprint, backend):
    @backend.holds(st.data())
    def check(data) -> None:
        splats, camera, _, params = draw_case(data, footprint, backend)
        areas, view = backend.open(splats).footprints(camera, params).numpy(), dense_view(splats, camera, params)
        assert (areas[(view.A[~view.cut] > 0).any(axis=0)] > 0).all()
        assert areas.dtype == np.float32 and areas.max(initial=0) <= camera.width * camera.height


@every_backend
def test_footprint_of_a_ball_is_as_large_as_the_pixels_that_it_holds(backend):
    splats, camera = random_splats(5, 30, spread=0.4), look_at("v", np.array([0.0, 0.3, -4.0]), 240, 200, 90.0)
    balls = splats.log_scales[:, :1].expand(-1, 3).contiguous()
    splats = replace(splats, means=0.2 * splats.means, log_scales=balls)
    pixels = ReferenceRaster(splats).footprints(camera, CompositingParams()).numpy()
    areas = backend.open(splats).footprints(camera, CompositingParams()).numpy()
    large = pixels > 200
    assert large.any() and np.allclose(areas[large], pixels[large], rtol=0.05)
    assert not areas[pixels == 0][areas[pixels == 0] > 20].size


@every_footprint
@every_backend
def test_region_weights_and_total_weight_equal_the_oracle(footprint, backend):
    @backend.holds(st.data(), st.sampled_from(POWERS))
    def check(data, weighting) -> None:
        # Weights of scaled opacities compile for 20 s a kernel, and their alphas are those of renders.
        choices = PARAMS if footprint == "3dgs" else UNSCALED
        splats, camera, observation, params = draw_case(data, footprint, backend, choices, strided=True)
        strided, raster = strided_rays(camera, params), backend.open(splats)
        weights = raster.region_weights(camera, observation, params, weighting)
        unscaled = dense_view(splats, camera, replace(params, opacity_logit_scale=1.0))
        if unscaled.cut.any():
            return
        total_weight = np.zeros(splats.count)
        total_weight[weights.total_weight_splats.numpy()] = weights.total_weight.numpy()
        expected = unscaled.A[strided].sum(axis=0)  # for any gain and power
        assert np.abs(total_weight - expected).max() < INSIDE * max(1.0, expected.max())
        view = dense_view(splats, camera, params)
        if view.cut.any():
            return
        S, ray = reading_matrix(observation, camera.width, camera.height)
        selected = selected_weights(view.A, splats, camera, weighting)[0]
        expected = selected[ray[strided[ray]]].T @ S[strided[ray]]
        W = dense(weights, splats.count, observation.codebook.shape[0])
        assert np.abs(W - expected).max(initial=0) < INSIDE * max(1.0, expected.max(initial=0))


@every_backend
def test_weights_that_count_equal_the_oracle_ray_by_ray(backend):
    @backend.holds(st.data(), st.sampled_from(SELECTIONS))
    def check(data, weighting) -> None:
        splats, camera, _, params = draw_case(data, "3dgs", backend, UNSCALED, strided=True)
        view, raster = dense_view(splats, camera, params), backend.open(splats)
        selected, close = selected_weights(view.A, splats, camera, weighting)
        weights = raster.region_weights(camera, one_region_a_ray(camera), params, weighting)
        W, strided = dense(weights, splats.count, camera.width * camera.height), strided_rays(camera, params)
        assert W[:, ~strided].max(initial=0) == 0
        assert np.abs(W.T - selected)[strided & ~view.cut & ~close].max(initial=0) < INSIDE


@pytest.mark.parametrize("weighting", SELECTIONS, ids=str)
def test_few_rays_are_too_close_to_call(weighting):
    undecided = []
    for seed in range(4):
        splats, camera = random_splats(seed, 60), random_camera(seed)
        view = dense_view(splats, camera, CompositingParams())
        undecided.append(selected_weights(view.A, splats, camera, weighting)[1] & ~view.cut)
    assert np.concatenate(undecided).mean() < UNDECIDED


def test_of_equal_weights_the_nearest_counts():
    """Behind an alpha of 1/4, an alpha of 1/3 also weighs 1/4; some float near log 1/2 makes both bitwise equal."""
    camera = random_camera(0, 9, 9).replace(cx=4.5, cy=4.5, fx=9.0, fy=9.0, viewmat=np.eye(4))
    means, scales = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 2.0]]), torch.ones(2, 3)  # the second is the nearer

    def on_the_axis(splats: Splats, weighting: Weighting) -> list[float]:
        weights = CpuRaster(splats).region_weights(camera, one_region_a_ray(camera), CompositingParams(), weighting)
        return dense(weights, 2, 81)[:, 4 * 9 + 4].tolist()

    ties = 0
    for step in range(-8, 9):
        behind = np.float32(np.log(0.5)) + step * np.spacing(np.float32(0.5))
        logits = torch.tensor([behind, np.log(1 / 3)], dtype=torch.float32)
        splats = replace(random_splats(0, 2), means=means, opacity_logits=logits, log_scales=scales)
        far, near = on_the_axis(splats, Weighting())
        if far == near:
            ties += 1
            assert on_the_axis(splats, Weighting(1, top_k=1)) == [0.0, near]
            assert np.count_nonzero(on_the_axis(splats, Weighting(1, top_k=2))) == 2
    assert ties > 0


@pytest.mark.parametrize("cells", [None, (1.1, 0.9), (4.0, 4.0), (0, 4.0), (0, 0)], ids=str)
@every_backend
def test_a_region_a_pixel_and_grids_of_any_fineness_are_weighed_as_the_oracle_weighs_them(cells, backend):
    # Cells a pixel, down and across. Four by four: each pixel reads four cells of its own.
    width, height = (18, 4) if backend.name == "gpu" and cells else (20, 18)
    camera, splats = random_camera(3, width, height), random_splats(3, 60)
    if cells is None:
        labels = one_region_a_ray(camera).labels
        observation = Regions(torch.cat([labels, labels // 200]), torch.ones(width * height, 1))
    else:
        down, across = (max(1, int(n * side)) for n, side in zip(cells, (height, width), strict=True))
        observation = random_grid(3, (down, across))
    view = dense_view(splats, camera, CompositingParams())
    S, ray = reading_matrix(observation, width, height)
    weights = backend.open(splats).region_weights(camera, observation, CompositingParams(), Weighting(2))
    W = dense(weights, splats.count, observation.codebook.shape[0])
    assert not view.cut.any() and W.max() > 0
    assert np.abs(W - (view.A**2)[ray].T @ S).max() < INSIDE


@every_footprint
@every_backend
def test_flips_at_the_cut_offs_are_rare_and_unbiased(footprint, backend):
    rays = flips = 0
    drift = 0.0
    for seed in range(backend.seeds):
        (splats, params), camera = seeded(footprint, seed, 80), random_camera(seed, 64, 48)
        expected = dense_view(splats, camera, params).A.sum(axis=1)
        error = backend.open(splats).render(camera, torch.ones(splats.count, 1), params).numpy().ravel() - expected
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
        splats, camera, _, params = draw_case(data, footprint, backend)
        view = dense_view(splats, camera, params)
        sample = np.arange(view.A.shape[0])[:: -(-view.A.shape[0] // backend.rays)]
        rows = backend.open(splats).ray_rows(camera, pixels_of(camera)[sample], params)
        A = np.zeros((len(sample), splats.count))
        A[np.repeat(np.arange(len(sample)), np.diff(rows.indptr)), rows.splats] = rows.weights
        assert np.abs(A - view.A[sample])[~view.cut[sample]].max(initial=0) < INSIDE


@every_backend
def test_strongest_labels_are_those_of_the_one_hot_render(backend):
    for seed in range(min(6, backend.seeds)):
        splats, camera = random_splats(seed, 80), random_camera(seed, *backend.size)
        labels = torch.tensor(np.random.default_rng(seed).integers(-1, 60, splats.count), dtype=torch.int32)
        view = dense_view(splats, camera, GAIN)
        sums = view.A @ np.eye(61)[labels.numpy() + 1]  # the one-hot render
        ranked = np.sort(sums, axis=1)
        clear = (ranked[:, -1] - ranked[:, -2] > 1e-4) & ~view.cut
        assert clear.mean() > 0.3
        for raster in (backend.open(splats), ReferenceRaster(splats)):
            actual = raster.strongest_labels(camera, labels, GAIN).numpy().ravel()
            assert np.array_equal(actual[clear], (sums.argmax(axis=1) - 1)[clear])
            assert (actual[view.A.sum(axis=1) == 0] == -1).all()


@pytest.mark.parametrize(("cap", "stop"), [(0.9, 0.1), (0.95, 0.0025), (0.999, 1e-6), (0.99, 1e-6), (0.99, 1e-4)])
def test_rays_end_at_the_same_splat_in_every_product(cap, stop):
    splats = replace(
        random_splats(0, 6),
        means=torch.tensor([[0.0, 0.0, 2.0 + 0.1 * k] for k in range(6)]),
        opacity_logits=torch.full((6,), 30.0),
        log_scales=torch.full((6, 3), 2.0),
    )
    camera = random_camera(0, 5, 5).replace(cx=2.5, cy=2.5, fx=5.0, fy=5.0, viewmat=np.eye(4))
    raster, params = CpuRaster(splats), CompositingParams(alpha_cap=cap, transmittance_stop=stop)
    image = raster.render(camera, torch.ones(6, 1), params)[..., 0]
    rows = raster.ray_rows(camera, pixels_of(camera), params)
    sums = [float(part.sum()) for part in rows.weights.split(rows.indptr.diff().tolist())]
    assert image.ravel().tolist() == pytest.approx(sums, rel=1e-6, abs=1e-7)


@every_backend
def test_views_walked_in_a_row_are_those_walked_alone_to_the_bit(backend):
    splats, params = seeded("3dgs", 7, 12)
    iterated, reference = backend.open(splats), backend.open(splats)
    pixels = (torch.tensor([[3, 4], [10, 11]], dtype=torch.int32), torch.empty(0, 2, dtype=torch.int32))
    gains = [replace(params, opacity_logit_scale=1.0 + k % 2 / 5) for k in range(3)]
    requests = [
        ViewRequest(random_camera(k, 14, 13), random_regions(k), gains[k], Weighting(), pixels[k % 2])
        for k in range(3)
    ]
    for request, answer in zip(requests, iterated.iterate_views(iter(requests)), strict=True):
        expected = reference.region_weights(request.camera, request.observation, request.params, Weighting())
        assert same_bits(answer.weights, expected)
        if len(request.pixels):
            assert same_bits(answer.rows, reference.ray_rows(request.camera, request.pixels, request.params))
        else:
            assert answer.rows.indptr.tolist() == [0]


def test_images_and_traced_rays_are_whole_whatever_the_stride():
    splats, camera = random_splats(5, 300), random_camera(5, 61, 47)
    raster, params = CpuRaster(splats), CompositingParams(stride=4, offset=(3, 1))
    assert torch.equal(raster.row_sums(camera, params), raster.row_sums(camera, CompositingParams()))
    pixels = torch.tensor([[3, 1], [7, 5], [59, 45]], dtype=torch.int32)
    got, full = (raster.ray_rows(camera, pixels, case_params) for case_params in (params, CompositingParams()))
    assert torch.equal(got.splats, full.splats)
    assert torch.allclose(got.weights, full.weights, atol=1e-6)


@every_backend
@pytest.mark.parametrize(
    ("name", "weighting", "params"),
    [
        ("power", Weighting(3), {}),
        ("top_k", Weighting(1, top_k=65), {}),
        ("stride", Weighting(), {"stride": 0}),
        ("offset", Weighting(), {"stride": 2, "offset": (2, 0)}),
        ("offset", Weighting(), {"stride": 100, "offset": (0, 40)}),
    ],
    ids=str,
)
def test_knobs_out_of_range_are_refused_by_name(backend, name, weighting, params):
    with pytest.raises(InvalidInput, match=f"^{name}: "):
        backend.open(random_splats(0)).region_weights(
            random_camera(0), random_grid(0), CompositingParams(**params), weighting
        )


@every_backend
def test_antialiasing_of_another_kernel_is_refused(backend):
    splats, camera = random_splats(0, 4, kernel=Kernel.GAUSSIAN_2D), random_camera(0)
    for candidate in (backend.open(splats), ReferenceRaster(splats)):
        with pytest.raises(InvalidSettings, match="3D Gaussians"):
            candidate.row_sums(camera, CompositingParams(antialiased=True))
