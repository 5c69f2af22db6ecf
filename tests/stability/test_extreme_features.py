"""Extremes of the solution that no table has: lengths."""

from __future__ import annotations

import numpy as np
import pytest

from tests.stability.extreme_measures import cloud, run
from tests.stability.extremes import checkerboard


def lifted(views, splats=None, **settings):
    """The lift of the views onto a cloud, in float32."""
    return run(views, splats or cloud(), **{"preset": "tikhonov", **settings})[0]


@pytest.mark.parametrize("scale", [1e-30, 1e15])
def test_diagnostics_and_scores_are_the_same_at_any_length(scale):
    views = [{f"v{k}": checkerboard(5 + k, 40, size) for k in range(2)} for size in (1.0, scale)]
    first, second = (lifted(observations, preset="row-sum", reference_channels=4) for observations in views)
    for key in ("beta", "bound", "reference"):
        assert numbers(second.diagnostics[key]) == pytest.approx(numbers(first.diagnostics[key]), rel=2e-3, abs=1e-3)
    question = first.features[first.has_feature][:1].numpy()
    np.testing.assert_allclose(second.query(question).scores, first.query(question).scores, atol=1e-5)


def numbers(facts: object) -> list[float]:
    """The numbers of a part of diagnostics that have no unit."""
    if not isinstance(facts, dict):
        return [facts] if isinstance(facts, float) else []
    return [n for name, part in facts.items() if name not in ("residual", "optimum") for n in numbers(part)]
