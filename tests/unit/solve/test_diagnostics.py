"""The diagnostics against the definitions of the paper, on all rays of small scenes."""

from __future__ import annotations

import numpy as np
import pytest

from liftcore.io.cameras import read_cameras
from liftcore.lifting.files import lift_files
from liftcore.raster.reference import dense_view, reading_matrix
from liftcore.scene.compositing import CompositingParams
from liftcore.values.settings import LiftSettings
from tests.scenes import observed, random_splats, write_scene

pytestmark = pytest.mark.slow

ALL_RAYS = 1_000_000


def dense_measures(X: np.ndarray, seed: int, cameras, gain: float, grids: bool) -> dict[str, float]:
    """Row sums, L, J and beta over every labelled row of every view, in float64."""
    sums, residuals, surrogates, betas = [], [], [], []
    for k, camera in enumerate(cameras.values()):
        observation = observed(seed, k, grids)
        S, ray = reading_matrix(observation, camera.width, camera.height)
        B = S @ observation.codebook.double().numpy()
        A = dense_view(random_splats(seed, 50), camera, CompositingParams(gain)).A
        sums.append(A.sum(axis=1))
        rows = A[ray]
        squares = ((X[None] - B[:, None]) ** 2).sum(axis=2)
        residuals.append(((rows @ X - B) ** 2).sum(axis=1))
        surrogates.append((rows * squares).sum(axis=1))
        total = rows.sum(axis=1)
        hit = total > 0
        share = rows[hit] / total[hit, None]
        mu = (share * np.sqrt(squares[hit])).sum(axis=1)
        betas.append((share * squares[hit]).sum(axis=1) / mu**2 - 1)
    row_sums = np.concatenate(sums)
    return {
        "row_sum_mean": row_sums.mean(),
        "row_sum_std": row_sums.std(),
        "residual": np.concatenate(residuals).mean(),
        "surrogate": np.concatenate(surrogates).mean(),
        "bound": 1 + np.concatenate(betas).max(),
        "median": np.median(np.concatenate(betas)),
        "p99": np.quantile(np.concatenate(betas), 0.99),
    }


@pytest.mark.parametrize("grids", [False, True])
@pytest.mark.parametrize("preset", ["row-sum", "tikhonov"])
def test_diagnostics_over_all_rays_equals_the_papers_definitions(tmp_path, preset, grids):
    paths = write_scene(tmp_path, 3, grids)
    settings = LiftSettings.of(preset=preset, diagnostic_rays=ALL_RAYS, dtype="float32")
    result = lift_files(paths[0], paths[1], [paths[2]], settings)
    expected = dense_measures(result.features.double().numpy(), 3, read_cameras(paths[1]), settings.gain, grids)
    diagnostics = result.metadata.diagnostics | result.metadata.diagnostics["beta"]
    for name, value in expected.items():
        assert diagnostics[name] == pytest.approx(value, rel=1e-3, abs=1e-6), name


def test_a_lift_without_sampled_rays_says_that_nothing_was_measured(tmp_path):
    paths = write_scene(tmp_path, 5)
    diagnostics = lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of(diagnostic_rays=0)).metadata.diagnostics
    assert diagnostics["rays"] == 0
    assert diagnostics["residual"] is None
    assert diagnostics["bound"] is None
    assert 0 < diagnostics["feature_share"] <= 1
