"""Each row of the tables of extremes holds: error within its bound, claim true, warning given."""

import pytest

from liftcore.scene.splats import Kernel
from tests.benchmarks.extreme_measures import WEIGHTS, Extreme, survey
from tests.benchmarks.extremes import EXTREMES, TABLES, rows_of

pytestmark = pytest.mark.usefixtures("every_kernel")
RAYS_FLIPPED = 1e-3  # of the wide scenes, which look for the cut-offs; the conformance suite holds 1e-4 on usual ones
ROWS = [(extreme, kernel) for extreme in EXTREMES for kernel in extreme.kernels]


@pytest.mark.parametrize(("extreme", "kernel"), ROWS, ids=[f"{row.name}-{kernel}" for row, kernel in ROWS])
def test_extreme_is_survived_with_the_stated_error(extreme: Extreme, kernel: Kernel) -> None:
    measured = extreme.measure(kernel)
    assert measured.holds
    assert measured.error is None or measured.error <= extreme.bound
    assert extreme.text in " ".join(measured.text)


def test_a_row_says_what_was_measured() -> None:
    (row,) = rows_of(TABLES["Refused"][:1])
    assert (row["float32 gives"], row["error"]) == ("refused", None)
    assert row["message"].startswith("splats: expected at least one splat of finite numbers")


@pytest.mark.parametrize("kernel", list(Kernel))
def test_wide_scenes_equal_the_reference_and_rarely_flip(kernel: Kernel) -> None:
    got = survey(kernel, 100)
    assert got["finite"]
    assert got["error"] < WEIGHTS
    assert got["flips"] <= max(1, RAYS_FLIPPED * got["rays"])
    assert got["judged"] >= 0.95 * got["scenes"]
