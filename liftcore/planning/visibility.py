"""Which splats each camera can see at all, on a sample of the splats: footprints that touch the image.

The raster's own projection decides, so whatever it would blend is counted; what other splats hide is counted too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.raster.cpu.project import COLUMNS, EXTENT_X, EXTENT_Y, Targets, activated, project, view_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from liftcore.raster.base import CompositingParams
    from liftcore.scene.cameras import Camera
    from liftcore.scene.splats import Splats

SAMPLE = 16_384  # splats at most; a view of them takes a millisecond


@dataclass(frozen=True)
class Visibility:
    """How large the sampled splats are in each view."""

    areas: np.ndarray  # [V, n] f32, px^2 of the footprint's outline, at most the image's; 0 where it is not in it
    centres: np.ndarray  # [V, 3] f64, of the cameras
    means: np.ndarray  # [n, 3] f32, of the splats
    splats: int  # P, of which n are sampled evenly

    @property
    def in_view(self) -> np.ndarray:
        """[V, n] bool."""
        return self.areas > 0

    def of(self, views: Sequence[int]) -> Visibility:
        """The same of some views alone."""
        return Visibility(self.areas[views], self.centres[views], self.means, self.splats)

    @property
    def seen_share(self) -> float:
        """The share of the splats that some view can see."""
        return float(self.in_view.any(axis=0).mean())

    @property
    def splats_a_view(self) -> float:
        """How many of all splats a view can see, in the mean."""
        return float(self.in_view.mean()) * self.splats


def visibility(splats: Splats, cameras: Sequence[Camera], walk: CompositingParams) -> Visibility:
    """Project evenly spaced splats, SAMPLE at most, into every camera."""
    sample = spread_splats(splats, min(SAMPLE, splats.count))
    scene, count = activated(sample, walk.opacity_logit_scale), sample.count
    areas = np.zeros((len(cameras), count), np.float32)
    records = np.empty((count, COLUMNS[splats.kernel]))
    targets = Targets(records, np.empty(count, np.float32), np.empty(count, np.int32))
    for row, camera in zip(areas, cameras, strict=True):
        found = project(
            (0, count),
            scene,
            view_of(camera, replace(walk, stride=1, offset=(0, 0))),
            splats.kernel,
            walk.antialiased,
            targets,
        )
        outline = math.pi * records[:found, EXTENT_X] * records[:found, EXTENT_Y]
        row[targets.ids[:found]] = outline.clip(np.finfo(np.float32).tiny, camera.width * camera.height)
    centres = np.array([camera.centre for camera in cameras], np.float64).reshape(-1, 3)
    return Visibility(areas, centres, sample.means.numpy(), splats.count)


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
