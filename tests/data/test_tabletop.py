"""The bars on the tabletop scene: at least the baselines of its data README, to the digits that it prints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.benchmarks.tabletop import CASES, Case, Tabletop

if TYPE_CHECKING:
    from pathlib import Path

ROUNDING = 0.0005 + 1e-9  # of three printed digits
SHORT = ("features_hard", "grids")  # python -m tests.benchmarks.tabletop measures all
BARS = [case for case in CASES if case.pack in SHORT and case.accuracy is not None and case.power == 1]


@pytest.fixture(scope="module")
def tabletop(shared_data: Path) -> Tabletop:
    return Tabletop(shared_data / "tabletop")


def test_the_splats_that_count_are_those_of_the_data_readme(tabletop):
    share = float(tabletop.counted.float().mean())
    assert share == pytest.approx(0.9056, abs=5e-4)


@pytest.mark.parametrize("case", BARS, ids=lambda case: case.name)
def test_a_row_sum_lift_reaches_the_baseline(tabletop, case: Case):
    assert case.accuracy is not None
    assert case.miou is not None
    got = tabletop.measure(case)
    assert got.accuracy >= case.accuracy - ROUNDING
    assert got.miou >= case.miou - ROUNDING
