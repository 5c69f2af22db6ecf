"""Trade-off of time and accuracy: candidates, the recommended run, its accuracies and the files of a report."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch

from liftcore.evaluate.accuracy import centred_cosines, cosine_figures, shared_pixels
from liftcore.evaluate.ranking import accuracy_of, choose
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.raster.reference import dense_view, reading_matrix
from liftcore.scene.compositing import CompositingParams
from liftcore.values.views import FeatureGrid
from tests.scenes import centred, observed, random_camera, random_splats

pytestmark = pytest.mark.slow


def accuracies_of(cosines: Sequence[float] | np.ndarray) -> dict[str, Any]:
    return {"centred_cosine": list(cosines), "intersections": [], "unions": [], "phrase_iou": []}


def run_of(name: str, seconds: float, cosines: Sequence[float] | np.ndarray, kind: str = "dial") -> dict[str, Any]:
    """Return a run as `comparison._run` reports it."""
    figures = dict.fromkeys(("cosine", "cosine_plain", "cosine_q05"), 0.9)
    times = dict.fromkeys((f"{part}{end}" for part in ("wall", "cpu") for end in ("_s", "_ratio")), seconds)
    times |= dict.fromkeys(("process_s", "wall_with_reading_s", "cpu_with_reading_s"), seconds)
    stages = {"timings": {"plan": 0.01, "geometry": seconds / 2, "solve": seconds / 4}}
    measurements = {
        "peak_memory_bytes": 1 << 30,
        "views": 3,
        "lost_share": 0.0,
        "accuracies": accuracies_of(cosines),
    } | stages
    return {"name": name, "kind": kind, "options": {"quality": name}, **figures, **times, **measurements}


def choice_of(*runs: dict[str, Any]) -> dict[str, Any]:
    accuracies = [run["accuracies"] for run in runs]
    return choose([run | accuracy_of(accuracy) for run, accuracy in zip(runs, accuracies, strict=True)], accuracies)


VIEWS = np.array([0.2, 0.9, 0.4, 0.7, 0.5, 0.6])  # views differ more than runs do
NOISE = np.array([1, -1, 1, -1, 1, -1]) * 0.002
RUNS = [
    run_of("exact", 10, VIEWS),
    run_of("equal", 5, VIEWS + NOISE - 0.0005),
    run_of("distinct", 2, VIEWS - 0.005),
    run_of("unclear", 1, VIEWS - [0.3, -0.1, 0.3, -0.1, 0.1, -0.1], "preset"),
]


def test_the_cheapest_of_runs_as_good_as_the_best_is_taken():
    choice = choice_of(*RUNS)
    assert (choice["recommended"], choice["name"], choice["ties"]) == (True, "equal", ["equal", "exact"])
    assert "6 views do not tell" in choice["why"] and "(exact, 0.5500)" in choice["why"]
    assert choice["front"] == ["unclear", "distinct", "equal", "exact"]
    # A run far below that few views do not distinguish is not as good; nor is one that is near and always below.
    assert choice_of(RUNS[0], RUNS[3])["ties"] == ["exact"] == choice_of(RUNS[0], RUNS[2])["ties"]
    interval = choice_of(*[run_of(name, 1, VIEWS[:4]) for name in ("a", "b")])["intervals"]["a"]
    every_draw = np.array(list(product(VIEWS[:4], repeat=4))).mean(axis=1)
    assert interval == pytest.approx(np.quantile(every_draw, [0.025, 0.975]), abs=0.03)


def test_too_little_to_judge_by_recommends_nothing():
    single = choice_of(RUNS[0])
    assert (single["recommended"], single["name"]) == (False, "exact")
    assert single["why"].startswith("Nothing can be recommended: exact alone fitted the budget")
    few = choice_of(*[run_of(name, 1, VIEWS[:3]) for name in ("exact", "fast")])
    assert not few["recommended"] and "4 at least, and there are 3 with features and 0 with masks" in few["why"]
    none = choice_of(*[run_of(name, 1, []) for name in ("exact", "fast")])
    assert not none["recommended"] and none["accuracy"] == "cosine"


def test_mask_iou_over_views_is_that_of_all_their_pixels():
    rng = torch.Generator().manual_seed(0)
    labels, truth = (torch.randint(0, 3, (4, 50), generator=rng) for _ in range(2))
    intersections, unions = zip(*(shared_pixels(*view, 4) for view in zip(labels, truth, strict=True)), strict=True)
    pixel_counts = {"intersections": torch.stack(intersections).tolist(), "unions": torch.stack(unions).tolist()}
    accuracy = accuracy_of(accuracies_of([]) | pixel_counts | {"phrase_iou": [0.5, 1.0]})
    ious = [float(((labels == k) & (truth == k)).sum() / ((labels == k) | (truth == k)).sum()) for k in range(3)]
    assert accuracy["mask_iou"] == pytest.approx(sum(ious) / 3)
    assert (accuracy["phrase_iou"], accuracy["centred_cosine"]) == (0.75, None)
    with_masks = [run | {"accuracies": run["accuracies"] | pixel_counts} for run in RUNS]
    assert (choice_of(*with_masks)["accuracy"], choice_of(*with_masks)["name"]) == ("mask_iou", "unclear")


@pytest.mark.parametrize("grids", [False, True])
def test_centred_cosines_equal_the_dense_definition(grids):
    splats, params, X = random_splats(3, 50), CompositingParams(1.2), torch.randn(50, 6)
    cameras = [centred(random_camera(3 + k, 32, 24, name=f"v{k}")) for k in range(2)]  # fewer pixels than are sampled
    views = [observed(3, k, grids) for k in range(2)]
    readings = [reading_matrix(view, 32, 24) for view in views]
    targets = [S @ view.codebook.double().numpy() for (S, _), view in zip(readings, views, strict=True)]
    targets = [rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in targets]
    mean, expected = np.concatenate(targets).mean(axis=0), []
    for camera, view, (S, rays), B in zip(cameras, views, readings, targets, strict=True):
        rendered = (dense_view(splats, camera, params).A @ X.double().numpy())[rays]
        length = np.linalg.norm(rendered, axis=1)
        rendered_offset, target_offset = rendered / np.maximum(length, 1e-30)[:, None] - mean, B - mean
        cosines = (
            (rendered_offset * target_offset).sum(axis=1)
            / np.linalg.norm(rendered_offset, axis=1)
            / np.linalg.norm(target_offset, axis=1)
        )
        cosines[length == 0] = 0
        groups = [S[:, m] > 0 for m in range(S.shape[1])]
        means = [cosines[rows].mean() for rows in groups if rows.sum() >= 5]
        expected.append(cosines.mean() if isinstance(view, FeatureGrid) else np.mean(means))
    actual = centred_cosines(CpuRaster(splats), list(zip(cameras, views, strict=True)), X, params)
    assert actual == pytest.approx(expected, abs=1e-4)


def test_cosines_count_splats_that_the_exact_run_saw():
    exact = torch.tensor([[1.0, 0], [0, 1], [1, 0], [0, 0]])
    figures = cosine_figures(
        torch.tensor([[2.0, 0], [0, 0], [0, 1], [1, 1]]), exact, torch.tensor([3.0, 0.5, 0.5, 9.0])
    )
    assert figures["cosine"] == pytest.approx(3 / 4)
    assert figures["cosine_plain"] == pytest.approx(1 / 3)
    assert (figures["cosine_q05"], figures["lost_share"]) == (0, pytest.approx(1 / 3))
