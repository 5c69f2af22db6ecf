"""Inputs that contradict each other: cameras, splats and features that do not belong together.

**Consistency of views.** W of a few views is needed: of those that a lift begins with, so that the check costs a lift
almost nothing; without a lift, of views at coarse pixels, whose ratio (below) is the same within .03. Let ``c_r`` be
the unit vector of region or cell r minus the mean of all, weighted. Over the splats, m is the squared length of the
part of a view's feature that all views share, as a share of the squared length of a single view's feature
(`planning.views` has the sums): 1 where views agree, 0 where they are unrelated. Its upper limit follows from the
features without any geometry: each region's cosine to the most similar region of another view. The ratio of the two
is .39 to .91 on the scenes of the first tests, which include noisy, merged and wrong masks (.26 with 6 views). With
positions times 0.3 it is .05 to .31, and with another scene's cameras .15 at most.

Maps are also checked alone (`liftcore.features.smoothness`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from liftcore.features.smoothness import some_grids, unlike_maps
from liftcore.lifting.geometry import Geometry
from liftcore.lifting.planning.views import NOISE_CHANNELS, SAMPLE, ViewDisagreement, spaced_indices, weigh_coarsely
from liftcore.raster.base import Raster
from liftcore.runtime.one_thread import one_thread
from liftcore.solve.optimum import random_axes
from liftcore.values.lift_views import LiftViews
from liftcore.values.settings import LiftSettings

PROBE_VIEWS = 8  # views that are compared
MIN_VIEWS = 4  # fewer give no result
SIDE = 80  # pixels of an image's longer side, about
RAYS = 2_000  # whose sums of weights are averaged
MAX_REGIONS = 2_048  # that are compared with each other
MAX_SAME_VIEW = 0.8  # chance that two observations of a splat are from one view: beyond it, overlap is too small
LEAST_AGREEMENT = 0.2  # of what the features allow: healthy scenes have .26 or more, foreign cameras .15 or less
LEAST_ROW_SUM = 0.05  # in the mean: a scene of one object without a background has about 0.2
LEAST_IN_VIEW = 0.05  # of the splats
FRAME = (
    "cameras and splats must share a frame: look for the trainer's transform, a scale or another scene; an .spz that "
    "declares no frame may be half a turn about x away"
)
MANY_CAUSES = (
    "cameras (their frame, scale or principal points) are not those of the splats, or features not of the photos as "
    "their cameras have them (other photos, crops, turned by EXIF, masks missing)"
)
HINT = "run splatlift check with the photos for more"


def contradictions(
    raster: Raster, views: LiftViews, settings: LiftSettings, seen_share: float, geometry: Geometry | None = None
) -> list[str]:
    """List contradictions between these inputs, a sentence each.

    Args:
        seen_share: of the splats, that some view can see.
        geometry: W of the views `probe_views`, if a lift has it. None: it is computed at coarse pixels.
    """
    warnings = unlike_maps(some_grids(views.features, views.names))
    if seen_share < LEAST_IN_VIEW:
        return [*warnings, unseen(seen_share)]
    consistency = agreement_of(geometry) if geometry else agreement_of_views(raster, views, settings)
    if consistency.row_sum is not None and consistency.row_sum < LEAST_ROW_SUM:
        return [*warnings, empty(consistency.row_sum)]
    if not warnings and consistency.agreement is not None:  # broken maps agree nowhere
        warnings += disagreement(consistency.agreement)
    return warnings


def probe_views(count: int) -> list[int]:
    """Return the numbers of the views, evenly spread among ``count``, that are checked for contradictions."""
    return spaced_indices(count, min(PROBE_VIEWS, count)).tolist()


class ViewAgreement(NamedTuple):
    """The consistency of a few views."""

    row_sum: float | None  # mean sum of weights of their sampled rays; None: no ray was sampled
    agreement: float | None  # as a share of what their features allow; None: too few views, or too little overlap


def unseen(seen_share: float) -> str:
    """Return the message that no camera sees the splats."""
    return f"cameras: no camera can see {1 - seen_share:.1%} of the splats; {FRAME}"


def empty(row_sum: float) -> str:
    """Return the message that rays hit almost no splat."""
    return f"cameras: splats fill {row_sum:.1%} of the rays of a view; {FRAME}"


def disagreement(agreement: float) -> list[str]:
    """Report views that contradict each other; empty if they agree."""
    if agreement >= LEAST_AGREEMENT:
        return []
    finding = (
        f"views agree on what they see to {max(agreement, 0):.0%} of what their most similar regions would allow"
    )
    return [f"features: {finding}: {MANY_CAUSES}; {HINT}"]


@one_thread()
def agreement_of_views(raster: Raster, views: LiftViews, settings: LiftSettings) -> ViewAgreement:
    """Compute W of a few views at coarse pixels, and measure their consistency."""
    return agreement_of(weigh_coarsely(raster, views, PROBE_VIEWS, SIDE, RAYS, settings))


def agreement_of(geometry: Geometry) -> ViewAgreement:
    """Measure the consistency of the views of W."""
    sums = sum(float(sample.rows.weights.sum()) for sample in geometry.samples)
    rays = sum(len(sample.rows.indptr) - 1 for sample in geometry.samples)
    agreement = None if len(geometry.samples) < MIN_VIEWS else _agreement_of(geometry)
    return ViewAgreement(sums / rays if rays else None, agreement)


def _agreement_of(geometry: Geometry) -> float | None:
    W, books = geometry.weights.cpu(), geometry.codebook.views
    mass = torch.zeros(sum(book.regions for book in books), dtype=torch.float32).index_add_(
        0, W.region.long(), W.weight
    )
    if not bool(mass.any()):
        return None
    owner = torch.cat([torch.full((book.regions,), number) for number, book in enumerate(books)])
    # Views with a single region cannot disagree: their masks are missing, or nothing is there.
    if int((torch.bincount(owner[mass > 0], minlength=len(books)) > 1).sum()) < MIN_VIEWS:
        return None
    unit_means = torch.nn.functional.normalize(torch.cat([book.means(book.rows.float()) for book in books]), dim=1)
    unit_means = unit_means - (mass / mass.sum()) @ unit_means
    channels, rows = (
        unit_means.shape[1],
        torch.from_numpy(spaced_indices(len(W.indptr) - 1, min(SAMPLE, len(W.indptr) - 1))),
    )
    disagreement = ViewDisagreement(W, unit_means @ random_axes(channels, min(NOISE_CHANNELS, channels), 0), rows)
    if not disagreement.weights.any():
        return None
    single, combined, same_view_share = disagreement.means(disagreement.weights)
    regions = torch.nonzero(mass)[:, 0]
    if len(regions) > MAX_REGIONS:  # those of the largest weight
        regions = regions[torch.argsort(mass[regions], descending=True)[:MAX_REGIONS]]
    means = unit_means[regions]
    cosines = torch.where(owner[regions][:, None] == owner[regions][None], -torch.inf, means @ means.T)
    best, weight = cosines.max(dim=1).values, mass[regions]
    possible = float((weight * best).sum() / (weight * means.square().sum(dim=1)).sum())
    if same_view_share > MAX_SAME_VIEW or single <= 0 or not possible > 0:
        return None
    return (combined - same_view_share * single) / (1 - same_view_share) / single / possible
