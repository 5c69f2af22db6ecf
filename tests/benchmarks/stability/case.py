"""What an extreme is, and what measuring it finds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from liftcore.scene.splats import Kernel

if TYPE_CHECKING:
    from collections.abc import Callable

KERNELS = (Kernel.GAUSSIAN_3D, Kernel.GAUSSIAN_2D, Kernel.BETA)
GAUSSIAN = (Kernel.GAUSSIAN_3D,)
FLOORED = (Kernel.GAUSSIAN_3D, Kernel.GAUSSIAN_2D)  # the kernels with a smallest alpha
WEIGHTS = 1e-5  # absolute, of weights against the float64 oracle


def always(_: object) -> bool:
    """No claim beyond equality with the oracle."""
    return True


@dataclass(frozen=True)
class Found:
    """What float32 gave on one extreme with one kernel."""

    gives: str  # in figures, for people
    error: float | None  # against exact arithmetic, as the case says; None where the input is refused
    told: tuple[str, ...] = ()  # what the user reads: warnings, or the error
    holds: bool = True  # whether what exact arithmetic says is so, of the float64 and of the float32 result
    flips: int = 0  # rays within a hair of a cut-off where float32 decided otherwise; they are left out of the error
    rays: int = 0


@dataclass(frozen=True)
class Extreme:
    """One row of the table, and one test a kernel."""

    name: str
    exact: str  # what exact arithmetic says
    measure: Callable[[Kernel], Found]
    kernels: tuple[Kernel, ...] = KERNELS
    bound: float = WEIGHTS  # of the error; the test holds it
    told: str = ""  # what some message must contain; "" where nothing is lost and nothing need be told
