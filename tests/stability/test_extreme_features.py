"""Extremes of the solution that no table has: view consistency and readings."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from liftcore.values.views import FeatureGrid, Regions
from tests.benchmarks.extreme_measures import cloud, run
from tests.benchmarks.extremes import checkerboard


def lifted(views, splats=None, **settings):
    """The lift of the views onto a cloud, in float32."""
    return run(views, splats or cloud(), **{"preset": "tikhonov", **settings})[0]


def test_view_consistency_is_the_same_at_any_length_of_the_vectors():
    runs = [lifted({"v0": checkerboard(5, 40, scale)}).view_consistency for scale in (1.0, 1e14, 1e-25)]
    assert torch.allclose(runs[0], runs[1], atol=1e-5)
    assert torch.allclose(runs[0], runs[2], atol=1e-5)


@pytest.mark.parametrize("scale", [1e-30, 1e-7, 1e15])
def test_diagnostics_and_scores_are_the_same_at_any_length(scale):
    views = [{f"v{k}": checkerboard(5 + k, 40, size) for k in range(2)} for size in (1.0, scale)]
    first, second = (lifted(observations, preset="row-sum", reference_channels=4) for observations in views)
    for key in ("beta", "bound", "reference"):
        assert numbers(second.diagnostics[key]) == pytest.approx(numbers(first.diagnostics[key]), rel=2e-3, abs=1e-3)
    question = first.features[first.has_feature][:1].numpy()
    assert torch.allclose(second.query(question).scores, first.query(question).scores, atol=1e-5)


def numbers(facts: object) -> list[float]:
    """The numbers of a part of diagnostics that have no unit."""
    if not isinstance(facts, dict):
        return [facts] if isinstance(facts, float) else []
    return [n for name, part in facts.items() if name not in ("residual", "optimum") for n in numbers(part)]


def without_plan(diagnostics: dict[str, object]) -> dict[str, object]:
    return {key: value for key, value in diagnostics.items() if key != "plan"}


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (12, 16), (50, 70)])
def test_the_nearest_reading_of_a_grid_takes_the_cell_under_the_pixel(size):
    vectors = np.random.default_rng(1).uniform(size=(*size, 6))
    grid = FeatureGrid(torch.tensor(vectors, dtype=torch.float32))
    cells = Regions(torch.arange(size[0] * size[1], dtype=torch.int32).reshape(1, *size), grid.codebook)
    got = lifted({"v0": grid}, preset="row-sum", grid_reading="nearest")
    as_regions = lifted({"v0": cells}, preset="row-sum", objects=False)  # as cells of a grid make none
    assert torch.equal(got.features, as_regions.features)
    # The plan's memory is an upper bound of each reading.
    assert without_plan(got.metadata.diagnostics) == without_plan(as_regions.metadata.diagnostics)
