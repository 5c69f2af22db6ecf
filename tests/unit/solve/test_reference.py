"""The reference L(x^) and the theorem ``L(x') <= (1 + beta) L(x^)``, where rows sum to one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.lifting.files import lift_files
from liftcore.runtime.progress import silent
from liftcore.solve.diagnostics import ViewMeasures, quantiles
from liftcore.solve.optimum import compare_with_optimum, row_betas
from liftcore.solve.rays import SampledRays, read_pixels, sample_pixels
from liftcore.values.settings import LiftSettings
from tests.scenes import write_scene
from tests.unit.solve.dense_rays import SmallScene

ALL_RAYS = 10_000


def reference_facts(scene: SmallScene, features: torch.Tensor, **overrides: int) -> dict:
    samples = []
    for number, (view, observation) in enumerate(zip(scene.views, scene.observations, strict=True)):
        pixels = sample_pixels(view, ALL_RAYS, (0, number), scene.params)
        samples.append(
            SampledRays(scene.raster.ray_rows(view, pixels, scene.params), read_pixels(observation, view, pixels))
        )
    knobs = LiftSettings.of(**{"reference_channels": 6, **overrides})
    views = [(view, observed, scene.params) for view, observed in zip(scene.views, scene.observations, strict=True)]
    return compare_with_optimum(
        scene.raster, views, features, scene.has_weight, samples, scene.codebooks, knobs, silent
    )


def closed_form(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    return A.T @ B / A.sum(axis=0)[:, None]


def loss(A: np.ndarray, X: np.ndarray, B: np.ndarray) -> float:
    return float(((A @ X - B) ** 2).sum())


def test_a_row_that_is_met_exactly_has_no_finite_beta_unless_its_splats_agree():
    measures = ViewMeasures(np.ones(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 3.0]), np.zeros(3))
    assert row_betas(measures).tolist() == [0.0, np.inf, 2.0]
    assert quantiles(np.array([np.nan, 1.0, np.inf, 3.0, 2.0, np.inf])) == {"median": 3.0, "p99": None, "max": None}


@pytest.mark.parametrize("grids", [False, True])
def test_the_reference_finds_the_least_squares_loss(grids):
    scene = SmallScene(3, grids)
    facts = reference_facts(scene, scene.closed_form, reference_channels=512)  # wide, so that lengths are kept well
    least = scene.loss(np.linalg.lstsq(scene.A, scene.B, rcond=1e-12)[0])
    assert facts["residual"] * len(scene.B) == pytest.approx(scene.loss(scene.closed_form), rel=0.1)
    assert facts["optimum"] * len(scene.B) == pytest.approx(least, rel=0.1)
    assert facts["ratio"] == pytest.approx(scene.loss(scene.closed_form) / least, rel=0.03)
    assert facts["channels"] == 512
    assert facts["converged"] and "not converged" not in facts["message"]


def test_diagnostics_show_the_reference_only_when_asked(tmp_path):
    paths = write_scene(tmp_path, 9)
    baseline = lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of(preset="row-sum")).metadata.diagnostics
    assert "reference" not in baseline
    settings = LiftSettings.of(preset="row-sum", reference_channels=3)
    facts = lift_files(paths[0], paths[1], [paths[2]], settings).metadata.diagnostics["reference"]
    assert facts["ratio"] >= 1.0
    assert facts["beta"]["max"] + 1 == facts["bound"]
    assert f"{facts['ratio']:.3f}" in facts["message"]
    second = lift_files(paths[0], paths[1], [paths[2]], settings).metadata.diagnostics["reference"]
    assert facts == second
