"""The geometry phase: each view meets the raster once, which finds its W, and no feature channel is touched."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from liftcore.lifting.checkpoint import Checkpoint
from liftcore.raster.base import Raster, ViewRequest, ViewWeights
from liftcore.runtime.device import give_back_memory
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams
from liftcore.solve.codebook import Codebook, ViewCodebook, as_regions
from liftcore.solve.rays import Readout, SampledRays, read_pixels, sample_pixels
from liftcore.values.levels import at_levels, region_levels
from liftcore.values.lift_views import LiftViews
from liftcore.values.region_weights import MEMORY_LIMIT, RegionWeights, stacked
from liftcore.values.settings import LiftSettings
from liftcore.values.views import FeatureGrid, Regions, ViewFeatures


@dataclass(frozen=True)
class Geometry:
    """What all views together say about the splats."""

    weights: RegionWeights  # of all views, with a row for every splat
    codebook: Codebook  # what its regions stand for
    samples: tuple[SampledRays, ...]  # for the diagnostics, one a view
    blind: tuple[str, ...]  # views that meet no splat
    levels: np.ndarray  # [M] i8, of each region in its view; -1: a cell of a grid, or regions that are tuples

    @property
    def books(self) -> list[Tensor]:
        """E [M, F] of every view, as its observation was read."""
        return [view.rows for view in self.codebook.views]

    def evidence(self) -> Tensor:
        """[P] f32 on the CPU: sums of plain weights over all views, each ray once."""
        found = torch.zeros(self.weights.splats.shape[0], dtype=torch.float32)
        found[self.weights.evidence_splats.cpu().long()] = self.weights.evidence.cpu()
        return found


@dataclass(frozen=True)
class WeightRequest:
    """What the raster is asked of one view, and what its answer will mean."""

    request: ViewRequest
    readout: Readout  # of the request's pixels
    codebook: ViewCodebook
    levels: np.ndarray  # [M] i8, as `Geometry` has them

    def weights(self, found: ViewWeights) -> RegionWeights:
        """W of the view by rays of the photo: a stride's stand for those between them."""
        part = self.codebook.counted(found.weights)
        rays = float(self.request.params.stride**2)
        return replace(part, views=(self.request.camera.name,), evidence=part.evidence * rays)


def weight_request(views: LiftViews, number: int, settings: LiftSettings, by_rows: bool) -> WeightRequest:
    """What a lift asks of the view of that number, which is read for it.

    Args:
        by_rows: whether a region is a row of a codebook in any case, or may be a tuple of labels (`as_regions`).
    """
    camera, given = views[number]
    observation = as_read(given, settings, camera.name)
    params = strided(settings.lift_params, settings, camera, number)
    pixels = sample_pixels(camera, -(-settings.certificate_rays // len(views)), (settings.seed, number), params)
    regions, codebook = as_regions(observation, by_rows)
    if isinstance(given, Regions) and isinstance(observation, Regions) and codebook.tuples is None:
        levels = region_levels(observation)
    else:
        levels = np.full(codebook.regions, -1, np.int8)
    request = ViewRequest(camera, regions, params, settings.weighting, pixels)
    return WeightRequest(request, read_pixels(observation, camera, pixels), codebook, levels)


@one_thread()
def weigh_views(
    raster: Raster,
    splats: int,
    views: LiftViews,
    settings: LiftSettings,
    progress: Progress,
    *,
    by_rows: bool,
    checkpoint: Checkpoint | None = None,
    device_bytes: int = 0,
    threads: int | None = None,
    first: Sequence[int] = (),
    on_first: Callable[[Geometry], None] | None = None,
) -> Geometry:
    """W of all views, and sampled rows of A.

    Args:
        splats: P. views: in the order of the sums.
        by_rows: whether a region is a row of a codebook in any case, or may be a tuple of labels (`as_regions`).
        checkpoint: what the raster found of views before, and is to keep.
        device_bytes: of W that may stay on the device that found it.
        first: numbers of views that are weighed before the others. The result is the same for any.
        on_first: called with what these alone say, as soon as it is known. An exception from it stops the work.
    """
    order = [*first, *sorted({*range(len(views))} - {*first})]
    weighed = dict[int, _WeighedView]()
    waiting = deque[WeightRequest]()

    def requests() -> Iterator[ViewRequest]:
        for number in order:
            waiting.append(weight_request(views, number, settings, by_rows))
            yield waiting[-1].request

    answers = raster.iterate_views(requests()) if checkpoint is None else checkpoint.answers(raster, requests())
    on_device = in_memory = 0
    with closing(answers):
        for number, answer in zip(order, answers, strict=True):
            question = waiting.popleft()
            part = question.weights(answer)
            if part.region.is_cuda and on_device + part.nbytes <= device_bytes:
                on_device += part.nbytes
            else:
                part = part.cpu()
                in_memory += part.nbytes
                part = part if in_memory <= MEMORY_LIMIT else part.in_files()
            sample = SampledRays(answer.rows, question.readout)
            weighed[number] = _WeighedView(part, sample, question.codebook, question.levels)
            del answer, part, question  # before the next one is made beside it
            progress("geometry", len(weighed), len(views), "views")
            if on_first and len(weighed) == len(first):
                on_first(_stacked_views([weighed[one] for one in first], splats, threads))
    return _stacked_views([weighed.pop(number) for number in range(len(views))], splats, threads)


class _WeighedView(NamedTuple):
    """What the raster found of a view, without what the view observes."""

    weights: RegionWeights
    sample: SampledRays
    codebook: ViewCodebook
    levels: np.ndarray  # [M] i8


def _stacked_views(views: list[_WeighedView], splats: int, threads: int | None) -> Geometry:
    """W of some views, which are dropped from the list."""
    samples, codebook = tuple(view.sample for view in views), Codebook(tuple(view.codebook for view in views))
    blind = tuple(view.weights.views[0] for view in views if not view.weights.evidence.numel())
    levels = np.concatenate([view.levels for view in views])
    parts = [view.weights for view in views]
    views.clear()
    W = stacked(parts, splats, threads)
    parts.clear()
    give_back_memory()
    return Geometry(W, codebook, samples, blind, levels)


def strided(params: CompositingParams, settings: LiftSettings, camera: Camera, number: int) -> CompositingParams:
    """The parameters with the stride, its first pixel drawn for view ``number``: none is left out in all views."""
    rng = np.random.default_rng((settings.seed, number, settings.stride))
    left, top = (int(rng.integers(min(settings.stride, side))) for side in (camera.width, camera.height))
    return replace(params, stride=settings.stride, offset=(left, top))


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
