"""The geometry phase: one walk a view, everything that the solution needs, no feature channel touched."""

from __future__ import annotations

from collections import deque
from contextlib import closing
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.device import out_of_memory
from liftcore.features.levels import at_levels
from liftcore.features.views import FeatureGrid, Regions, ViewFeatures
from liftcore.one_thread import one_thread
from liftcore.raster.base import CompositingParams, RayRows, ViewRequest
from liftcore.solve.columns import Columns, as_walked
from liftcore.solve.readout import Readout, read_pixels, sample_pixels
from liftcore.solve.totals import Totals

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

    from liftcore.progress import Progress
    from liftcore.raster.base import Raster, RegionWeights
    from liftcore.scene.cameras import Camera
    from liftcore.settings import LiftSettings
    from liftcore.solve.view_weights import WeightStore
    from liftcore.solve.views import LiftViews


@dataclass(frozen=True)
class SampledRays:
    """Some rays of one view: their rows of A and what they read of the codebook."""

    rows: RayRows
    readout: Readout


@dataclass(frozen=True)
class Geometry:
    """What all views together say about the splats."""

    evidence: np.ndarray  # [P] f64, sum of plain weights, each ray once; a strided walk's times stride^2
    denominators: np.ndarray  # [P] f64, sum of w^p over labelled rays and levels
    samples: tuple[SampledRays, ...]  # for the certificate, one a view
    columns: tuple[Columns, ...]  # of W of every view, over E as its observation was read

    @property
    def codebooks(self) -> tuple[Tensor, ...]:
        """E [M, F] of every view."""
        return tuple(columns.codebook for columns in self.columns)


def strided_walk(walk: CompositingParams, settings: LiftSettings, camera: Camera, number: int) -> CompositingParams:
    """The walk with the stride, its first pixel drawn for view ``number``: no pixel is left out in all views."""
    rng = np.random.default_rng((settings.seed, number, settings.stride))
    left, top = (int(rng.integers(min(settings.stride, side))) for side in (camera.width, camera.height))
    return replace(walk, stride=settings.stride, offset=(left, top))


def as_read(observation: ViewFeatures, settings: LiftSettings, view: str) -> ViewFeatures:
    """The observation as the settings read it: its levels, and with ``nearest`` a grid as regions of one cell each.

    Raises:
        InvalidFeatures: the view lacks the level that the settings ask for.
    """
    observation = at_levels(observation, settings.levels, view)
    if not isinstance(observation, FeatureGrid) or settings.grid_reading == "bilinear":
        return observation
    rows, columns = observation.grid.shape[:2]
    cells = torch.arange(rows * columns, dtype=torch.int32).reshape(1, rows, columns)
    return Regions.unchecked(cells, observation.codebook)


@one_thread()
def accumulate(
    raster: Raster, count: int, views: LiftViews, settings: LiftSettings, store: WeightStore, progress: Progress
) -> Geometry:
    """Weigh every view once: ``W_v`` into the store, evidence, denominators, and sampled rows of A.

    Args:
        count: P.
        views: in the order of the sums.
        store: receives one RegionWeights a view.
    """
    totals, expected = Totals(count, store.place), len(views)
    samples, readouts, columns = [], deque[Readout](), []

    def requests() -> Iterator[ViewRequest]:
        rays = -(-settings.certificate_rays // expected)
        for number, (camera, given) in enumerate(views):
            observation = as_read(given, settings, camera.name)
            params = strided_walk(settings.lift_params, settings, camera, number)
            pixels = sample_pixels(camera, rays, (settings.seed, number), params)
            readouts.append(read_pixels(observation, camera, pixels))
            walked, own = as_walked(observation, settings)
            columns.append(own)
            yield ViewRequest(camera, walked, params, settings.weighting, pixels)

    with closing(raster.iterate_views(requests())) as walked_views:
        for walked in walked_views:
            weights = _add(totals, walked.weights, columns[len(samples)], float(settings.stride**2), store)
            store.append(weights)
            samples.append(SampledRays(walked.rows, readouts.popleft()))
            del walked, weights  # before the next one is made beside it
            progress("geometry", len(samples), expected, "views")
    return Geometry(*totals.found(), tuple(samples), tuple(columns))


def _add(totals: Totals, walked: RegionWeights, columns: Columns, rays: float, store: WeightStore) -> RegionWeights:
    """The view's W, added to the totals; earlier W on the card is brought home when nothing else makes room there."""
    try:
        weights = columns.weighted(walked)
        totals.add(weights, rays)
    except RuntimeError as error:
        if not (out_of_memory(error) and store.card_bytes):
            raise
    else:
        return weights
    store.bring_home()
    weights = columns.weighted(walked)
    totals.add(weights, rays)
    return weights
