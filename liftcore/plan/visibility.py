"""Which splats each camera can see at all, on a sample of the splats: footprints that touch the image.

The raster's own projection decides, so whatever it would blend is counted; what other splats hide is counted too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.raster.kernels import RECORDS, activated, project
from liftcore.raster.projection import Targets, view_of
from liftcore.raster.records import EXTENT_X, EXTENT_Y

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.raster.protocol import Walk
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

SAMPLE = 16_384  # splats at most; a view of them takes a millisecond
SIDES = 24  # directions that a splat is looked at from: the three of each octant


@dataclass(frozen=True)
class Visibility:
    """How large the sampled splats are in each view."""

    areas: np.ndarray  # [V, n] f32, px^2 of the footprint's outline, at most the image's; 0 where it is not in it
    sides: np.ndarray  # [V, n] u8, from which of SIDES directions the view looks at the splat
    splats: int  # P, of which n are sampled evenly

    @property
    def in_view(self) -> np.ndarray:
        """[V, n] bool."""
        return self.areas > 0

    def of(self, views: Sequence[int]) -> Visibility:
        """The same of some views alone."""
        return Visibility(self.areas[views], self.sides[views], self.splats)

    @property
    def seen_share(self) -> float:
        """The share of the splats that some view can see."""
        return float(self.in_view.any(axis=0).mean())

    @property
    def splats_a_view(self) -> float:
        """How many of all splats a view can see, in the mean."""
        return float(self.in_view.mean()) * self.splats


def visibility(splats: Splats, cameras: Sequence[Camera], walk: Walk) -> Visibility:
    """Project evenly spaced splats, SAMPLE at most, into every camera."""
    sample = spread_splats(splats, min(SAMPLE, splats.count))
    scene, count = activated(sample, walk.gain), sample.count
    areas = np.zeros((len(cameras), count), np.float32)
    sides = np.stack([side_of(camera.centre - sample.means.numpy()) for camera in cameras])
    records = np.empty((count, RECORDS[splats.kernel]))
    targets = Targets(records, np.empty(count, np.float32), np.empty(count, np.int32))
    for row, camera in zip(areas, cameras, strict=True):
        found = project((0, count), scene, view_of(camera), splats.kernel, walk.antialiased, targets)
        outline = math.pi * records[:found, EXTENT_X] * records[:found, EXTENT_Y]
        row[targets.ids[:found]] = outline.clip(np.finfo(np.float32).tiny, camera.width * camera.height)
    return Visibility(areas, sides, splats.count)


def side_of(directions: np.ndarray) -> np.ndarray:
    """Directions [n, 3] -> [n] u8: the octant, and the longest component in it."""
    octants = (directions > 0) @ np.array([1, 2, 4])
    return (3 * octants + np.abs(directions).argmax(axis=1)).astype(np.uint8)


def spread(total: int, count: int) -> np.ndarray:
    """[count] i64, evenly spaced numbers below ``total``, with the first and the last."""
    return np.linspace(0, total - 1, count).astype(np.int64)


def spread_splats(splats: Splats, count: int) -> Splats:
    """The geometry of so many evenly spaced splats, a copy."""
    rows = torch.from_numpy(spread(splats.count, count))
    return replace(
        splats,
        means=splats.means[rows],
        quats=splats.quats[rows],
        log_scales=splats.log_scales[rows],
        opacity_logits=splats.opacity_logits[rows],
        beta=None if splats.beta is None else splats.beta[rows],
        sh=None,
        sb_params=None,
        extras={},
        layout=(),
        header=(),
    )
