"""Every row of the extremes' tables holds: the error is within its bound, the claim is so, and the user is told."""

import pytest

from liftcore.scene.splats import Kernel
from tests.benchmarks.extreme_measures import (
    WEIGHTS,
    Extreme,
    added_one_by_one,
    robust_sums,
    sums_of_entries,
    sums_of_rays,
    sums_of_views,
    survey,
)  # fmt: skip
from tests.benchmarks.extremes import EXTREMES, TABLES, rows_of

pytestmark = pytest.mark.usefixtures("every_kernel")
RAYS_FLIPPED = 1e-3  # of the wide scenes, which look for the cut-offs; the conformance suite holds 1e-4 on usual ones
DIGITS, EQUAL = 1e-6, 5e-6  # relative; one rounding to float32 is 6e-8, and of equal terms all go one way
ROWS = [(extreme, kernel) for extreme in EXTREMES for kernel in extreme.kernels]


@pytest.mark.parametrize(("extreme", "kernel"), ROWS, ids=[f"{row.name}-{kernel}" for row, kernel in ROWS])
def test_extreme_is_survived_with_the_stated_error(extreme: Extreme, kernel: Kernel) -> None:
    found = extreme.measure(kernel)
    assert found.holds
    assert found.error is None or found.error <= extreme.bound
    assert extreme.told in " ".join(found.told)


def test_a_row_says_what_was_measured() -> None:
    (row,) = rows_of(TABLES["Refused"][:1])
    assert (row["float32 gives"], row["error"]) == ("refused", None)
    assert row["told"].startswith("opacity_logits: expected finite values")


@pytest.mark.parametrize("kernel", list(Kernel))
def test_wide_scenes_equal_the_reference_and_rarely_flip(kernel: Kernel) -> None:
    got = survey(kernel, 100)
    assert got.finite
    assert got.error < WEIGHTS
    assert got.flips <= max(1, RAYS_FLIPPED * got.rays)
    assert got.judged >= 0.95 * got.scenes


def test_sums_over_a_million_rays_are_those_of_float64() -> None:
    assert max(sums_of_rays(1_000).values()) < DIGITS


@pytest.mark.parametrize(("equal", "bound"), [(True, EQUAL), (False, DIGITS)])
def test_many_regions_or_views_have_their_mean(equal: bool, bound: float) -> None:
    assert sums_of_entries(1_000_000, equal) < bound < added_one_by_one(1_000_000)
    assert sums_of_views(1_000, equal) < bound


@pytest.mark.parametrize(("rows", "channels"), [(20_000, 8), (8, 10_000)])
def test_a_robust_step_over_many_keeps_its_weights(rows: int, channels: int) -> None:
    assert robust_sums(rows, channels) < DIGITS
