"""The choice of views for a lift: the visible splats of each, the views that cover the scene, and how many suffice.

**Visible** splats are those that the raster's projection puts into the image, on a sample of the splats. Occlusion is
ignored: a splat behind others counts as visible.

**Coverage.** The influence of a view on a splat is estimated by the area of its footprint, which the sum of weights
follows. Let ``s_jd`` be the share of splat j's area over all views that lies in the chosen views from direction d.
Views are chosen greedily for the largest ``sum_jd sqrt(s_jd)``: with the root, the first views from a direction count
more than the last. Directions stand for occlusion: a splat may be hidden in one view, but some view from each
direction sees what is visible from there.

The gain of a view only decreases as others are chosen. So gains are evaluated lazily, in the order of the last known
gain: of 300 views a choice evaluates a few, over ORDER_SPLATS splats.

**Number of views.** How near the features of some views come to those of all depends on the disagreement of views,
which footprints do not show. Where encoders and masks agree, a part of the views suffices; where a feature depends on
single views, each counts. Assume that every view adds an independent error of variance v to a feature of length one,
and that view i holds the share q_i of a splat's weight. Then the squared length of its feature is ``1 + v B`` with
``B = sum_i q_i^2`` (one over the number of views, if their weights are equal). Of this, ``d = v B / (1 + v B)`` is
error. Views with the share s of its weight give a feature with an expected cosine c to that of all views:

    c^2 = s / (s + d (1 - s)).

A splat in none of these views has s = 0 and c = 0, so that the mean cosine includes coverage.

Before a lift, s and B are estimated by footprints: areas in place of weights. The variance v and occlusion are
estimated from NOISE_VIEWS evenly spaced views of the full scene at coarse pixels. Three means over the sampled
splats, weighted by total weight, are needed: S of the squared length of a single view's feature, M of the squared
length of the combined feature of these views, and b, the B of these views. As ``S = m + e`` and ``M = m + e b`` for
features of squared length m and errors of variance e, ``e = (S - M) / (1 - b)`` and ``v = e / (S - e)``. b is the
chance that two observations of a splat are from one view. It rises as views are left out: for K of V views it is ``B
/ (B + (1 - B) (K - 1) / (V - 1))``. Solved for B, this corrects the B by areas for occlusion. Vectors are compared in
NOISE_CHANNELS random projections.
"""

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from liftcore.lifting.geometry import Geometry, weigh_views
from liftcore.raster import open_raster
from liftcore.raster.base import Raster
from liftcore.runtime.device import CPU
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import silent
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.splats import Splats
from liftcore.solve.optimum import random_axes
from liftcore.values.lift_views import LiftViews
from liftcore.values.region_weights import RegionWeights, segment_sums
from liftcore.values.settings import LiftSettings

T = TypeVar("T")
SAMPLE = 16_384  # splats at most; a view of them takes a millisecond
ORDER_SPLATS = 4_096  # at most: 300 views are in order after .3 s, where 16,384 take 1 s
SIDES = 24  # directions of view: three of each octant
NOISE_SIDE = 160  # pixels of an image's longer side, about
NOISE_CHANNELS = 64
NOISE_VIEWS = 12


@dataclass(frozen=True)
class Visibility:
    """The areas of the sampled splats in each view."""

    areas: np.ndarray  # [V, n] f32, px^2 of the footprint's outline, at most the image's; 0 where it is not in it
    centres: np.ndarray  # [V, 3] f64, of the cameras, about the splats' origin as the means are
    means: np.ndarray  # [n, 3] f32, of the splats
    splats: int  # P, of which n are sampled evenly

    @property
    def in_view(self) -> np.ndarray:
        """[V, n] bool, True where the view can see the splat."""
        return self.areas > 0

    def of(self, views: Sequence[int]) -> "Visibility":
        """Select views."""
        return Visibility(self.areas[views], self.centres[views], self.means, self.splats)

    @property
    def seen_share(self) -> float:
        """The share of the splats that some view can see."""
        return float(self.in_view.any(axis=0).mean())

    @property
    def splats_a_view(self) -> float:
        """The mean number of splats, of all P, that a view can see."""
        return float(self.in_view.mean()) * self.splats


def visibility(
    splats: Splats, cameras: Sequence[Camera], params: CompositingParams, threads: int | None = None
) -> Visibility:
    """Project evenly spaced splats, SAMPLE at most, into every camera."""
    sample = splats[spaced_indices(splats.count, min(SAMPLE, splats.count))]
    raster = open_raster(sample, CPU, threads)
    areas = np.zeros((len(cameras), sample.count), np.float32)
    for row, camera in zip(areas, cameras, strict=True):
        row[:] = raster.footprints(camera, params).numpy()
    centres = np.array([camera.about(splats.origin).centre for camera in cameras], np.float64).reshape(-1, 3)
    return Visibility(areas, centres, sample.means.numpy(), splats.count)


def evenly_spaced(items: Sequence[T], limit: int) -> list[T]:
    """Select at most ``limit`` evenly spaced items, with the first and the last."""
    return [items[int(index)] for index in spaced_indices(len(items), min(limit, len(items)))]


def spaced_indices(total: int, count: int) -> np.ndarray:
    """Return [count] i64: evenly spaced numbers below ``total``, with the first and the last."""
    return np.linspace(0, total - 1, count).astype(np.int64)


def view_order(visible: Visibility) -> Iterator[int]:
    """Order all views greedily: each next view adds the most coverage; of equal views the first comes first."""
    step = -(-visible.areas.shape[1] // ORDER_SPLATS)
    areas, means = visible.areas[:, ::step], visible.means[::step]
    totals = areas.sum(axis=0, dtype=np.float64)
    shares = np.divide(areas, totals, out=np.zeros(areas.shape, np.float32), where=totals > 0)
    splats_of = [np.flatnonzero(row) for row in shares]
    view_shares = [row[splats] for row, splats in zip(shares, splats_of, strict=True)]
    side_rows = [
        SIDES * splats + side_of(centre - means[splats])
        for centre, splats in zip(visible.centres, splats_of, strict=True)
    ]
    covered_area, roots = np.zeros((2, len(means) * SIDES), np.float32)

    def gain(view: int) -> float:
        before = side_rows[view]
        return float((np.sqrt(covered_area[before] + view_shares[view]) - roots[before]).sum(dtype=np.float64))

    def take(view: int) -> None:
        covered_area[side_rows[view]] += view_shares[view]
        roots[side_rows[view]] = np.sqrt(covered_area[side_rows[view]])

    return greedy(len(splats_of), gain, take)


def greedy(count: int, gain: Callable[[int], float], take: Callable[[int], None]) -> Iterator[int]:
    """Order all numbers below ``count`` greedily: each next number has the largest gain; of equal ones the first.

    Args:
        gain: of a number, given those before it; it never grows. take: called with each number as it is chosen.
    """
    queue = [(-gain(number), number) for number in range(count)]
    heapq.heapify(queue)
    while queue:
        _, number = queue[0]
        now = (-gain(number), number)
        if len(queue) > 1 and now > min(queue[1:3]):
            heapq.heapreplace(queue, now)
            continue
        heapq.heappop(queue)
        take(number)
        yield number


def side_of(directions: np.ndarray) -> np.ndarray:
    """Return the bin [n] i64, below SIDES, of directions [n, 3]: the octant, and the longest component in it."""
    octants = (directions > 0) @ np.array([1, 2, 4])
    return 3 * octants + np.abs(directions).argmax(axis=1)


def count_covering_views(visible: Visibility, order: Sequence[int], times: int) -> int:
    """Count the first views of the order, one at least, that see each splat ``times`` times in the mean.

    If even all of them do not, all. Splats that no view sees do not count.
    """
    in_view = visible.in_view
    target = times * int(in_view.any(axis=0).sum())
    counts = in_view.sum(axis=1)[list(order)].cumsum()
    return min(len(order), int(np.searchsorted(counts, target)) + 1)


@dataclass(frozen=True)
class ViewNoiseEstimate:
    """The expected errors of features by view noise, for choosing how many views to lift."""

    areas: np.ndarray  # [V, n] f32, of the sampled splats in all views
    errors: np.ndarray  # [n] f64, d: the share of errors in the squared lengths of the features of all views
    weights: np.ndarray  # [n] f64, the total weight of all views, in any unit

    def cosines(self, order: Sequence[int]) -> Iterator[float]:
        """Yield the expected mean cosine to all views of the first view of the order, of the first two, and so on."""
        totals, covered_area = self.areas.sum(axis=0, dtype=np.float64), np.zeros(self.areas.shape[1])
        weights = self.weights / self.weights.sum()
        for view in order:
            covered_area += self.areas[view]
            share = _ratio(covered_area, totals).clip(max=1.0)
            yield float(weights @ np.sqrt(_ratio(share, share + self.errors * (1.0 - share))))

    def views_for(self, cosine: float, order: Sequence[int], least: int = 1) -> tuple[int, float]:
        """Count the first views of the order, ``least`` or more, that reach a mean cosine; return their cosine too.

        All of them if no fewer do.
        """
        expected = 1.0
        for count, expected in enumerate(self.cosines(order), start=1):
            if count >= least and expected >= cosine:
                return count, expected
        return len(order), expected


def weigh_coarsely(
    raster: Raster, views: LiftViews, count: int, side: int, rays: int, settings: LiftSettings
) -> Geometry:
    """Compute W of ``count`` evenly spaced views, at coarse pixels: about ``side`` on an image's longer side.

    Args:
        rays: sampled of all of them.
    """
    few = views.only(evenly_spaced(views.names, count))
    longest = max(max(few.camera(k).width, few.camera(k).height) for k in range(len(few)))
    coarse = {"stride": max(1, longest // side), "diagnostic_rays": rays}
    return weigh_views(raster, raster.splats.count, few, settings.model_copy(update=coarse), silent, by_rows=False)


@one_thread()
def estimate_view_noise(
    raster: Raster, views: LiftViews, settings: LiftSettings, visible: Visibility
) -> ViewNoiseEstimate:
    """Estimate the noise of features from evenly spaced views, two at least; ``visible`` is of all views."""
    total, count = len(views.names), min(NOISE_VIEWS, len(views.names))
    sample: list[int] = spaced_indices(total, count).tolist()
    channels = views.features.channels
    axes = random_axes(channels, min(NOISE_CHANNELS, channels), settings.seed)
    rows = spaced_indices(raster.splats.count, visible.areas.shape[1])
    geometry = weigh_coarsely(raster, views, count, NOISE_SIDE, 0, settings)
    means = [view.means(view.rows.float() @ axes) for view in geometry.codebook.views]
    disagreement = ViewDisagreement(geometry.weights, torch.cat(means), torch.from_numpy(rows))
    total_weight = _total_weight(geometry.total_weight().numpy()[rows], visible.areas, visible.areas[sample])
    if not total_weight.any():  # no ray hits a splat: there is no estimate
        return ViewNoiseEstimate(visible.areas, np.ones(len(total_weight)), np.ones(len(total_weight)))
    variance, same_view_share = disagreement.disagreement(total_weight)
    # B, in the mean.
    share = same_view_share / (same_view_share + (1.0 - same_view_share) * (total - 1) / (count - 1))
    by_area = _ratio(
        (visible.areas.astype(np.float64) ** 2).sum(axis=0), visible.areas.sum(axis=0, dtype=np.float64) ** 2
    )
    return ViewNoiseEstimate(
        visible.areas, _errors(variance, by_area * share / _mean(by_area, total_weight)), total_weight
    )


class ViewDisagreement:
    """Sums over views of the features that each view alone gives some splats."""

    def __init__(self, W: RegionWeights, means: Tensor, rows: Tensor) -> None:
        """Args: means: [M, C] f32, features of all regions. rows: [n] i64, the splats."""
        starts, entries = W.take(rows)
        region, weight = W.region[entries], W.weight[entries]
        runs, row = W.runs(starts, region)
        by_run = csr_array((weight.double().numpy(), region.numpy(), runs.numpy()), shape=(len(row), len(means)))
        sums, total = torch.from_numpy(by_run @ means.double().numpy()), segment_sums(weight, runs)
        of_rows = torch.searchsorted(row, torch.arange(len(rows) + 1))
        squares = torch.where(total > 0, sums.square().sum(dim=1) / total, 0.0)
        self.weights, self._squared_weights, self._squares = (
            segment_sums(part, of_rows).numpy() for part in (total, total.square(), squares)
        )
        ones, numbers = np.ones(len(row)), np.arange(len(row))
        self._vectors = csr_array((ones, numbers, of_rows.numpy()), shape=(len(rows), len(row))) @ sums.numpy()

    def means(self, weights: np.ndarray) -> tuple[float, float, float]:
        """Return S, M and b: means over the splats that a labelled ray hits, at least one of which has a weight.

        Args:
            weights: [n], of the splats.

        Returns:
            The mean squared length of a single view's feature, that of the combined feature, and the chance that two
            observations are from one view.
        """
        hit, total = self.weights > 0, self.weights**2
        means = (
            _ratio(self._squares, self.weights),
            _ratio((self._vectors**2).sum(axis=1), total),
            _ratio(self._squared_weights, total),
        )
        single, combined, same_view_share = (_mean(values[hit], weights[hit]) for values in means)
        return single, combined, same_view_share

    def disagreement(self, total_weight: np.ndarray) -> tuple[float, float]:
        """Return v, infinite if the views have nothing in common, and b, over the splats that a labelled ray hits."""
        if not (total_weight[self.weights > 0] > 0).any():
            return np.inf, 1.0
        single, combined, same_view_share = self.means(total_weight)
        if same_view_share >= 1.0:
            return np.inf, 1.0
        error = max(0.0, single - combined) / (1.0 - same_view_share)
        return (error / (single - error) if error < single else np.inf), same_view_share


def _total_weight(sample_weight: np.ndarray, areas: np.ndarray, sample_areas: np.ndarray) -> np.ndarray:
    """Estimate the total weight of all views [n] f64 from that of the sample, in proportion to a splat's areas.

    Splats that the sample does not see get the mean proportion.
    """
    area_sums = sample_areas.sum(axis=0, dtype=np.float64)
    per_area = np.divide(
        sample_weight,
        area_sums,
        out=np.full(len(sample_weight), sample_weight.sum() / max(area_sums.sum(), 1.0)),
        where=area_sums > 0,
    )
    return per_area * areas.sum(axis=0, dtype=np.float64)


def _errors(variance: float, shares: np.ndarray) -> np.ndarray:
    """Compute d of the splats from v and their B."""
    return variance * shares / (1.0 + variance * shares) if np.isfinite(variance) else np.ones(len(shares))


def _mean(values: np.ndarray, weights: np.ndarray) -> float:
    return float((values * weights).sum() / weights.sum())


def _ratio(values: np.ndarray, divisors: np.ndarray) -> np.ndarray:
    """Divide; 0 where the divisor is 0."""
    return np.divide(values, divisors, out=np.zeros(np.shape(values)), where=divisors > 0)
