"""Inputs that contradict each other: cameras, splats and features that do not belong together.

**Do views say the same of what they see?** A few views are weighed: those that a lift begins with, so that the check
costs a lift next to nothing; without a lift, views at coarse pixels, whose ratio (below) is the same within .03. Let
``c_r`` be the unit vector of region or cell r less the mean of all, by the weight that it gives. Over the splats, m
is the squared length of what all views share of what one of them says, as a share (`planning.views` has the
sums): one where views agree, and none where they say anything of it. How alike it could be, the features tell without
any geometry: each region's cosine to the most similar one of another view. The ratio of the two is .39 to .91 on the
scenes that this was made with, noisy, merged and wrong masks among them (.26 with 6 views). With positions times 0.3
it is .05 to .31, and with another scene's cameras .15 at most. Where it is low, positions times other factors are
the control: of healthy scenes these reach .42 of it at most, and of scenes whose positions are off by .3 or .5 at
least 1.4 of it (``python -m tests.benchmarks.first_hour``). Half and double come first: where the given scale has
LEAST_AGREEMENT or more and neither of these has as much, the others are not tried, which is half of the work.

A scale is named only where views agree well at it (CONVINCING): positions off by .3 to 3 come to .61 or more at the
factor that mends them. Where another cause makes views disagree (a principal point that is off, photos turned by
EXIF, masks that are missing), some factor may still help a little: nothing is blamed then.

Maps are also looked at alone (`liftcore.features.smoothness`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from liftcore.features.smoothness import some_grids, unlike_maps
from liftcore.lifting.geometry import Geometry, weigh_views
from liftcore.lifting.planning.views import PILOT_CHANNELS, SAMPLE, ViewDisagreement, spread
from liftcore.raster.base import Raster
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import silent
from liftcore.scene.cameras import Cameras
from liftcore.solve.least_squares import random_axes
from liftcore.values.lift_views import LiftViews
from liftcore.values.settings import LiftSettings

FLOWN = 8  # views that are weighed
FEWEST = 4  # and fewer say nothing
SIDE = 80  # pixels of an image's longer side, about
RAYS = 2_000  # whose sums are taken
MOST_REGIONS = 2_048  # that are compared with each other
MOST_ALONE = 0.8  # chance that two looks at a splat are from one view: beyond it, too little is seen twice
LEAST_AGREEMENT = 0.2  # of what the features allow: healthy scenes have .26 or more, foreign cameras .15 or less
LOW_AGREEMENT = 0.6  # below it, other scales are tried
NEAR_SCALES, FAR_SCALES = (0.5, 2.0), (0.25, 3.0, 4.0)  # of the cameras' positions
LEAST_GAIN = 1.25  # of another scale's agreement over the given one's: cameras near one place agree at any scale
CONVINCING = 0.55  # agreement at another scale, for it to be named as the cause
LEAST_ROW_SUM = 0.05  # in the mean: a scene of one object before nothing has a fifth or so
LEAST_IN_VIEW = 0.05  # of the splats
FRAME = (
    "cameras and splats must share a frame: look for the trainer's transform, a scale or another scene; an .spz that "
    "declares no frame may be half a turn about x away"
)
MANY_CAUSES = (
    "cameras (their frame, scale or principal points) are not those of the splats, or features not of the photos as "
    "their cameras have them (other photos, crops, turned by EXIF, masks missing)"
)
HINT = "splatlift check with the photos tells more"


def contradictions(
    raster: Raster, views: LiftViews, settings: LiftSettings, seen_share: float, weighed: Geometry | None = None
) -> list[str]:
    """List what of these inputs cannot be true together, a sentence each.

    Args:
        seen_share: of the splats, that some view can see.
        weighed: W of the views `probe_views`, where a lift has it. None: these views are weighed at coarse pixels.
    """
    warnings = unlike_maps(some_grids(views.features, views.names))
    if seen_share < LEAST_IN_VIEW:
        return [*warnings, unseen(seen_share)]
    found = agreement_of(weighed) if weighed else agreement_of_views(raster, views, settings)
    if found.row_sum is not None and found.row_sum < LEAST_ROW_SUM:
        return [*warnings, empty(found.row_sum)]
    if not warnings and found.agreement is not None:  # broken maps agree nowhere
        warnings += disagreement(raster, views, settings, found.agreement)
    return warnings


def probe_views(count: int) -> list[int]:
    """Number the views, evenly spread among ``count``, that tell whether inputs contradict each other."""
    return spread(count, min(FLOWN, count)).tolist()


class ViewAgreement(NamedTuple):
    """What a few views say of each other."""

    row_sum: float | None  # mean sum of weights of their sampled rays; None: no ray was sampled
    agreement: float | None  # of what their features allow; None: too few views, or too little that is seen twice


def unseen(seen_share: float) -> str:
    """That no camera sees the splats."""
    return f"cameras: no camera can see {1 - seen_share:.1%} of the splats; {FRAME}"


def empty(row_sum: float) -> str:
    """That rays meet nothing."""
    return f"cameras: splats fill {row_sum:.1%} of the rays of a view; {FRAME}"


def disagreement(raster: Raster, views: LiftViews, settings: LiftSettings, agreement: float) -> list[str]:
    """That views contradict each other, if they do; and the scale at which they would not."""
    if agreement >= LOW_AGREEMENT:
        return []
    known: dict[float, float] = {}
    for factors in (NEAR_SCALES, FAR_SCALES):
        if len(known) == len(NEAR_SCALES) and agreement >= max(LEAST_AGREEMENT, *known.values()):
            return []
        for factor in factors:
            found = agreement_of_views(raster, _scaled(views, factor), settings, rays=0).agreement
            if found is not None:
                known[factor] = found
    best = max(known, key=lambda factor: known[factor], default=None)
    what = f"views agree on what they see to {max(agreement, 0):.0%} of what their most similar regions would allow"
    is_better = best is not None and known[best] > max(LEAST_AGREEMENT, LEAST_GAIN * agreement)
    if best is not None and is_better and known[best] >= CONVINCING:
        return [f"cameras: {what}, and to {known[best]:.0%} with positions times about {best:g}; {FRAME}"]
    return [f"features: {what}: {MANY_CAUSES}; {HINT}"] if is_better or agreement < LEAST_AGREEMENT else []


def _scaled(views: LiftViews, factor: float) -> LiftViews:
    """Those views that are looked at, their cameras' positions times a factor."""
    scale = np.ones((4, 4))
    scale[:3, 3] = factor
    names = evenly_spaced(views.names, FLOWN)
    cameras = [views.cameras[name].replace(viewmat=views.cameras[name].viewmat * scale) for name in names]
    return replace(views, names=names, cameras=Cameras(cameras))


def agreement_of_views(
    raster: Raster, views: LiftViews, settings: LiftSettings, *, rays: int = RAYS
) -> ViewAgreement:
    """Weigh a few views at coarse pixels, and tell how far they agree.

    Args:
        rays: of all of them, whose sums of weights are taken.
    """
    few = views.only(evenly_spaced(views.names, FLOWN))
    longest = max(max(few.camera(k).width, few.camera(k).height) for k in range(len(few)))
    coarse = {"stride": max(1, longest // SIDE), "certificate_rays": rays, "robust_steps": 0, "consensus": False}
    own = settings.model_copy(update=coarse)
    with one_thread():
        return agreement_of(weigh_views(raster, raster.splats.count, few, own, silent, by_rows=False))


def agreement_of(geometry: Geometry) -> ViewAgreement:
    """Tell how far the views of W agree."""
    sums = sum(float(sample.rows.weights.sum()) for sample in geometry.samples)
    rays = sum(len(sample.rows.indptr) - 1 for sample in geometry.samples)
    agreement = None if len(geometry.samples) < FEWEST else _agreement_of(geometry)
    return ViewAgreement(sums / rays if rays else None, agreement)


def _agreement_of(geometry: Geometry) -> float | None:
    W, books = geometry.weights.cpu(), geometry.codebook.views
    mass = torch.zeros(sum(book.regions for book in books), dtype=torch.float32).index_add_(
        0, W.region.long(), W.weight
    )
    if not bool(mass.any()):
        return None
    owner = torch.cat([torch.full((book.regions,), number) for number, book in enumerate(books)])
    # Views that show one region alone tell nothing apart: theirs is the pack's fault, or nothing is there.
    if int((torch.bincount(owner[mass > 0], minlength=len(books)) > 1).sum()) < FEWEST:
        return None
    read = torch.nn.functional.normalize(torch.cat([book.means(book.rows.float()) for book in books]), dim=1)
    read = read - (mass / mass.sum()) @ read
    channels, rows = read.shape[1], torch.from_numpy(spread(len(W.indptr) - 1, min(SAMPLE, len(W.indptr) - 1)))
    said = ViewDisagreement(W, read @ random_axes(channels, min(PILOT_CHANNELS, channels), 0), rows)
    if not said.weights.any():
        return None
    alone, together, once = said.means(said.weights)
    chosen = torch.nonzero(mass)[:, 0]
    if len(chosen) > MOST_REGIONS:  # by their weight, so that each of them counts alike
        chosen = chosen[torch.argsort(mass[chosen], descending=True)[:MOST_REGIONS]]
    own = read[chosen]
    cosines = torch.where(owner[chosen][:, None] == owner[chosen][None], -torch.inf, own @ own.T)
    best, weight = cosines.max(dim=1).values, mass[chosen]
    possible = float((weight * best).sum() / (weight * own.square().sum(dim=1)).sum())
    if once > MOST_ALONE or alone <= 0 or not possible > 0:
        return None
    return (together - once * alone) / (1 - once) / alone / possible


def evenly_spaced(names: Sequence[str], count: int) -> list[str]:
    """As many of the names, evenly spread."""
    return [names[int(place)] for place in spread(len(names), min(count, len(names)))]
