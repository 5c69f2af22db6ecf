"""Each row of the tables of extremes holds: error within its bound, claim true, warning given."""

import pytest

from liftcore.scene.splats import Kernel
from tests.stability.extreme_measures import Extreme
from tests.stability.extremes import EXTREMES

pytestmark = pytest.mark.usefixtures("every_kernel")
ROWS = [(extreme, kernel) for extreme in EXTREMES for kernel in extreme.kernels]


@pytest.mark.parametrize(("extreme", "kernel"), ROWS, ids=[f"{row.name}-{kernel}" for row, kernel in ROWS])
def test_extreme_is_survived_with_the_stated_error(extreme: Extreme, kernel: Kernel) -> None:
    measured = extreme.measure(kernel)
    assert measured.holds
    assert measured.error <= extreme.bound
    assert extreme.text in " ".join(measured.text)
