"""Checks of a raster against the dense float64 reference (`liftcore.raster.reference`)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.raster.base import ViewRequest
from liftcore.raster.reference import dense_view, reading_matrix, selected_weights, strided_rays
from liftcore.scene.compositing import CompositingParams, Weighting
from liftcore.values.views import Regions
from tests.scenes import random_camera, random_regions

if TYPE_CHECKING:
    from torch import Tensor

    from liftcore.raster.base import Raster, RayRows
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats
    from liftcore.values.region_weights import RegionWeights
    from liftcore.values.views import ViewFeatures

INSIDE = 1e-5  # absolute, on weights
FLIPS = 1e-2  # of rays: on tiny random images one ray in a hundred may fall on the other side of a cut-off


def check_render(raster: Raster, splats: Splats, camera: Camera, params: CompositingParams) -> None:
    """Compare a render of three channels with ``A X``: within INSIDE except for few rays at a cut-off."""
    values = torch.tensor(np.random.default_rng(0).uniform(0, 1, (splats.count, 3)), dtype=torch.float32)
    view = dense_view(splats, camera, params)
    expected = (view.A @ values.double().numpy()).reshape(camera.height, camera.width, 3)
    image = raster.render(camera, values, params).numpy()
    inside = ~view.cut.reshape(camera.height, camera.width)
    assert np.abs(image - expected)[inside].max(initial=0) < INSIDE
    assert (np.abs(image - expected).max(axis=2) > INSIDE).mean() <= max(FLIPS, 1 / inside.size)


def check_footprints(raster: Raster, splats: Splats, camera: Camera, params: CompositingParams) -> None:
    """Check that splats hit by a ray have an area, and that no area exceeds the image."""
    areas = raster.footprints(camera, params).numpy()
    view = dense_view(splats, camera, params)
    hit = (view.A[~view.cut] > 0).any(axis=0)
    assert (areas[hit] > 0).all()
    assert areas.dtype == np.float32 and areas.max(initial=0) <= camera.width * camera.height


def check_region_weights(
    raster: Raster,
    splats: Splats,
    camera: Camera,
    observation: ViewFeatures,
    params: CompositingParams,
    weighting: Weighting,
) -> None:
    """Compare W and the total weight of a view with the reference, in views without a ray at a cut-off.

    Args:
        weighting: a power of all weights.
    """
    strided = strided_rays(camera, params)
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


def check_selected_weights(
    raster: Raster, splats: Splats, camera: Camera, params: CompositingParams, weighting: Weighting
) -> None:
    """Compare the selected weights with the reference ray by ray, except for ambiguous rays."""
    view = dense_view(splats, camera, params)
    selected, close = selected_weights(view.A, splats, camera, weighting)
    weights = raster.region_weights(camera, one_region_a_ray(camera), params, weighting)
    W = dense(weights, splats.count, camera.width * camera.height)
    strided = strided_rays(camera, params)
    assert W[:, ~strided].max(initial=0) == 0
    assert np.abs(W.T - selected)[strided & ~view.cut & ~close].max(initial=0) < INSIDE


def check_ray_rows(
    raster: Raster, splats: Splats, camera: Camera, params: CompositingParams, limit: int = 2_000
) -> None:
    """Compare rows of A, of at most ``limit`` rays, with the reference."""
    view = dense_view(splats, camera, params)
    sample = np.arange(view.A.shape[0])[:: -(-view.A.shape[0] // limit)]
    rows = raster.ray_rows(camera, pixels_of(camera)[sample], params)
    A = np.zeros((len(sample), splats.count))
    A[np.repeat(np.arange(len(sample)), np.diff(rows.indptr.numpy())), rows.splats.numpy()] = rows.weights.numpy()
    assert np.abs(A - view.A[sample])[~view.cut[sample]].max(initial=0) < INSIDE


def check_strongest_labels(raster: Raster, splats: Splats, camera: Camera, params: CompositingParams) -> float:
    """Compare labels with the largest channel of the one-hot render; return the share of unambiguous rays."""
    seed = splats.count + camera.width
    labels = torch.tensor(np.random.default_rng(seed).integers(-1, 60, splats.count), dtype=torch.int32)
    view = dense_view(splats, camera, params)
    sums = view.A @ np.eye(61)[labels.numpy() + 1]
    ranked = np.sort(sums, axis=1)
    clear = (ranked[:, -1] - ranked[:, -2] > 1e-4) & ~view.cut
    actual = raster.strongest_labels(camera, labels, params).numpy().ravel()
    assert np.array_equal(actual[clear], (sums.argmax(axis=1) - 1)[clear])
    assert (actual[view.A.sum(axis=1) == 0] == -1).all()
    return float(clear.mean())


def check_iterated_views(iterated: Raster, reference: Raster, params: CompositingParams) -> None:
    """Check that iterated views are bitwise identical to single ones.

    Args:
        iterated: the raster. reference: another raster of the same splats.
    """
    pixels = (torch.tensor([[3, 4], [10, 11]], dtype=torch.int32), torch.empty(0, 2, dtype=torch.int32))
    gains = [replace(params, opacity_logit_scale=1.0 + k % 2 / 5) for k in range(3)]
    requests = [
        ViewRequest(random_camera(k, 14, 13), random_regions(k), gains[k], Weighting(), pixels[k % 2])
        for k in range(3)
    ]
    answers = list(iterated.iterate_views(iter(requests)))
    assert len(answers) == len(requests)
    for request, answer in zip(requests, answers, strict=True):
        expected = reference.region_weights(request.camera, request.observation, request.params, Weighting())
        assert same_bits(answer.weights, expected)
        if len(request.pixels):
            assert same_bits(answer.rows, reference.ray_rows(request.camera, request.pixels, request.params))
        else:
            assert answer.rows.indptr.tolist() == [0]


def dense(weights: RegionWeights, splats: int, regions: int) -> np.ndarray:
    """Return W as a dense matrix [P, M] f64."""
    W = np.zeros((splats, regions))
    lengths = np.diff(weights.indptr.numpy())
    W[np.repeat(weights.splats.numpy(), lengths), weights.region.numpy()] = weights.weight.numpy()
    return W


def one_region_a_ray(camera: Camera) -> Regions:
    """Return a region map with one region per pixel, so that W^T is A'."""
    rays = camera.width * camera.height
    labels = torch.arange(rays, dtype=torch.int32).reshape(1, camera.height, camera.width)
    return Regions(labels, torch.ones(rays, 1))


def pixels_of(camera: Camera) -> Tensor:
    """Return all pixels (x, y) of a camera, [H * W, 2] i32."""
    y, x = np.mgrid[: camera.height, : camera.width]
    return torch.tensor(np.stack([x.ravel(), y.ravel()], axis=1), dtype=torch.int32)


def same_bits(left: RegionWeights | RayRows, right: RegionWeights | RayRows) -> bool:
    """Return True if all tensors of both are bitwise identical."""
    parts = ([part for part in vars(of).values() if isinstance(part, torch.Tensor)] for of in (left, right))
    return all(map(torch.equal, *parts))
