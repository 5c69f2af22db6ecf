"""A lift is its definition: ``X = D^-1 A^T B`` of the weights that `liftcore.render` composites, in float64."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import liftcore as lc
import numpy as np
import pytest

from tests.promises.scenes import CHANNELS, HEIGHT, KERNELS, WIDTH, RandomScene, random_scene

GAIN = 1.2  # on opacity logits, of Tikhonov guidance


def weights_of(scene: RandomScene, name: str, gain: float = 1.0, antialiased: bool = False) -> np.ndarray:
    """Return A [H W, P] of a view: renders of one splat each."""
    params = lc.CompositingParams(gain, antialiased=antialiased)
    image = lc.render(scene.splats, scene.cameras[name], np.eye(scene.splats.count, dtype=np.float32), params)
    assert not isinstance(image, dict)
    return image.double().numpy().reshape(-1, scene.splats.count)


def read_grid(grid: np.ndarray) -> np.ndarray:
    """Return what each pixel reads of a map [h, w, F]: four cells by distance, and the edge's beyond the edge."""
    h, w, _ = grid.shape
    y = np.clip((np.arange(HEIGHT) + 0.5) * h / HEIGHT - 0.5, 0, h - 1)
    x = np.clip((np.arange(WIDTH) + 0.5) * w / WIDTH - 0.5, 0, w - 1)
    top, left = np.floor(y).astype(int), np.floor(x).astype(int)
    low, right = np.minimum(top + 1, h - 1), np.minimum(left + 1, w - 1)
    dy, dx = (y - top)[:, None, None], (x - left)[None, :, None]
    upper = grid[top][:, left] * (1 - dx) + grid[top][:, right] * dx
    lower = grid[low][:, left] * (1 - dx) + grid[low][:, right] * dx
    return (upper * (1 - dy) + lower * dy).reshape(-1, grid.shape[2])


SETTINGS: dict[str, dict[str, Any]] = {
    "row-sum": {"preset": "row-sum"},
    "tikhonov": {"preset": "tikhonov"},
    "antialiased": {"preset": "tikhonov", "antialiased": True},
    "argmax": {"preset": "argmax"},
    "top-k": {"preset": "top-k", "top_k": 3},
}


def rows_of(view: lc.Regions | lc.FeatureGrid, A: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the rows of A and B of a view: of a grid once, of regions for each level where it has a label."""
    if isinstance(view, lc.FeatureGrid):
        yield A, read_grid(view.grid.double().numpy())
        return
    for labels in view.labels.numpy().reshape(len(view.labels), -1):
        yield A[labels >= 0], view.codebook.double().numpy()[labels[labels >= 0]]


def dense_lift(scene: RandomScene, name_of_settings: str) -> tuple[np.ndarray, np.ndarray]:
    """Return X [P, F] and the weights D [P] that it is divided by, in float64."""
    count, settings = scene.splats.count, SETTINGS[name_of_settings]
    sums, D = np.zeros((count, CHANNELS)), np.zeros(count)
    for name, view in scene.views.items():
        is_squared = settings["preset"] == "tikhonov"
        A = weights_of(scene, name, GAIN if is_squared else 1.0, settings.get("antialiased", False))
        if is_squared:
            A = A**2
        if largest := {"argmax": 1, "top-k": 3}.get(settings["preset"]):
            A = np.where(np.sort(A, axis=1)[:, -largest, None] <= A, A, 0)
        for rows, targets in rows_of(view, A):
            sums += rows.T @ targets
            D += rows.sum(axis=0)
    return np.divide(sums, D[:, None], out=np.zeros_like(sums), where=D[:, None] > 0), D


@pytest.mark.parametrize("grids", [False, True])
@pytest.mark.parametrize(
    ("name", "kernel"), [*((name, "3dgs") for name in SETTINGS), *(("row-sum", kernel) for kernel in KERNELS[1:])]
)
def test_lift_equals_its_dense_definition(name: str, kernel: str, grids: bool) -> None:
    scene = random_scene(11, count=60, grids=grids, kernel=kernel, wrong=0.3 if kernel == "3dgs" else 0.0)
    for view in scene.views.values():  # the few tuples of labels of clean masks are lifted in place of rows
        if isinstance(view, lc.Regions):
            view.labels[1, : HEIGHT // 3] = -1
    X, D = dense_lift(scene, name)
    result = lc.lift(*scene.arguments(), **SETTINGS[name], progress=False)
    clear = D > 1e-4
    assert clear.sum() > (10 if name == "argmax" else 30)
    error = np.linalg.norm(result.features.double().numpy() - X, axis=1)[clear]
    assert (error / np.linalg.norm(X, axis=1)[clear]).max() < 1e-3
    assert result.has_feature.numpy()[clear].all()
    antialiased = name == "antialiased"
    total = sum(weights_of(scene, view, antialiased=antialiased).sum(axis=0) for view in scene.views)
    np.testing.assert_allclose(result.total_weight.numpy(), total, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("grids", [False, True])
@pytest.mark.parametrize(("preset", "gain"), [("row-sum", 1.0), ("tikhonov", GAIN)])
def test_diagnostics_over_all_rays_are_the_papers_definitions(preset: str, gain: float, grids: bool) -> None:
    scene, sums = random_scene(11, count=60, grids=grids), list[np.ndarray]()
    residuals, surrogates, betas = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    settings: dict[str, Any] = {"preset": preset, "dtype": "float32", "progress": False}
    result = lc.lift(*scene.arguments(), diagnostic_rays=1_000_000, **settings)
    X = result.features.double().numpy()
    for name, view in scene.views.items():
        sums.append(weights_of(scene, name, gain).sum(axis=1))
        for A, B in rows_of(view, weights_of(scene, name, gain)):
            squares = np.square(X[None] - B[:, None]).sum(axis=2)
            residuals.append(np.square(A @ X - B).sum(axis=1))
            surrogates.append((A * squares).sum(axis=1))
            hit = A.sum(axis=1) > 0
            share = A[hit] / A[hit].sum(axis=1, keepdims=True)
            mu = (share * np.sqrt(squares[hit])).sum(axis=1)
            betas.append((share * squares[hit]).sum(axis=1) / mu**2 - 1)
    row_sums, beta = np.concatenate(sums), np.concatenate(betas)
    expected = {
        "row_sum_mean": row_sums.mean(), "row_sum_std": row_sums.std(), "residual": np.concatenate(residuals).mean(),
        "surrogate": np.concatenate(surrogates).mean(), "bound": 1 + beta.max(), "median": np.median(beta),
        "p99": np.quantile(beta, 0.99),
    }  # fmt: skip
    figures = result.diagnostics | result.diagnostics["beta"]
    for name, value in expected.items():
        assert figures[name] == pytest.approx(value, rel=2e-3, abs=1e-6), name
    unmeasured = lc.lift(*scene.arguments(), diagnostic_rays=0, **settings).diagnostics
    assert (unmeasured["rays"], unmeasured["residual"], unmeasured["bound"]) == (0, None, None)


@pytest.mark.parametrize("grids", [False, True])
def test_reference_is_the_least_loss_that_any_features_have(grids: bool) -> None:
    scene = random_scene(11, count=25, views=3, grids=grids)
    parts = [part for name, view in scene.views.items() for part in rows_of(view, weights_of(scene, name))]
    A, B = (np.concatenate(part) for part in zip(*parts, strict=True))
    settings: dict[str, Any] = {"preset": "row-sum", "dtype": "float32", "reference_channels": 512}
    result = lc.lift(*scene.arguments(), **settings, progress=False)
    facts, least = result.diagnostics["reference"], np.linalg.lstsq(A, B, rcond=1e-12)[0]
    own_loss, least_loss = (float(np.square(A @ X - B).sum()) for X in (result.features.double().numpy(), least))
    assert facts["ratio"] == pytest.approx(own_loss / least_loss, rel=0.03) and facts["converged"]
    assert facts["optimum"] * len(B) == pytest.approx(least_loss, rel=0.1)
    assert facts["bound"] == 1 + facts["beta"]["max"]
    assert "reference" not in lc.lift(*scene.arguments(), preset="row-sum", progress=False).diagnostics


def test_a_lift_of_every_third_pixel_speaks_for_all_of_them() -> None:
    scene = random_scene(11, count=60)
    full, strided = (lc.lift(*scene.arguments(), preset="row-sum", stride=n, progress=False) for n in (1, 3))
    assert strided.diagnostics["rays"] < full.diagnostics["rays"] / 7
    assert float(strided.total_weight.sum() / full.total_weight.sum()) == pytest.approx(1, abs=0.05)
    assert agreement(strided, full) > 0.9


@pytest.mark.parametrize("settings", [{"preset": "row-sum"}, {"preset": "tikhonov"}], ids=str)
def test_region_weights_times_codebooks_are_the_lift(settings: dict[str, Any]) -> None:
    scene = random_scene(wrong=0.3)
    weights = lc.region_weights(*scene.arguments(), progress=False, **settings)
    W = weights.matrix(scene.splats.count)
    E = np.concatenate([scene.views[name].codebook.double().numpy() for name in weights.views])
    result = lc.lift(*scene.arguments(), dtype="float32", progress=False, **settings)
    sums = W.sum(axis=1)
    has_feature = result.has_feature.numpy() & (sums > 1e-6)
    assert has_feature.sum() > 100
    expected = (W @ E)[has_feature] / sums[has_feature, None]
    np.testing.assert_allclose(result.features.numpy()[has_feature], expected, rtol=1e-4, atol=1e-5)


def agreement(result: lc.LiftResult, truth: lc.LiftResult) -> float:
    """Return the mean cosine of features to those of correct masks."""
    a, b = result.features.double().numpy(), truth.features.double().numpy()
    rows = (np.linalg.norm(a, axis=1) > 0) & (np.linalg.norm(b, axis=1) > 0)
    cosines = (a * b).sum(axis=1)[rows] / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))[rows]
    return float(cosines.mean())


def test_masks_of_other_views_weigh_where_vectors_are_too_noisy() -> None:
    """A third of the masks cover all, and vectors are mostly noise: what views keep together still tells halves."""
    scene, rng = random_scene(13, views=9, wrong=0.0), np.random.default_rng(13)
    clean = np.eye(6, CHANNELS, dtype=np.float32)
    views, wrong = {}, {}
    for number, (name, view) in enumerate(scene.views.items()):
        assert isinstance(view, lc.Regions)
        halves = view.labels[:1].clamp(max=1)
        book = (clean + rng.normal(0, 1.5 / np.sqrt(CHANNELS), clean.shape)).astype(np.float32)
        views[name] = lc.Regions(halves, clean)
        wrong[name] = lc.Regions(halves if number % 3 else halves * 0 + number % 2, book)
    truth = lc.lift(scene.splats, scene.cameras, views, preset="row-sum", progress=False)
    expected_rows = lc.lift(scene.splats, scene.cameras, wrong, preset="row-sum", progress=False)
    robust = lc.lift(scene.splats, scene.cameras, wrong, progress=False)
    # 0.80 and 0.86; 0.84 by vectors alone, without the masks.
    assert agreement(expected_rows, truth) < 0.82 and agreement(robust, truth) > 0.852


def test_splats_of_a_cluster_take_its_feature_or_keep_their_own() -> None:
    """The published aggregation: a cluster without a region that overlaps it enough changes nothing."""
    scene = random_scene(19, count=300, views=6, wrong=0.0)
    settings: dict[str, Any] = {"preset": "row-sum", "dtype": "float32", "progress": False}
    expected_rows = lc.lift(*scene.arguments(), **settings).features.numpy()
    result = lc.lift(*scene.arguments(), aggregation=True, aggregation_cluster_size=5, **settings)
    assert result.cluster is not None and result.cluster_features is not None
    cluster, features, means = (x.float().numpy() for x in (result.cluster, result.features, result.cluster_features))
    changes = 0
    for number, mean in enumerate(means):
        rows = cluster == number
        assert rows.sum() >= 5
        takes = np.allclose(features[rows], mean, atol=1e-3)
        assert takes or np.array_equal(features[rows], expected_rows[rows])
        changes += int(takes)
    assert changes >= 2
    np.testing.assert_array_equal(features[cluster < 0], expected_rows[cluster < 0])
    strict = lc.lift(*scene.arguments(), aggregation=True, aggregation_cluster_size=5, aggregation_iou=1, **settings)
    np.testing.assert_array_equal(strict.features.numpy(), expected_rows, "no silhouette is a region to the pixel")
