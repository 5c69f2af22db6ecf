"""What counts as a weight: plain values that the settings share with every raster, without torch."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

MOST_OF_A_RAY = 64  # the largest k of top-k


class Selection(StrEnum):
    """Which of a ray's weights count."""

    ALL = "all"
    TOP_K = "top-k"  # the k largest of the ray, equal ones near to far (argmax lifting: k = 1; Dr. Splat)
    FRONT_MASS = "front-mass"  # those in front of which less than a share of the light was taken (VALA's gate)
    CENTRE = "centre"  # one ray a splat: that of the pixel which holds its projected centre (Occam's LGS)


@dataclass(frozen=True)
class Weighting:
    """What counts as the weight of a splat on a ray: some of ``w = alpha T``, to a power."""

    power: int = 1  # 0, 1 or 2 of what was selected; 0: each kept weight counts one
    selection: Selection = Selection.ALL
    count: int = 1  # k of top-k, at most MOST_OF_A_RAY
    mass: float = 0.75  # of front-mass: a weight counts while 1 - T before it is below this
    floor: float = 0.0  # a smaller weight counts none, in every selection
