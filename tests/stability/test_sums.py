"""Sums of very many terms: of rays, of regions, of views, in the closed form and in a robust step."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from liftcore.features.views import Regions
from liftcore.raster.base import CompositingParams, Weighting
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import alphas
from liftcore.scene.cameras import Camera
from liftcore.scene.splats import Splats
from liftcore.solve.closed_form import solve
from liftcore.solve.codebook import Codebook, ViewCodebook
from liftcore.solve.reweight import agreement_factors
from liftcore.solve.weights import RegionWeights, one_view, stacked
from tests.scenes import splats_at

DIGITS, EQUAL = 1e-6, 5e-6  # relative; one rounding to float32 is 6e-8, and of equal terms all go one way
ROWS = 1_000  # of the codebook, which the entries read in turn


def sums_of_rays(side: int) -> dict[str, float]:
    """Relative errors of one faint splat's sums over an image of ``side`` squared, which it covers.

    Returns:
        by name: region weights, squared region weights, evidence, ``A^T 1``.
    """
    splats = splats_at([(0.0, 0.0, 2.0)], log_scales=[0.3, 0.1, 0.0], logits=-2.0)
    camera = Camera.pinhole("v0", side, side, 0.7 * side, 0.7 * side, side / 2, side / 2, np.eye(4))
    exact, squares = _exact_sums(splats, camera)
    raster, region = CpuRaster(splats), Regions(torch.zeros(1, 1, 1, dtype=torch.int32), torch.ones(1, 1))
    plain = raster.region_weights(camera, region, CompositingParams(), Weighting(1))
    squared = raster.region_weights(camera, region, CompositingParams(), Weighting(2))
    adjoint = raster.adjoint(camera, torch.ones(side, side, 1), CompositingParams())
    found = {
        "A^T S": float(plain.weight[0]) / exact,
        "A^T S, squared weights": float(squared.weight[0]) / squares,
        "evidence": float(plain.evidence[0]) / exact,
        "A^T Y": float(adjoint[0, 0]) / exact,
    }
    return {name: abs(ratio - 1) for name, ratio in found.items()}


def sums_of_entries(count: int, equal: bool) -> float:
    """Relative error of x of a splat that reads ``count`` codebook rows of one view, by weights equal or random."""
    return _solved([_entries(count, equal)], equal)


def sums_of_views(count: int, equal: bool) -> float:
    """The same of a splat that reads one row in each of ``count`` views."""
    whole = _entries(count, equal)
    one = torch.tensor([0, 1])
    views = [_row(whole.region[k : k + 1], whole.weight[k : k + 1], one) for k in range(count)]
    return _solved(views, equal)


def robust_sums(rows: int, channels: int) -> float:
    """Error of a splat's weights after one robust step, over the largest; it reads so many rows in each of two views.

    A row is one direction times -1 .. 2, and noise.
    """
    rng = np.random.default_rng(2)
    direction = rng.normal(0, 1, channels)
    amounts, noise = rng.uniform(-1, 2, (2, rows, 1)), rng.normal(0, 1, (2, rows, channels))
    books = (amounts * direction + noise).astype(np.float32)
    weights = rng.uniform(0, 1, (2, rows)).astype(np.float32)
    every, starts = torch.arange(rows, dtype=torch.int32), torch.tensor([0, rows])
    W = stacked([_row(every, torch.from_numpy(view), starts) for view in weights], 1)
    codebook = Codebook([ViewCodebook(torch.from_numpy(book)) for book in books])
    got = (W.weight * agreement_factors(W, codebook, 1).factors).numpy().reshape(2, rows)
    exact = _robust_step(weights.astype(np.float64), books.astype(np.float64))
    return float(np.abs(got - exact).max() / exact.max())


def added_one_by_one(count: int) -> float:
    """Relative error of ``count`` equal terms in a single float32 sum, which nothing here is: to compare with."""
    terms = np.full(count, 0.3, np.float32)
    return abs(float(np.cumsum(terms, dtype=np.float32)[-1]) / (count * float(terms[0])) - 1)


def _exact_sums(splats: Splats, camera: Camera) -> tuple[float, float]:
    """The sums of the one splat's alphas and of their squares, in float64, row by row of the image."""
    x = np.arange(camera.width) + 0.5
    total = squares = 0.0
    for y in x:
        alpha = alphas(splats, 0, camera, CompositingParams(), np.stack([x, np.full_like(x, y)], axis=1))[0]
        total += float(alpha.sum())
        squares += float((alpha * alpha).sum())
    return total, squares


def _entries(count: int, equal: bool) -> RegionWeights:
    rng = np.random.default_rng(0)
    values = np.full(count, 0.3) if equal else rng.uniform(0, 1, count)
    columns = torch.from_numpy((np.arange(count) % ROWS).astype(np.int32))
    return _row(columns, torch.from_numpy(values.astype(np.float32)), torch.tensor([0, count]))


def _row(columns: torch.Tensor, weights: torch.Tensor, starts: torch.Tensor) -> RegionWeights:
    first = torch.zeros(1, dtype=torch.int32)
    return one_view(first, starts, columns, weights, first, torch.ones(1), regions=int(columns.max()) + 1)


def _robust_step(W: np.ndarray, E: np.ndarray) -> np.ndarray:
    """W' [2, M] of one splat by the equation of `liftcore.solve.reweight`, from W [2, M] and E [2, M, F], in f64."""
    units = E / np.linalg.norm(E, axis=2, keepdims=True)
    away = units - np.einsum("vm,vmf->f", W, units) / W.sum()
    e = away / np.linalg.norm(away, axis=2, keepdims=True)
    others = np.einsum("vm,vmf->vf", W, e)[::-1]
    r = others / np.linalg.norm(others, axis=1, keepdims=True)
    cosines = np.maximum(np.einsum("vmf,vf->vm", e, r), 0)
    own = W.sum(axis=1, keepdims=True) / W.sum()
    new = W * ((1 - own) * cosines + own * (W * cosines).sum() / W.sum())
    return new * W.sum() / new.sum()


def _solved(views: list[RegionWeights], equal: bool) -> float:
    rng = np.random.default_rng(1)
    book = torch.tensor(np.full((ROWS, 1), 0.7) if equal else rng.uniform(-1, 2, (ROWS, 1)), dtype=torch.float32)
    views = [replace(view, offsets=torch.tensor([0, ROWS])) for view in views]
    total = sum(float(view.weight.double().sum()) for view in views)
    value = sum(float(view.weight.double() @ book[view.region.long(), 0].double()) for view in views)
    solved = solve(stacked(views, 1), Codebook([ViewCodebook(book)] * len(views)), torch.float32)
    return abs(float(solved.features[0, 0]) * total / value - 1)


def test_sums_over_a_million_rays_are_those_of_float64() -> None:
    assert max(sums_of_rays(1_000).values()) < DIGITS


@pytest.mark.parametrize(("equal", "bound"), [(True, EQUAL), (False, DIGITS)])
def test_many_regions_or_views_have_their_mean(equal: bool, bound: float) -> None:
    assert sums_of_entries(1_000_000, equal) < bound < added_one_by_one(1_000_000)
    assert sums_of_views(1_000, equal) < bound


@pytest.mark.parametrize(("rows", "channels"), [(20_000, 8), (8, 10_000)])
def test_a_robust_step_over_many_keeps_its_weights(rows: int, channels: int) -> None:
    assert robust_sums(rows, channels) < DIGITS
