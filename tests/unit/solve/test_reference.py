"""The reference L(x^) and the theorem ``L(x') <= (1 + beta) L(x^)``, where rows sum to one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from liftcore.io.scene_files import lift_files
from liftcore.progress import silent
from liftcore.raster.base import CompositingParams
from liftcore.scene.splats import Splats
from liftcore.settings import LARGEST_ALPHA, LiftSettings
from liftcore.solve.diagnostics import ViewMeasures, measure_rows, quantiles
from liftcore.solve.geometry import SampledRays, read_pixels, sample_pixels
from liftcore.solve.least_squares import reference, row_betas
from tests.scenes import look_at, random_splats, write_scene
from tests.unit.solve.dense_rays import SmallScene

SEEDS = st.integers(0, 2**16)
OPAQUE = CompositingParams(alpha_cap=LARGEST_ALPHA, transmittance_stop=0.0)
ALL_RAYS = 10_000


def before_a_wall(seed: int) -> Splats:
    """Random splats in front of one huge opaque splat, which takes what light is left."""
    scene = random_splats(seed, 25)
    wall = Splats(
        torch.tensor([[0.0, 0.0, -60.0]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 10.0),
        torch.tensor([40.0]),
    )
    return Splats(
        torch.cat([scene.means, wall.means]),
        torch.cat([scene.quats, wall.quats]),
        torch.cat([scene.log_scales, wall.log_scales]),
        torch.cat([scene.opacity_logits, wall.opacity_logits]),
    )


def walled_scene(seed: int, grids: bool) -> SmallScene:
    centres = [np.array([0.6 * k - 0.5, 0.3 * k, 4.0]) for k in range(3)]
    views = [look_at(f"v{k}", centre, 18 + k, 15 + k, 20.0) for k, centre in enumerate(centres)]
    return SmallScene(seed, grids, splats=before_a_wall(seed), walk=OPAQUE, views=views)


def found(scene: SmallScene, features: torch.Tensor, **chosen: int) -> dict:
    samples = []
    for number, (view, seen) in enumerate(zip(scene.views, scene.observations, strict=True)):
        pixels = sample_pixels(view, ALL_RAYS, (0, number), scene.walk)
        samples.append(SampledRays(scene.raster.ray_rows(view, pixels, scene.walk), read_pixels(seen, view, pixels)))
    knobs = LiftSettings.of(**{"reference_channels": 6, **chosen})
    return reference(scene.rays(), features, scene.seen, samples, scene.codebooks, knobs, silent)


def measures_of(A: np.ndarray, X: np.ndarray, B: np.ndarray) -> ViewMeasures:
    """The certificate's kernel on dense rows."""
    rows, splats = A.shape
    entries = np.tile(X.astype(np.float32), (rows, 1))
    starts = np.arange(rows + 1) * splats
    columns = measure_rows(np.arange(rows), starts, A.ravel(), entries, B.astype(np.float32)).T
    return ViewMeasures(A.sum(axis=1), *columns)


def closed_form(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    return A.T @ B / A.sum(axis=0)[:, None]


def loss(A: np.ndarray, X: np.ndarray, B: np.ndarray) -> float:
    return float(((A @ X - B) ** 2).sum())


@settings(max_examples=200, deadline=None)
@given(SEEDS, st.integers(1, 12), st.integers(1, 8), st.integers(1, 4), st.sampled_from([0.1, 1.0, 5.0]))
def test_the_bound_holds_for_every_matrix_whose_rows_sum_to_one(seed, more, splats, channels, peak):
    rng = np.random.default_rng(seed)
    A = rng.dirichlet(np.full(splats, peak), splats + more) + 1e-9
    A /= A.sum(axis=1, keepdims=True)
    B = rng.normal(size=(len(A), channels))
    best = np.linalg.lstsq(A, B, rcond=None)[0]
    beta = row_betas(measures_of(A, best, B)).max()
    assert np.isinf(beta) or loss(A, closed_form(A, B), B) <= (1 + beta) * loss(A, best, B) * (1 + 1e-3)


def test_a_row_that_is_met_exactly_has_no_finite_beta_unless_its_splats_agree():
    measures = ViewMeasures(np.ones(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 3.0]), np.zeros(3))
    assert row_betas(measures).tolist() == [0.0, np.inf, 2.0]
    assert quantiles(np.array([np.nan, 1.0, np.inf, 3.0, 2.0, np.inf])) == {"median": 3.0, "p99": None, "max": None}


@settings(max_examples=6, deadline=None)
@given(SEEDS, st.booleans())
def test_the_reference_bounds_every_closed_form_before_a_wall(seed, grids):
    scene = walled_scene(seed, grids)
    assert np.abs(scene.A.sum(axis=1) - 1).max() < 1e-5
    told = found(scene, scene.closed_form)
    assert told["ratio"] >= 1.0 - 1e-5
    for bound in (told["surrogate_bound"], told["bound"]):
        assert bound is None or told["ratio"] <= bound * (1 + 1e-4)


@pytest.mark.parametrize("grids", [False, True])
def test_the_reference_finds_the_least_squares_loss(grids):
    scene = SmallScene(3, grids)
    told = found(scene, scene.closed_form, reference_channels=512)  # wide, so that lengths are kept well
    least = scene.loss(np.linalg.lstsq(scene.A, scene.B, rcond=1e-12)[0])
    assert told["residual"] * len(scene.B) == pytest.approx(scene.loss(scene.closed_form), rel=0.1)
    assert told["optimum"] * len(scene.B) == pytest.approx(least, rel=0.1)
    assert told["ratio"] == pytest.approx(scene.loss(scene.closed_form) / least, rel=0.03)
    assert told["channels"] == 512
    assert told["converged"] and "not converged" not in told["message"]


def test_the_reference_of_the_optimum_is_itself():
    scene = SmallScene(4)
    best = torch.tensor(np.linalg.lstsq(scene.A, scene.B, rcond=1e-9)[0], dtype=torch.float32)
    assert found(scene, best)["ratio"] == pytest.approx(1.0, abs=1e-3)


def test_the_certificate_shows_the_reference_only_when_asked(tmp_path):
    paths = write_scene(tmp_path, 9)
    plain = lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of(preset="row-sum")).metadata.certificate
    assert "reference" not in plain
    asked = LiftSettings.of(preset="row-sum", reference_channels=3)
    told = lift_files(paths[0], paths[1], [paths[2]], asked).metadata.certificate["reference"]
    assert told["ratio"] >= 1.0
    assert told["beta"]["max"] + 1 == told["bound"]
    assert f"{told['ratio']:.3f}" in told["message"]
    again = lift_files(paths[0], paths[1], [paths[2]], asked).metadata.certificate["reference"]
    assert told == again
