"""One splat's sums over a million rays or entries, or ten thousand views, keep the digits of float32."""

from __future__ import annotations

import pytest

from tests.benchmarks.stability.accumulation import (
    added_one_by_one,
    robust_sums,
    sums_of_entries,
    sums_of_rays,
    sums_of_views,
)

DIGITS = 1e-6  # relative; one rounding to float32 is 6e-8
EQUAL = 5e-6  # where all roundings go one way


def test_sums_over_a_million_rays_are_those_of_float64():
    assert max(sums_of_rays(1_000).values()) < DIGITS


@pytest.mark.parametrize(("equal", "bound"), [(True, EQUAL), (False, DIGITS)])
def test_a_splat_behind_a_million_regions_has_their_mean(equal, bound):
    assert sums_of_entries(1_000_000, equal) < bound < added_one_by_one(1_000_000)


@pytest.mark.parametrize(("equal", "bound"), [(True, EQUAL), (False, DIGITS)])
def test_a_splat_seen_by_ten_thousand_views_has_their_mean(equal, bound):
    assert sums_of_views(10_000, equal) < bound


@pytest.mark.parametrize(("rows", "channels"), [(100_000, 8), (8, 10_000)])
def test_a_robust_step_over_many_rows_or_channels_keeps_its_weights(rows, channels):
    assert robust_sums(rows, channels) < DIGITS
