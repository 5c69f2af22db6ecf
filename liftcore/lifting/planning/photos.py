"""Which photos to encode first, before there is a feature of any, and what fewer of them would show.

What a photo will say of a splat is unknown, but not how much: ``e_jv``, the evidence of view v in splat j, is the sum
of the splat's weights on the view's rays, with all that hides it. It is found for sampled splats at coarse pixels.

**Seen.** A view sees a splat where it has SEEN of the evidence that the best view has of it, or more. That needs no
unit: it leaves out what leaks through a surface, and keeps the same look from three times as far.

**The order.** Each next photo adds the most to ``sum_j e_j (1 - 2^-n_j)``, e_j the evidence of all views and n_j the
number of chosen photos that see splat j. A first look counts a half, a second a quarter, and so on: what nobody has
seen comes first, then what one photo alone has seen, whose mistakes no other can tell. No splat is ever done with, so
that the order has no arbitrary end. As a further look never counts more than the one before, the first N photos are
worth at least 1 - 1/e of the best N (Nemhauser, Wolsey and Fisher 1978).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from liftcore.lifting.geometry import strided
from liftcore.lifting.planning.contradictions import LEAST_IN_VIEW, LEAST_ROW_SUM, empty, unseen
from liftcore.lifting.planning.plan import PlannedScene, first_names, planned_scene, scene_warnings
from liftcore.lifting.planning.views import SAMPLE, WELL_COVERED, greedy, spread
from liftcore.raster import check_given, open_raster
from liftcore.raster.base import Raster, ViewRequest
from liftcore.runtime.device import CPU
from liftcore.runtime.one_line import one_line
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, shown_progress, silent
from liftcore.runtime.torch_modes import usual_modes
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.splats import Splats
from liftcore.values.settings import LiftSettings
from liftcore.values.views import Regions

SIDE = 240  # pixels of an image's longer side, about: shares of weight are within .01 of those of all pixels
SEEN = 0.1  # of the evidence of the view that sees a splat best
LEAST_NEW = 0.001  # of the weight: a photo that adds less adds nothing
FIRST_COUNT = 4  # photos of the first row; each further row has twice as many
SHOWN_PHOTOS = 12  # names in a line for people
ONE_REGION = Regions(torch.zeros(1, 1, 1, dtype=torch.int32), torch.ones(1, 1, dtype=torch.float32))
NO_PIXELS = torch.empty(0, 2, dtype=torch.int32)


@dataclass(frozen=True)
class Shown:
    """What the first photos of the order show."""

    photos: int
    once: float  # of the splats' weight, the share that one of them sees at least
    twice: float  # that two of them see
    seconds: float  # that a lift takes to look through them on this machine today, about


@dataclass(frozen=True)
class PhotoPlan(PlannedScene):
    """Which photos to encode first. Plain values; but for the seconds, the same inputs give the same plan."""

    order: tuple[str, ...]  # all photos, the one to encode first at first
    spare: tuple[str, ...]  # of those: what they see, WELL_COVERED before them in the order see too
    shown: tuple[Shown, ...]  # by the first 4, 8, 16, ... and all of them
    seen_share: float  # of the splats, that some photo sees
    row_sum: float  # mean sum of the weights of a ray
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        photos = f"{len(self.order)} photos", f"{len(self.spare)} of them spare", f"first {self.order[0][-40:]!r}"
        return one_line(self, f"{self.splats} of {self.kernel}", *photos, f"seen_share={self.seen_share:.3g}")

    def facts(self) -> dict[str, Any]:
        """Plain values, as JSON has them."""
        return {**asdict(self), "photos": len(self.order)}

    def lines(self, *, verbose: bool = False) -> Iterator[str]:
        """The plan for people.

        Args:
            verbose: all names, not the first ones.
        """
        most = None if verbose else SHOWN_PHOTOS
        yield f"plan: {self.splats} splats ({self.rendered}), {len(self.order)} photos, no features yet"
        yield "  photos  see of the weight  twice or more  to look through"
        for row in self.shown:
            seconds = f"about {max(row.seconds, 1):.0f} s"
            yield f"  {row.photos:>6}  {row.once:>17.1%}  {row.twice:>13.1%}  {seconds:>15}"
        yield f"encode first: {first_names(self.order, most)}"
        if self.spare:
            named = first_names(self.spare, most)
            yield f"{len(self.spare)} add nothing that {WELL_COVERED} before them do not show: {named}"
        yield from (f"warning: {warning}" for warning in self.warnings)


@usual_modes()
def plan_photos(
    splats: Splats,
    cameras: Cameras | Mapping[str, Camera],
    settings: LiftSettings | None = None,
    *,
    threads: int | None = None,
    progress: Progress | bool | None = None,
) -> PhotoPlan:
    """Order the photos of a scene by what each adds to those before it; no feature is needed.

    Args:
        cameras: of the photos that there are; every ``view_stride``-th is looked at.
        settings: of the lift that is to come; its compositing parameters count. None: the default ones.
        threads: None takes the cores that this process may use. progress: as `lift` has it.

    Raises:
        InvalidCameras: there is no camera.
        InvalidSettings: ``antialiased`` does not suit the splats' kernel.
    """
    settings = LiftSettings.or_default(settings)
    splats = check_given(splats, threads)
    settings = settings.for_splats(splats)
    known = cameras if isinstance(cameras, Cameras) else Cameras(cameras)
    views = list(known.values())[:: settings.view_stride]
    rows = spread(splats.count, min(SAMPLE, splats.count))
    raster = open_raster(splats, CPU, threads)
    with one_thread(), shown_progress(progress) as reporter:
        evidence, row_sum = evidence_of_views(raster, views, rows, settings, reporter)
        seconds = _seconds(raster, views[len(views) // 2], settings)
    weight, seen = evidence.sum(axis=0, dtype=np.float64), sees(evidence)
    order = list(photo_order(seen, weight))
    seen_share = float(seen.any(axis=0).mean())
    told = [unseen(seen_share)] if seen_share < LEAST_IN_VIEW else []
    if not told and row_sum < LEAST_ROW_SUM:
        told.append(empty(row_sum))
    return PhotoPlan(
        **vars(planned_scene(splats, settings)),
        order=tuple(views[k].name for k in order),
        spare=tuple(views[k].name for k in spare_photos(seen, weight, order)),
        shown=tuple(shown_by(seen, weight, order, seconds)),
        seen_share=seen_share,
        row_sum=row_sum,
        warnings=(*scene_warnings(splats, known, views, settings), *told),
    )


def evidence_of_views(
    raster: Raster, views: Sequence[Camera], rows: np.ndarray, settings: LiftSettings, progress: Progress = silent
) -> tuple[np.ndarray, float]:
    """Evidence [V, n] f32 of the views in the splats ``rows`` [n] i64, and the mean sum of weights of a ray.

    Found at coarse pixels, each of which stands for those between it and the next.
    """
    walks = [_coarse(settings, camera, number) for number, camera in enumerate(views)]
    requests = (
        ViewRequest(camera, ONE_REGION, params, settings.weighting, NO_PIXELS)
        for camera, params in zip(views, walks, strict=True)
    )
    evidence, every = np.zeros((len(views), len(rows)), np.float32), np.zeros(raster.splats.count, np.float32)
    rays, sums = 0, 0.0
    for number, found in enumerate(raster.iterate_views(requests)):
        camera, stride = views[number], walks[number].stride
        every[:] = 0.0
        every[found.weights.evidence_splats.numpy()] = found.weights.evidence.numpy()
        evidence[number] = every[rows] * stride**2
        left, top = walks[number].offset
        rays += len(range(left, camera.width, stride)) * len(range(top, camera.height, stride))
        sums += float(every.sum(dtype=np.float64))
        progress("photos", number + 1, len(views), "photos")
    return evidence, sums / max(rays, 1)


def sees(evidence: np.ndarray) -> np.ndarray:
    """[V, n] bool: which view sees which splat, by their evidence [V, n]."""
    return (evidence > 0) & (evidence >= SEEN * evidence.max(axis=0, initial=0.0))


def photo_order(seen: np.ndarray, weight: np.ndarray) -> Iterator[int]:
    """All photos, each next one adding the most. Of equal ones the first is taken.

    Args:
        seen: [V, n] bool. weight: [n] f64, of the splats.
    """
    shown, left = [np.flatnonzero(row) for row in seen], weight / 2  # what a further look at a splat counts

    def take(photo: int) -> None:
        left[shown[photo]] /= 2

    return greedy(len(shown), lambda photo: float(left[shown[photo]].sum()), take)


def spare_photos(seen: np.ndarray, weight: np.ndarray, order: Sequence[int]) -> list[int]:
    """Photos that add nothing to those before them: what they see, WELL_COVERED of those see, but for LEAST_NEW."""
    looks, spare, whole = np.zeros(seen.shape[1], np.int64), [], weight.sum()
    for photo in order:
        own = seen[photo]
        if weight[own & (looks < WELL_COVERED)].sum() <= LEAST_NEW * whole:
            spare.append(photo)
        looks += own
    return spare


def shown_by(seen: np.ndarray, weight: np.ndarray, order: Sequence[int], seconds: float) -> Iterator[Shown]:
    """What the first photos of the order show, twice as many a row; ``seconds`` are of one photo."""
    looks, whole, wanted = np.zeros(seen.shape[1], np.int64), max(weight.sum(), 1e-30), FIRST_COUNT
    for count, photo in enumerate(order, start=1):
        looks += seen[photo]
        if count in (wanted, len(order)):
            once, twice = (float(weight[looks >= times].sum() / whole) for times in (1, 2))
            yield Shown(count, once, twice, count * seconds)
            wanted *= 2


def _coarse(settings: LiftSettings, camera: Camera, number: int) -> CompositingParams:
    stride = max(1, max(camera.width, camera.height) // SIDE)
    return strided(settings.lift_params, settings.model_copy(update={"stride": stride}), camera, number)


def _seconds(raster: Raster, camera: Camera, settings: LiftSettings) -> float:
    """About how long a lift looks at a view like this one."""
    begin = time.perf_counter()
    params = strided(settings.lift_params, settings, camera, 0)
    raster.region_weights(camera, ONE_REGION, params, settings.weighting)
    return time.perf_counter() - begin
