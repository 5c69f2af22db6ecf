"""The order in which to encode photos, before there are features, and the coverage of the first ones.

The feature that a photo will give a splat is unknown, but its weight is not: ``e_jv``, the total weight of view v in
splat j, is the sum of the splat's weights on the view's rays, with occlusion. It is computed for sampled splats at
coarse pixels.

**Visible.** A view sees a splat if its total weight is at least VISIBLE_SHARE of the largest of any view. This rule
needs no unit. It ignores light that leaks through a surface, and accepts the same view from three times the distance.

**Order.** Each next photo adds the most to ``sum_j e_j (1 - 2^-n_j)``, with e_j the total weight of all views and n_j
the number of chosen photos that see splat j. A first photo of a splat counts a half, a second a quarter, and so on.
So unseen splats come first, then splats of a single photo, whose errors no other photo corrects. A further photo
always counts a little, so that the order has no arbitrary end. As it never counts more than the one before, the first
N photos are worth at least 1 - 1/e of the best N (Nemhauser, Wolsey and Fisher 1978).
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
from liftcore.lifting.planning.plan import PlannedScene, planned_scene, scene_warnings
from liftcore.lifting.planning.views import SAMPLE, WELL_COVERED, greedy, spaced_indices
from liftcore.raster import check_splats_and_threads, open_raster
from liftcore.raster.base import Raster, ViewRequest
from liftcore.runtime.device import CPU
from liftcore.runtime.one_line import join_names, one_line
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, shown_progress, silent
from liftcore.runtime.torch_modes import default_modes
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.splats import Splats
from liftcore.values.settings import LiftSettings
from liftcore.values.views import Regions

SIDE = 240  # pixels of an image's longer side, about: shares of weight are within .01 of those of all pixels
VISIBLE_SHARE = 0.1  # of the total weight of the view that sees a splat best
LEAST_NEW = 0.001  # of the weight: a photo that adds less adds nothing
FIRST_COUNT = 4  # photos of the first row; each next row has twice as many
SHOWN_PHOTOS = 12  # names in a line for people
ONE_REGION = Regions(torch.zeros(1, 1, 1, dtype=torch.int32), torch.ones(1, 1, dtype=torch.float32))
NO_PIXELS = torch.empty(0, 2, dtype=torch.int32)


@dataclass(frozen=True)
class PhotoCoverage:
    """Coverage of the splats by the first photos of the order."""

    photos: int  # their number
    once: float  # share of the splats' weight that at least one of them sees
    twice: float  # share that at least two of them see
    seconds: float  # estimate of the geometry of a lift with them, on this machine now


@dataclass(frozen=True)
class PhotoPlan(PlannedScene):
    """An order of photos to encode. Plain values; except for the seconds, the same inputs give the same plan."""

    order: tuple[str, ...]  # all photos, in the order to encode them
    spare: tuple[str, ...]  # of those: WELL_COVERED before them in the order see the same splats
    coverage: tuple[PhotoCoverage, ...]  # by the first 4, 8, 16, ... and all photos
    seen_share: float  # of the splats, that some photo sees
    row_sum: float  # mean sum of the weights of a ray
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        photos = f"{len(self.order)} photos", f"{len(self.spare)} of them spare", f"first {self.order[0][-40:]!r}"
        return one_line(self, f"{self.splats} of {self.kernel}", *photos, f"seen_share={self.seen_share:.3g}")

    def facts(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {**asdict(self), "photos": len(self.order)}

    def lines(self, *, verbose: bool = False) -> Iterator[str]:
        """Yield lines of the plan for people.

        Args:
            verbose: all names instead of the first ones.
        """
        limit = None if verbose else SHOWN_PHOTOS
        yield f"plan: {self.splats} splats ({self.rendered}), {len(self.order)} photos, no features yet"
        yield "  photos  see of the weight  twice or more  to look through"
        for row in self.coverage:
            seconds = f"about {max(row.seconds, 1):.0f} s"
            yield f"  {row.photos:>6}  {row.once:>17.1%}  {row.twice:>13.1%}  {seconds:>15}"
        yield f"encode first: {join_names(self.order, limit)}"
        if self.spare:
            spare_names = join_names(self.spare, limit)
            yield f"{len(self.spare)} add nothing that {WELL_COVERED} before them do not show: {spare_names}"
        yield from (f"warning: {warning}" for warning in self.warnings)


@default_modes()
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
        cameras: of all photos; every ``view_stride``-th is used.
        settings: of the later lift, for its compositing parameters. None: the defaults.
        threads: None uses the cores that this process may use. progress: as in `lift`.

    Raises:
        InvalidCameras: there is no camera.
        InvalidSettings: ``antialiased`` does not suit the splats' kernel.
    """
    settings = LiftSettings.or_default(settings)
    splats = check_splats_and_threads(splats, threads)
    settings = settings.for_splats(splats)
    all_cameras = cameras if isinstance(cameras, Cameras) else Cameras(cameras)
    views = list(all_cameras.values())[:: settings.view_stride]
    rows = spaced_indices(splats.count, min(SAMPLE, splats.count))
    raster = open_raster(splats, CPU, threads)
    with one_thread(), shown_progress(progress) as reporter:
        total_weight, row_sum = total_weight_of_views(raster, views, rows, settings, reporter)
        seconds = _seconds(raster, views[len(views) // 2], settings)
    weight, visible = total_weight.sum(axis=0, dtype=np.float64), sees(total_weight)
    order = list(photo_order(visible, weight))
    seen_share = float(visible.any(axis=0).mean())
    empty_warnings = [unseen(seen_share)] if seen_share < LEAST_IN_VIEW else []
    if not empty_warnings and row_sum < LEAST_ROW_SUM:
        empty_warnings.append(empty(row_sum))
    return PhotoPlan(
        **vars(planned_scene(splats, settings)),
        order=tuple(views[k].name for k in order),
        spare=tuple(views[k].name for k in spare_photos(visible, weight, order)),
        coverage=tuple(coverage_rows(visible, weight, order, seconds)),
        seen_share=seen_share,
        row_sum=row_sum,
        warnings=(*scene_warnings(splats, all_cameras, views, settings), *empty_warnings),
    )


def total_weight_of_views(
    raster: Raster, views: Sequence[Camera], rows: np.ndarray, settings: LiftSettings, progress: Progress = silent
) -> tuple[np.ndarray, float]:
    """Compute total weights [V, n] f32 of the views in the splats ``rows`` [n] i64, and a ray's mean sum of weights.

    At coarse pixels, each of which stands for all pixels up to the next.
    """
    view_params = [_coarse(settings, camera, number) for number, camera in enumerate(views)]
    requests = (
        ViewRequest(camera, ONE_REGION, params, settings.weighting, NO_PIXELS)
        for camera, params in zip(views, view_params, strict=True)
    )
    total_weight, view_weight = (
        np.zeros((len(views), len(rows)), np.float32),
        np.zeros(raster.splats.count, np.float32),
    )
    rays, total = 0, 0.0
    for number, answer in enumerate(raster.iterate_views(requests)):
        camera, stride = views[number], view_params[number].stride
        view_weight[:] = 0.0
        view_weight[answer.weights.total_weight_splats.numpy()] = answer.weights.total_weight.numpy()
        total_weight[number] = view_weight[rows] * stride**2
        left, top = view_params[number].offset
        rays += len(range(left, camera.width, stride)) * len(range(top, camera.height, stride))
        total += float(view_weight.sum(dtype=np.float64))
        progress("photos", number + 1, len(views), "photos")
    return total_weight, total / max(rays, 1)


def sees(total_weight: np.ndarray) -> np.ndarray:
    """Return [V, n] bool: True where the view sees the splat, by its total weight [V, n]."""
    return (total_weight > 0) & (total_weight >= VISIBLE_SHARE * total_weight.max(axis=0, initial=0.0))


def photo_order(visible: np.ndarray, weight: np.ndarray) -> Iterator[int]:
    """Order all photos: each next one adds the most; of equal ones the first comes first.

    Args:
        visible: [V, n] bool. weight: [n] f64, of the splats.
    """
    splats_of, gains = [np.flatnonzero(row) for row in visible], weight / 2  # of one more photo of a splat

    def take(photo: int) -> None:
        gains[splats_of[photo]] /= 2

    return greedy(len(splats_of), lambda photo: float(gains[splats_of[photo]].sum()), take)


def spare_photos(visible: np.ndarray, weight: np.ndarray, order: Sequence[int]) -> list[int]:
    """List photos whose splats WELL_COVERED photos before them see, except for a share LEAST_NEW of the weight."""
    view_counts, spare, total = np.zeros(visible.shape[1], np.int64), [], weight.sum()
    for photo in order:
        splats = visible[photo]
        if weight[splats & (view_counts < WELL_COVERED)].sum() <= LEAST_NEW * total:
            spare.append(photo)
        view_counts += splats
    return spare


def coverage_rows(
    visible: np.ndarray, weight: np.ndarray, order: Sequence[int], seconds: float
) -> Iterator[PhotoCoverage]:
    """Yield the coverage of the first 4, 8, 16, ... photos of the order; ``seconds`` are of one photo."""
    view_counts, total, next_row = np.zeros(visible.shape[1], np.int64), max(weight.sum(), 1e-30), FIRST_COUNT
    for count, photo in enumerate(order, start=1):
        view_counts += visible[photo]
        if count in (next_row, len(order)):
            once, twice = (float(weight[view_counts >= times].sum() / total) for times in (1, 2))
            yield PhotoCoverage(count, once, twice, count * seconds)
            next_row *= 2


def _coarse(settings: LiftSettings, camera: Camera, number: int) -> CompositingParams:
    stride = max(1, max(camera.width, camera.height) // SIDE)
    return strided(settings.lift_params, settings.model_copy(update={"stride": stride}), camera, number)


def _seconds(raster: Raster, camera: Camera, settings: LiftSettings) -> float:
    """Time the weights of one view, as an estimate for the others."""
    begin = time.perf_counter()
    params = strided(settings.lift_params, settings, camera, 0)
    raster.region_weights(camera, ONE_REGION, params, settings.weighting)
    return time.perf_counter() - begin
