"""The geometry phase: the raster computes W of each view once, without reading any feature channel."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from liftcore.lifting.checkpoint import Checkpoint
from liftcore.lifting.pieces import stacked
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
from liftcore.values.region_weights import MEMORY_LIMIT, RegionWeights
from liftcore.values.settings import LiftSettings
from liftcore.values.views import Regions


@dataclass(frozen=True)
class Geometry:
    """W of all views, and the codebook of its regions."""

    weights: RegionWeights  # of all views, with a row for every splat
    codebook: Codebook  # the features of its regions
    samples: tuple[SampledRays, ...]  # for the diagnostics, one a view
    blind: tuple[str, ...]  # views whose rays hit no splat
    levels: np.ndarray  # [M] i8, of each region in its view; -1: a cell of a grid, or regions that are tuples

    def total_weight(self) -> Tensor:
        """Return [P] f32 on the CPU: sums of unweighted A over all views, each ray once."""
        sums = torch.zeros(self.weights.splats.shape[0], dtype=torch.float32)
        sums[self.weights.total_weight_splats.cpu().long()] = self.weights.total_weight.cpu().float()
        return sums


@dataclass(frozen=True)
class WeightRequest:
    """A request to the raster for the weights of one view, and what is needed to read its answer."""

    request: ViewRequest
    readout: Readout  # of the request's pixels
    codebook: ViewCodebook
    levels: np.ndarray  # [M] i8, as `Geometry` has them

    def weights(self, answer: ViewWeights) -> RegionWeights:
        """Return W of the view, with total weight scaled by the stride to all rays of the photo."""
        part = self.codebook.weights_by_row(answer.weights)
        rays = float(self.request.params.stride**2)
        return replace(part, views=(self.request.camera.name,), total_weight=part.total_weight * rays)


def weight_request(views: LiftViews, number: int, settings: LiftSettings, by_rows: bool) -> WeightRequest:
    """Read the view of that number, and return the request for its weights.

    Args:
        by_rows: True if each region must be a row of a codebook, False if it may be a tuple of labels (`as_regions`).
    """
    camera, features = views[number]
    observation = at_levels(features, settings.levels, camera.name)
    params = strided(settings.compositing, settings, camera, number)
    pixels = sample_pixels(camera, -(-settings.diagnostic_rays // len(views)), (settings.seed, number), params)
    regions, codebook = as_regions(observation, by_rows)
    if isinstance(features, Regions) and isinstance(observation, Regions) and codebook.tuples is None:
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
    threads: int | None = None,
    numbers: range | None = None,
    first: Sequence[int] = (),
    on_first: Callable[[Geometry], None] | None = None,
) -> Geometry:
    """Compute W of views, and sampled rows of A.

    Args:
        splats: P. views: in the order of the sums.
        by_rows: True if each region must be a row of a codebook, False if it may be a tuple of labels (`as_regions`).
        checkpoint: the raster's stored answers, to which new ones are added.
        numbers: of the views; None: all of them.
        first: numbers of the views to begin with. The result is bitwise identical for any.
        on_first: called with the geometry of these views alone, as soon as they are done. An exception from it stops
            the work.
    """
    numbers = range(len(views)) if numbers is None else numbers
    order = [*first, *sorted({*numbers} - {*first})]
    by_number = dict[int, _ViewBlock]()
    waiting = deque[WeightRequest]()

    def requests() -> Iterator[ViewRequest]:
        for number in order:
            waiting.append(weight_request(views, number, settings, by_rows))
            yield waiting[-1].request

    answers = raster.iterate_views(requests()) if checkpoint is None else checkpoint.answers(raster, requests())
    in_memory = 0
    with closing(answers):
        for number, answer in zip(order, answers, strict=True):
            request = waiting.popleft()
            part = request.weights(answer).cpu()
            in_memory += part.nbytes
            part = part if in_memory <= MEMORY_LIMIT else part.in_files()
            sample = SampledRays(answer.rows, request.readout)
            by_number[number] = _ViewBlock(part, sample, request.codebook, request.levels)
            del answer, part, request  # frees their memory before the raster computes the next one
            progress("geometry", len(by_number), len(numbers), "views")
            if on_first and len(by_number) == len(first):
                on_first(_stacked_views([by_number[view] for view in first], splats, threads))
    return _stacked_views([by_number.pop(number) for number in numbers], splats, threads)


class _ViewBlock(NamedTuple):
    """W of one view with its samples and codebook, without the observation itself."""

    weights: RegionWeights
    sample: SampledRays
    codebook: ViewCodebook
    levels: np.ndarray  # [M] i8


def _stacked_views(views: list[_ViewBlock], splats: int, threads: int | None) -> Geometry:
    """Stack W of some views, and empty the list, so that memory is freed early."""
    samples, codebook = tuple(view.sample for view in views), Codebook(tuple(view.codebook for view in views))
    blind = tuple(view.weights.views[0] for view in views if not view.weights.total_weight.numel())
    levels = np.concatenate([view.levels for view in views])
    parts = [view.weights for view in views]
    views.clear()
    W = stacked(parts, splats, threads)
    parts.clear()
    give_back_memory()
    return Geometry(W, codebook, samples, blind, levels)


def strided(params: CompositingParams, settings: LiftSettings, camera: Camera, number: int) -> CompositingParams:
    """Return the parameters with the stride, its first pixel drawn per view: no pixel is skipped in all views."""
    rng = np.random.default_rng((settings.seed, number, settings.stride))
    left, top = (int(rng.integers(min(settings.stride, side))) for side in (camera.width, camera.height))
    return replace(params, stride=settings.stride, offset=(left, top))
