"""Thresholds without ground truth: their values, and that no input makes them fail."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from liftcore.query.question import METHODS
from liftcore.query.threshold import find_threshold, has_one_mode


def hills(*parts: tuple[float, float, int], seed: int = 0) -> torch.Tensor:
    """Return scores [n] f32 of normal distributions, each of (mean, deviation, count)."""
    rng = np.random.default_rng(seed)
    return torch.from_numpy(np.concatenate([rng.normal(*part) for part in parts]).astype(np.float32))


@pytest.mark.parametrize(
    ("parts", "low", "high"),
    [
        ([(0.2, 0.02, 50_000), (0.4, 0.01, 100)], 0.28, 0.38),
        ([(0.0, 0.003, 5000), (0.3, 0.02, 80_000), (0.42, 0.015, 8000)], 0.34, 0.41),  # a gap below nearly all
        ([(0.0, 0.01, 1000), (0.3, 0.01, 9000)], 0.02, 0.28),  # what fills most of a scene
        ([(0.25, 0.015, 97_000), (0.48, 0.005, 1000), (0.60, 0.005, 1000), (0.99, 0.003, 1000)], 0.65, 0.95),
    ],
)
def test_auto_finds_the_thing_that_stands_apart(
    parts: list[tuple[float, float, int]], low: float, high: float
) -> None:
    outliers = torch.linspace(0.66, 0.93, 6) if high > 0.9 else torch.empty(0)  # which leave a wide gap empty
    assert low < find_threshold(torch.cat([hills(*parts), outliers]), "auto").value < high


def test_a_few_stray_scores_are_no_object() -> None:
    scores = torch.cat([hills((0.2, 0.01, 50_000), (0.3, 0.01, 5000)), torch.tensor([0.5, 0.51])])
    assert 0.22 < find_threshold(scores, "auto").value < 0.29


def test_auto_takes_no_score_below_least() -> None:
    scores = hills((-0.3, 0.05, 50_000), (0.3, 0.05, 20_000), (0.7, 0.05, 5000))
    anywhere, above = find_threshold(scores), find_threshold(scores, least=0.4)
    assert anywhere.value < 0.15 and anywhere.explanation.startswith("The share")
    assert 0.4 < above.value < 0.6 and above.explanation.startswith("Above 0.4 the share")
    for least in (-0.9, 2.0):  # below all, or where there is nothing
        assert find_threshold(scores, least=least) == anywhere


def test_auto_says_when_nothing_stands_apart() -> None:
    assert "with care" in find_threshold(hills((0.2, 0.05, 50_000)), "auto").explanation
    assert "with care" not in find_threshold(hills((0.2, 0.02, 50_000), (0.4, 0.01, 500)), "auto").explanation


def test_a_valley_counts_if_as_many_splats_can_show_it() -> None:
    hills_apart, hill = hills((0.2, 0.03, 5000), (0.32, 0.03, 2500)).numpy(), hills((0.2, 0.03, 5000)).numpy()
    value = find_threshold(hills_apart).value
    assert not has_one_mode(hills_apart, value, None) and has_one_mode(hills_apart, value, None, count=20)
    assert has_one_mode(hill, 0.2, None)


@pytest.mark.parametrize("method", METHODS)
def test_scores_that_are_equal_or_none_say_so(method: str) -> None:
    for count in (1, 1000):
        threshold = find_threshold(torch.full((count,), 0.25), method)
        assert threshold.value == 0.25 and "no valley" in threshold.explanation
    assert find_threshold(torch.empty(0), method).value == math.inf


def test_paper_takes_otsus_split_where_no_valley_lies_above_the_largest_peak() -> None:
    threshold = find_threshold(hills((0.2, 0.03, 9000), (0.4, 0.005, 3000)), "paper")
    assert 0.29 < threshold.value < 0.39 and "Otsu" in threshold.explanation


def test_weights_count_like_repeated_scores() -> None:
    scores = hills((0.2, 0.01, 2000), (0.3, 0.01, 500))
    weights = torch.where(scores > 0.25, 3.0, 1.0)
    copies = torch.cat([scores, scores[scores > 0.25], scores[scores > 0.25]])
    for method in METHODS:
        weighted = find_threshold(scores, method, weights).value
        assert weighted == pytest.approx(find_threshold(copies, method).value, abs=2e-3)


SCORES = hnp.arrays(np.float32, st.integers(1, 300), elements=st.floats(-1, 1, width=32, allow_subnormal=False))


@given(scores=SCORES, method=st.sampled_from(METHODS))
@settings(max_examples=200, deadline=None)
def test_any_scores_have_a_threshold_between_their_least_and_greatest(scores: np.ndarray, method: str) -> None:
    threshold = find_threshold(torch.from_numpy(scores), method)
    assert scores.min() <= threshold.value <= scores.max()
    assert threshold.explanation.endswith(".")


@given(
    seed=st.integers(0, 1000),
    method=st.sampled_from(METHODS),
    scale=st.sampled_from([0.125, 2.0, 64.0]),
    shift=st.sampled_from([0.0, -4.0, 16.0]),
)
@settings(max_examples=60, deadline=None)
def test_thresholds_move_with_the_scores(seed: int, method: str, scale: float, shift: float) -> None:
    scores = hills((0.2, 0.02, 3000), (0.35, 0.02, 900), (0.6, 0.03, 400), seed=seed)
    base = find_threshold(scores, method).value
    scaled = find_threshold(scores * scale + shift, method).value
    spread = float(scores.max() - scores.min())
    assert (scaled - shift) / scale == pytest.approx(base, abs=0.02 * spread)
