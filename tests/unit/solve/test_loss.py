"""Huber's loss on region weights against its definition in float64, and from the setting to the features."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

import liftcore as lc
from liftcore.io.cameras import read_cameras
from liftcore.io.splats import read_splats
from liftcore.solve.loss import STEPS, huber_factors
from liftcore.values.region_weights import stacked
from tests.scenes import observed, write_scene
from tests.unit.solve.sparse_views import codebook_of, dense, random_view


def reweighted_steps(W: np.ndarray, E: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray, float]:
    """The factors [P, M], X [P, F] of their closed form, and delta."""

    def closed_form(factors: np.ndarray) -> np.ndarray:
        shares = W * factors
        return shares @ E / np.maximum(shares.sum(axis=1, keepdims=True), 1e-300)

    factors, delta = np.ones_like(W), 0.0
    for step in range(steps):
        distances = np.linalg.norm(closed_form(factors)[:, None] - E[None], axis=2)
        delta = delta if step else float((W * distances).sum() / W.sum())
        factors = np.minimum(1.0, delta / np.maximum(distances, 1e-300))
    return factors, closed_form(factors), delta


def loss(x: np.ndarray, weights: np.ndarray, E: np.ndarray, delta: float) -> float:
    d = np.linalg.norm(x - E, axis=1)
    return float(weights @ np.where(d <= delta, d**2 / 2, delta * (d - delta / 2)))


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e15])
def test_huber_factors_equal_their_definition_at_any_length(size, monkeypatch):
    rng, views = np.random.default_rng(3), [random_view(seed, 7, 60) for seed in range(5)]
    books = [torch.tensor(rng.standard_t(2, (7, 150)) * size, dtype=torch.float32) for _ in views]
    W, E = stacked(views, 60), torch.cat(books).double().numpy()
    expected = reweighted_steps(dense(W, 60), E / size, STEPS)[0][dense(W, 60) > 0]
    assert expected.min() < 0.6 and expected.max() == 1.0
    factors = huber_factors(W, codebook_of(books), threads=1)
    np.testing.assert_allclose(factors.numpy(), expected, rtol=2e-5)
    assert torch.equal(factors, huber_factors(W, codebook_of(books), means=torch.rand(60, 3), threads=3))
    monkeypatch.setattr("liftcore.solve.codebook.TABLE_BYTES", 1)
    np.testing.assert_allclose(huber_factors(W, codebook_of(books)).numpy(), expected, rtol=2e-5)


@pytest.mark.parametrize("grids", [False, True])
def test_a_huber_lift_is_nearest_by_hubers_loss(tmp_path, grids):
    paths = write_scene(tmp_path, 3, grids)
    splats, cameras = read_splats(paths[0]), read_cameras(paths[1])
    views = {name: observed(3, k, grids) for k, name in enumerate(cameras)}
    W = dense(lc.region_weights(splats, cameras, views, preset="row-sum"), splats.count)
    E = np.concatenate([view.codebook.double().numpy() for view in views.values()])
    X, delta = reweighted_steps(W, E, STEPS)[1:]
    options = {"cameras": cameras, "views": views, "preset": "row-sum"}
    lifted, squares = (lc.lift(splats, **options, dtype="float32", loss=name) for name in ("huber", "l2"))
    np.testing.assert_allclose(lifted.features.numpy(), X, atol=1e-5)
    assert torch.equal(lifted.total_weight, squares.total_weight)
    for splat in np.flatnonzero(lifted.has_feature.numpy())[::5]:
        shares = W[splat] / W[splat].sum()
        least = minimize(loss, squares.features[splat].double().numpy(), (shares, E, delta), tol=1e-12).fun
        before, after = (loss(lift.features[splat].double().numpy(), shares, E, delta) for lift in (squares, lifted))
        assert least - 1e-6 <= after <= before + 1e-6
        assert after - least <= 0.05 * (before - least) + 1e-6
