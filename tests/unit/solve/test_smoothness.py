"""The smoothness of features: its minimum, its bits, and the setting of a lift."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import liftcore as lc
from liftcore.lifting.files import lift_files
from liftcore.scene.neighbours import SplatGraph
from liftcore.scene.splats import Splats
from liftcore.solve.smooth import STEPS, smooth
from liftcore.values.settings import LiftSettings
from tests.scenes import random_splats, write_scene
from tests.unit.scene.test_neighbours import dense

SEEDS = st.integers(0, 2**16)


class Scene:
    """Splats of similar colours with random features and support; some of them were seen by no ray."""

    def __init__(self, seed: int, count: int, channels: int = 5, unseen: float = 0.2) -> None:
        rng = np.random.default_rng(seed)
        splats = random_splats(seed, count)
        assert splats.sh is not None
        self.splats: Splats = replace(splats, sh=0.1 * splats.sh)
        self.solved: Tensor = torch.from_numpy(rng.random(count) >= unseen)
        self.X: Tensor = (
            torch.from_numpy(rng.normal(size=(count, channels)).astype(np.float32)) * self.solved[:, None]
        )
        self.total_weight: Tensor = torch.from_numpy(10 ** rng.uniform(-4, 3, count)).float()
        self.confidence: Tensor = torch.from_numpy(rng.random(count)).float()

    def smooth(self, smoothness: float, **options: Any) -> Tensor:
        arguments = SplatGraph.of(self.splats), self.total_weight, self.confidence, self.solved, smoothness
        return smooth(self.X.clone(), *arguments, **options)[0]

    def minimum(self, smoothness: float) -> tuple[np.ndarray, np.ndarray]:
        """The features [P, F] of the splats that were seen by a dense solver, and their weights [P], both f64."""
        weights = self.total_weight.double() * self.confidence.double().clamp_min(0.02) * self.solved
        weights, affinities = weights.numpy(), dense(SplatGraph.of(self.splats))
        couplings = smoothness * affinities * np.sqrt(np.outer(weights, weights))
        K = np.diag(weights + couplings.sum(axis=1)) - couplings
        rows = np.flatnonzero(weights)
        X = np.zeros(self.X.shape)
        X[rows] = np.linalg.solve(K[np.ix_(rows, rows)], (weights[:, None] * self.X.double().numpy())[rows])
        return X, weights


@settings(max_examples=20, deadline=None)
@given(
    seed=SEEDS, count=st.integers(1, 120), smoothness=st.sampled_from([0.01, 0.3, 1.0, 4.0, 100.0]),
    channels=st.sampled_from([5, 31, 130]),  # fewer and more than are solved at a time
)  # fmt: skip
def test_features_are_those_of_the_least_sum(seed: int, count: int, smoothness: float, channels: int) -> None:
    scene = Scene(seed, count, channels)
    X, weights = scene.minimum(smoothness)
    residual = np.sqrt(weights[:, None]) * (scene.smooth(smoothness).double().numpy() - X)
    change = np.sqrt(weights[:, None]) * (scene.X.double().numpy() - X)
    assert np.linalg.norm(residual) <= 1e-2 * np.linalg.norm(change) + 1e-6 * np.sqrt(weights.sum())


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
@pytest.mark.parametrize("longest", [6e4, 1e-6])
def test_no_channel_leaves_the_range_of_the_features(dtype: torch.dtype, longest: float) -> None:
    scene = Scene(1, 300)
    X = (scene.X / scene.X.abs().max() * longest).to(dtype)
    low, high = X[scene.solved].aminmax(dim=0)
    smoothed, facts = smooth(X.clone(), SplatGraph.of(scene.splats), scene.total_weight, None, scene.solved, 1e6)
    assert smoothed.dtype == dtype
    assert ((smoothed >= low.clamp_max(0)) & (smoothed <= high.clamp_min(0))).all()
    assert ("warning" in facts) == (facts["steps"] >= STEPS)


def test_splats_that_no_neighbour_reaches_stay_as_they_are() -> None:
    scene = Scene(4, 60, unseen=0.0)
    far = scene.splats.means.clone()
    far[40:] += 1e4
    splats, solved = replace(scene.splats, means=far), torch.arange(60) < 40
    X = (scene.X.abs() + 1) * solved[:, None]
    smoothed = smooth(X.clone(), SplatGraph.of(splats), scene.total_weight, None, solved, 1.0)[0]
    assert not smoothed[40:].any()
    assert (smoothed[:40] >= 1).all()


@pytest.mark.parametrize("dtype", ["float16", "float32"])
def test_setting_smooths_what_the_lift_solved(dtype: str, tmp_path: Path) -> None:
    files = write_scene(tmp_path, 3)
    baseline, result = (
        lift_files(files[0], files[1], files[2:], LiftSettings.of(smoothness=strength, dtype=dtype))
        for strength in (0, 1.5)
    )
    arguments = SplatGraph.of(lc.read_splats(files[0])), baseline.total_weight, baseline.confidence
    expected, facts = smooth(baseline.features.clone(), *arguments, baseline.has_feature, 1.5)
    assert torch.equal(result.features, expected) and not torch.equal(expected, baseline.features)
    for name in ("total_weight", "confidence", "has_feature"):
        assert torch.equal(getattr(result, name), getattr(baseline, name)), name
    assert result.diagnostics["smoothing"] == facts and facts["colours"]
