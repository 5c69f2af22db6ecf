"""Conjugate gradients and damped least squares against dense solvers, on scenes small enough for both."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from liftcore.lifting.files import lift_files
from liftcore.runtime.progress import silent
from liftcore.solve.least_squares import (
    Refinement,
    Stopping,
    blocks,
    codebook_axes,
    column_dots,
    conjugate_gradients,
    refine,
)
from liftcore.values.settings import LiftSettings
from liftcore.values.views import Regions, ViewFeatures
from tests.scenes import write_scene
from tests.unit.solve.dense_rays import SmallScene

pytestmark = pytest.mark.slow

SEEDS = st.integers(0, 2**16)
few = settings(max_examples=6, deadline=None)


def system(kind: str, size: int = 12, channels: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """A symmetric matrix that is at least zero, and right sides in its range."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(size, size))
    if kind == "scaled":  # what a Jacobi preconditioner is for
        root *= np.logspace(-2, 2, size)
    if kind == "deficient":
        root[size // 2 :] = root[: size - size // 2]
    K = root.T @ root
    return K.astype(np.float32), (K @ rng.normal(size=(size, channels))).astype(np.float32)


def jacobi(K: np.ndarray) -> np.ndarray:
    return (1 / np.diag(K)).astype(np.float32)


@pytest.mark.parametrize("kind", ["plain", "scaled", "deficient"])
def test_the_system_is_solved(kind):
    K, right = system(kind)
    outcome = conjugate_gradients(lambda X: K @ X, right, jacobi(K), Stopping(200, 1e-5))
    assert outcome.converged.all()
    assert not outcome.broken.any()
    assert np.abs(K @ outcome.solution - right).max() < 1e-3 * np.abs(right).max()
    assert np.abs(outcome.rest - (right - K @ outcome.solution)).max() < 1e-3 * np.abs(right).max()


def test_every_channel_is_solved_as_if_it_were_alone():
    K, right = system("plain")
    joint = conjugate_gradients(lambda X: K @ X, right, jacobi(K), Stopping(6)).solution
    for channel in range(right.shape[1]):
        single = conjugate_gradients(lambda X: K @ X, right[:, [channel]], jacobi(K), Stopping(6)).solution
        assert np.allclose(single[:, 0], joint[:, channel], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("bad", [-1.0, np.nan])
def test_a_matrix_without_curvature_stops_and_says_so(bad):
    K, right = system("plain")
    with np.errstate(invalid="ignore", over="ignore"):
        outcome = conjugate_gradients(lambda X: X * np.float32(bad), right, jacobi(K), Stopping(20))
    assert outcome.broken.all()
    assert outcome.steps == 1
    assert np.isfinite(outcome.solution).all()


def test_inner_products_are_summed_in_float64():
    values = np.full((100_000, 2), 1e-3, np.float32)
    values[0] = 1e4
    assert np.allclose(column_dots(values, np.ones_like(values)), values.astype(np.float64).sum(axis=0), rtol=1e-12)


def refined(scene: SmallScene, dtype: torch.dtype = torch.float32, **overrides: float) -> Refinement:
    knobs = LiftSettings.of(**{"cg_steps": 200, "damping": 0.1, **overrides})
    features = scene.closed_form.clone().to(dtype)
    return refine(scene.rays(), features, scene.has_weight, scene.codebooks, knobs, silent)


def with_codebook(observation: ViewFeatures, codebook: torch.Tensor) -> Regions:
    assert isinstance(observation, Regions)
    return Regions(observation.labels, codebook)


@few
@given(SEEDS, st.booleans())
def test_the_operator_is_the_dense_one(seed, grids):
    scene = SmallScene(seed, grids)
    rays = scene.rays()
    X = np.random.default_rng(seed).normal(size=(scene.splats.count, 4)).astype(np.float32)
    scale = max(1.0, scene.row_sums.max())
    assert rays.rows == scene.A.shape[0]
    assert np.abs(rays.normal(X) - scene.A.T @ (scene.A @ X)).max() < 1e-4 * scale
    assert np.abs(rays.row_sums - scene.row_sums).max() < 1e-5 * scale
    assert np.abs(rays.diagonal - (scene.A**2).sum(axis=0)).max() < 1e-5 * scale
    (part,) = blocks(scene.B.shape[1])
    X0 = scene.closed_form.numpy()
    gradient, loss = rays.gradient(X0, part.project)
    assert np.abs(gradient - scene.A.T @ (scene.B - scene.A @ X0)).max() < 1e-4 * scale
    assert loss == pytest.approx(scene.loss(X0), rel=1e-4)


@few
@given(SEEDS, st.booleans(), st.sampled_from([0.03, 0.3, 1.0, 10.0]))
def test_damped_steps_end_at_the_damped_normal_equations(seed, grids, damping):
    scene = SmallScene(seed, grids)
    refinement = refined(scene, damping=damping)
    expected = scene.damped(damping)
    assert refinement.stats["result"] == "converged"
    assert np.abs(refinement.features.numpy() - expected).max() < 5e-3 * max(1.0, np.abs(expected).max())


@few
@given(SEEDS)
def test_undamped_steps_reach_the_least_squares_loss(seed):
    scene = SmallScene(seed)
    least = scene.loss(np.linalg.lstsq(scene.A, scene.B, rcond=1e-12)[0])
    refinement = refined(scene, damping=0.0, cg_steps=200)
    first = scene.loss(scene.closed_form)
    assert least - 1e-6 <= scene.loss(refinement.features) <= least + 2e-3 * first


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_the_reported_residuals_are_those_of_the_dense_matrix_and_fall(damping):
    scene = SmallScene(2)
    for steps in (1, 4, 9):
        refinement = refined(scene, damping=damping, cg_steps=steps)
        losses = np.array(refinement.stats["residuals"]) * len(scene.B)
        assert len(losses) == refinement.stats["steps"] + 1 <= steps + 1
        assert losses[0] == pytest.approx(scene.loss(scene.closed_form), rel=1e-4)
        assert losses[-1] == pytest.approx(scene.loss(refinement.features), rel=1e-3)
    if damping == 0:
        assert (np.diff(losses) <= 1e-6 * losses[0]).all()
    assert "steps" in refinement.stats["message"]
    assert str(damping) in refinement.stats["message"] or f"{damping:g}" in refinement.stats["message"]


def test_a_full_basis_gives_the_solution_of_all_channels():
    wide = SmallScene(3)
    rng = np.random.default_rng(0)
    mix = torch.tensor(rng.normal(size=(6, 40)), dtype=torch.float32)  # 40 channels of rank 6
    mixed_observations = [with_codebook(observation, observation.codebook @ mix) for observation in wide.observations]
    scene = SmallScene(3, observations=mixed_observations)
    full, reduced = refined(scene, damping=0.3), refined(scene, damping=0.3, cg_basis=6)
    assert reduced.stats["channels"] == 6
    assert full.stats["channels"] == 40
    assert torch.allclose(full.features, reduced.features, atol=2e-3)


def test_what_lies_outside_the_basis_is_kept():
    scene = SmallScene(4)
    axes = codebook_axes(scene.codebooks, 2)
    refinement = refined(scene, damping=0.1, cg_basis=2)
    step = refinement.features - scene.closed_form
    assert float(step.norm()) > 0.1
    assert torch.allclose(step @ axes @ axes.T, step, atol=1e-5)


def test_axes_hold_most_of_the_squares_and_repeat_to_the_bit():
    generator = torch.Generator().manual_seed(0)
    spread = torch.logspace(0, -3, 20)
    books = [torch.randn(50, 20, generator=generator) * spread for _ in range(3)]
    axes = codebook_axes(books, 4)
    exact = torch.linalg.svd(torch.cat(books), full_matrices=False).Vh[:4].T
    assert torch.allclose(axes.T @ axes, torch.eye(4), atol=1e-5)
    assert torch.allclose(axes @ axes.T, exact @ exact.T, atol=1e-3)
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    second_axes = codebook_axes(books, 4)
    torch.set_num_threads(threads)
    assert torch.equal(axes, second_axes)


def test_unseen_splats_stay_zero():
    scene = SmallScene(5)
    unseen_splat = np.flatnonzero(scene.has_weight)[0]
    scene.has_weight[unseen_splat] = False
    scene.closed_form[~torch.from_numpy(scene.has_weight)] = 0
    assert (refined(scene, damping=0.0).features[~torch.from_numpy(scene.has_weight)] == 0).all()


def test_float16_features_that_grow_too_large_become_float32():
    large = [with_codebook(observation, observation.codebook * 6e4) for observation in SmallScene(6).observations]
    scene = SmallScene(6, observations=large)
    refinement = refined(scene, torch.float16, damping=0.0)
    assert torch.isfinite(refinement.features).all()
    assert refinement.features.dtype == torch.float32


def test_all_that_was_seen_is_refined_however_faintly(tmp_path, monkeypatch):
    paths, calls = write_scene(tmp_path, 7), []
    monkeypatch.setattr(
        "liftcore.lifting.in_memory.refine", lambda *arguments: calls.append(arguments[2]) or refine(*arguments)
    )
    result = lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of(preset="row-sum", cg_steps=1))
    assert np.array_equal(calls[0], result.has_feature.numpy())
    assert (result.total_weight[result.has_feature] < 0.5).any()  # or it would say nothing of faint ones


def test_a_lift_takes_no_step_unless_asked(tmp_path):
    paths = write_scene(tmp_path, 8)
    stages = []

    def progress(stage: str, completed: int, total: int, unit: str) -> None:
        stages.append((stage, completed, total, unit))

    baseline = lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of(), progress=progress)
    assert "refinement" not in baseline.metadata.diagnostics
    assert not any(stage in ("refine", "rays") for stage, *_ in stages)
    steps = lift_files(paths[0], paths[1], [paths[2]], LiftSettings.of(cg_steps=3, damping=0.1), progress=progress)
    facts = steps.metadata.diagnostics["refinement"]
    assert [word for word in stages if word[0] == "refine"][-1] == ("refine", 3, 3, "steps")
    assert facts["residuals"][-1] < facts["residuals"][0]
    assert steps.metadata.diagnostics["residual"] < baseline.metadata.diagnostics["residual"]
    assert not torch.equal(steps.features, baseline.features)
