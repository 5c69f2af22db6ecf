"""Which views a lift takes: what each can see, which cover the splats, and how many come near to all of them.

**Visible** is what the raster's own projection puts into the image, on a sample of the splats: whatever it would
blend is counted, and what other splats hide is counted too.

**Coverage.** A view's pull on a splat is its footprint's area there, as the sum of weights is about that. With
``s_jd`` the share of splat j's area over all views that the chosen ones hold which look from the side d, views are
chosen greedily for the largest ``sum_jd sqrt(s_jd)``: the root makes the first views of a side count more than its
last. Sides stand for what is hidden: a footprint in the image may lie behind another, but some view from each side
sees what can be seen.

The gain of a view only shrinks as others are chosen. So gains are looked at lazily, from the largest that was ever
found on: of 300 views a choice asks for the gain of a few, over ORDER_SPLATS splats.

**How many.** How near the features of some views come to those of all depends on how much the views disagree, which
no footprint says: where encoders and masks agree, a part of the views will do, and where a feature is mostly what one
view made of it, the last view counts. Say that every view adds an error of its own, of variance v beside a feature of
length one, and that the share q_i of a splat's weight lies in view i. Then the squared length of its feature is ``1 +
v B`` with ``B = sum_i q_i^2`` (one over the number of views, where they weigh alike), of which ``d = v B / (1 + v
B)`` is error, and views that hold the share s of its weight give a feature whose cosine c to that of all views is
expected at

    c^2 = s / (s + d (1 - s)).

A splat that none of them shows has s = 0 and counts zero, so that coverage is no matter of its own.

Before a lift, s and B are known by footprints alone: their areas stand for weights. v is not, nor what is hidden.
Both come from PILOT_VIEWS views, spread evenly, of the whole scene at coarse pixels, by three means over the sampled
splats, weighted by evidence: S of the squared length of what one view says of a splat, M of the squared length of
what the pilot's views say together, and b, the B of the pilot's views alone. As ``S = m + e`` and ``M = m + e b`` for
features of squared length m and errors of variance e, ``e = (S - M) / (1 - b)`` and ``v = e / (S - e)``. And b, the
chance that two looks at a splat are from one view, goes up as views are left out: of K of V views it is ``B / (B + (1
- B) (K - 1) / (V - 1))``. Solved for B, this says how many fewer views there are in truth than by their areas.
Vectors are compared in PILOT_CHANNELS random projections.
"""

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from liftcore.lifting.geometry import weigh_views
from liftcore.raster import open_raster
from liftcore.raster.base import Raster
from liftcore.runtime.device import CPU, Device
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import silent
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.splats import Splats
from liftcore.solve.closed_form import bag_sums
from liftcore.solve.least_squares import random_axes
from liftcore.values.lift_views import LiftViews
from liftcore.values.region_weights import RegionWeights, segment_sums
from liftcore.values.settings import LiftSettings

SAMPLE = 16_384  # splats at most; a view of them takes a millisecond
ORDER_SPLATS = 4_096  # at most: 300 views are in order after .3 s, where 16,384 take 1 s
SIDES = 24  # directions that a splat is looked at from: the three of each octant
WELL_COVERED = 8  # views that show a splat well enough to spare another one
PILOT_SIDE = 160  # pixels of an image's longer side, about
PILOT_CHANNELS = 64
PILOT_VIEWS = 12


@dataclass(frozen=True)
class Visibility:
    """How large the sampled splats are in each view."""

    areas: np.ndarray  # [V, n] f32, px^2 of the footprint's outline, at most the image's; 0 where it is not in it
    centres: np.ndarray  # [V, 3] f64, of the cameras, about the splats' origin as the means are
    means: np.ndarray  # [n, 3] f32, of the splats
    splats: int  # P, of which n are sampled evenly

    @property
    def in_view(self) -> np.ndarray:
        """[V, n] bool."""
        return self.areas > 0

    def of(self, views: Sequence[int]) -> "Visibility":
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


def visibility(
    splats: Splats,
    cameras: Sequence[Camera],
    params: CompositingParams,
    device: Device = CPU,
    threads: int | None = None,
) -> Visibility:
    """Project evenly spaced splats, SAMPLE at most, into every camera."""
    sample = spread_splats(splats, min(SAMPLE, splats.count))
    raster = open_raster(sample, device, threads)
    areas = np.zeros((len(cameras), sample.count), np.float32)
    for row, camera in zip(areas, cameras, strict=True):
        row[:] = raster.footprints(camera, params).numpy()
    centres = np.array([camera.about(splats.origin).centre for camera in cameras], np.float64).reshape(-1, 3)
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


def view_order(seen: Visibility) -> Iterator[int]:
    """All views, the one that covers most first, then the one that adds most to it, and so on.

    Of equal views the first is taken.
    """
    step = -(-seen.areas.shape[1] // ORDER_SPLATS)
    areas, means = seen.areas[:, ::step], seen.means[::step]
    totals = areas.sum(axis=0, dtype=np.float64)
    shares = np.divide(areas, totals, out=np.zeros(areas.shape, np.float32), where=totals > 0)
    shown = [np.flatnonzero(row) for row in shares]
    added = [row[own] for row, own in zip(shares, shown, strict=True)]
    places = [SIDES * own + side_of(centre - means[own]) for centre, own in zip(seen.centres, shown, strict=True)]
    held, roots = np.zeros((2, len(means) * SIDES), np.float32)

    def gain(view: int) -> float:
        before = places[view]
        return float((np.sqrt(held[before] + added[view]) - roots[before]).sum(dtype=np.float64))

    def take(view: int) -> None:
        held[places[view]] += added[view]
        roots[places[view]] = np.sqrt(held[places[view]])

    return greedy(len(shown), gain, take)


def greedy(count: int, gain: Callable[[int], float], take: Callable[[int], None]) -> Iterator[int]:
    """All numbers below ``count``, each next the one with the largest gain, of equal ones the first.

    Args:
        gain: of a number, beside what was taken; it never grows. take: called with each number as it is taken.
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
    """Directions [n, 3] -> [n] i64, below SIDES: the octant, and the longest component in it."""
    octants = (directions > 0) @ np.array([1, 2, 4])
    return 3 * octants + np.abs(directions).argmax(axis=1)


def views_to_show(seen: Visibility, order: Sequence[int], times: int) -> int:
    """How many views of the order, one at least, show each splat ``times`` times in the mean.

    All of them, when not even they do. Splats that no view shows do not count.
    """
    in_view = seen.in_view
    wanted = times * int(in_view.any(axis=0).sum())
    held = in_view.sum(axis=1)[list(order)].cumsum()
    return min(len(order), int(np.searchsorted(held, wanted)) + 1)


def spare_views(seen: Visibility) -> list[int]:
    """Views that could all be left out together: every splat they show is shown by WELL_COVERED others that stay.

    They are looked for from the one that shows the fewest splats on.
    """
    in_view = seen.in_view
    times = in_view.sum(axis=0)
    spare = []
    for view in np.argsort(in_view.sum(axis=1), kind="stable"):
        own = in_view[view]
        if own.sum() == 0 or int(times[own].min()) > WELL_COVERED:
            spare.append(int(view))
            times = times - own
    return sorted(spare)


@dataclass(frozen=True)
class ViewNoiseEstimate:
    """What is expected of some of the views."""

    areas: np.ndarray  # [V, n] f32, of the sampled splats in all views
    errors: np.ndarray  # [n] f64, d: the share of errors in the squared lengths of the features of all views
    weights: np.ndarray  # [n] f64, the evidence of all views, in any unit

    def cosines(self, order: Sequence[int]) -> Iterator[float]:
        """Of the first view of the order, of the first two, and so on: the expected mean cosine to all views."""
        totals, held = self.areas.sum(axis=0, dtype=np.float64), np.zeros(self.areas.shape[1])
        weights = self.weights / self.weights.sum()
        for view in order:
            held += self.areas[view]
            share = _ratio(held, totals).clip(max=1.0)
            yield float(weights @ np.sqrt(_ratio(share, share + self.errors * (1.0 - share))))

    def views_for(self, cosine: float, order: Sequence[int], least: int = 1) -> tuple[int, float]:
        """How many views of the order, ``least`` or more, come to this mean cosine, and what is expected of them.

        All of them, where no fewer do.
        """
        expected = 1.0
        for count, expected in enumerate(self.cosines(order), start=1):
            if count >= least and expected >= cosine:
                return count, expected
        return len(order), expected


def estimate_view_noise(
    raster: Raster, views: LiftViews, settings: LiftSettings, seen: Visibility
) -> ViewNoiseEstimate:
    """Weigh evenly spaced views of those of which ``seen`` tells, two at least."""
    total, count = len(views.names), min(PILOT_VIEWS, len(views.names))
    flown: list[int] = spread(total, count).tolist()
    chosen = views.only(views.names[view] for view in flown)
    longest = max(max(chosen.camera(k).width, chosen.camera(k).height) for k in range(count))
    coarse = {"stride": max(1, longest // PILOT_SIDE), "certificate_rays": 0, "robust_steps": 0, "consensus": False}
    own = settings.model_copy(update=coarse)
    channels = views.features.channels
    axes = random_axes(channels, min(PILOT_CHANNELS, channels), settings.seed)
    rows = spread(raster.splats.count, seen.areas.shape[1])
    with one_thread():
        geometry = weigh_views(raster, raster.splats.count, chosen, own, silent, by_rows=False)
        read = [view.means(view.rows.float() @ axes) for view in geometry.codebook.views]
        said = ViewDisagreement(geometry.weights, torch.cat(read), torch.from_numpy(rows))
    evidence = _evidence(geometry.evidence().numpy()[rows], seen.areas, seen.areas[flown])
    if not evidence.any():  # no ray met a splat, so nothing is known of any view
        return ViewNoiseEstimate(seen.areas, np.ones(len(evidence)), np.ones(len(evidence)))
    variance, together = said.disagreement(evidence)
    share = together / (together + (1.0 - together) * (total - 1) / (count - 1))  # B, in the mean
    by_area = _ratio((seen.areas.astype(np.float64) ** 2).sum(axis=0), seen.areas.sum(axis=0, dtype=np.float64) ** 2)
    return ViewNoiseEstimate(seen.areas, _errors(variance, by_area * share / _mean(by_area, evidence)), evidence)


class ViewDisagreement:
    """What views say of some splats, in sums over the views."""

    def __init__(self, W: RegionWeights, read: Tensor, rows: Tensor) -> None:
        """Args: read: [M, C] f32, what all regions read. rows: [n] i64, the splats."""
        starts, entries = W.take(rows)
        region, weight = W.region[entries], W.weight[entries]
        runs, row = W.runs(starts, region)
        said, total = bag_sums(region, read, runs, weight).double(), segment_sums(weight, runs)
        of_rows = torch.searchsorted(row, torch.arange(len(rows) + 1))
        squares = torch.where(total > 0, said.square().sum(dim=1) / total, 0.0)
        self.weights, self._squared_weights, self._squares = (
            segment_sums(part, of_rows).numpy() for part in (total, total.square(), squares)
        )
        self._vectors = bag_sums(torch.arange(len(row)), said.float(), of_rows).double().numpy()

    def means(self, weights: np.ndarray) -> tuple[float, float, float]:
        """Means by these weights [n] of the splats, over those that a labelled ray met; one of them counts at least.

        Of the squared length of what one view says, of that of what all say together, and of b.
        """
        met, total = self.weights > 0, self.weights**2
        means = (
            _ratio(self._squares, self.weights),
            _ratio((self._vectors**2).sum(axis=1), total),
            _ratio(self._squared_weights, total),
        )
        alone, mean, together = (_mean(values[met], weights[met]) for values in means)
        return alone, mean, together

    def disagreement(self, evidence: np.ndarray) -> tuple[float, float]:
        """v, infinite where the views have nothing in common, and b, over the splats that a labelled ray met."""
        if not (evidence[self.weights > 0] > 0).any():
            return np.inf, 1.0
        alone, mean, together = self.means(evidence)
        if together >= 1.0:
            return np.inf, 1.0
        error = max(0.0, alone - mean) / (1.0 - together)
        return (error / (alone - error) if error < alone else np.inf), together


def _evidence(found: np.ndarray, areas: np.ndarray, flown: np.ndarray) -> np.ndarray:
    """[n] f64, of all views, from what the flown ones found: in the same proportion to a splat's areas.

    Splats that they do not show get the mean proportion.
    """
    shown = flown.sum(axis=0, dtype=np.float64)
    light = np.divide(found, shown, out=np.full(len(found), found.sum() / max(shown.sum(), 1.0)), where=shown > 0)
    return light * areas.sum(axis=0, dtype=np.float64)


def _errors(variance: float, shares: np.ndarray) -> np.ndarray:
    """d of the splats, from v and their B."""
    return variance * shares / (1.0 + variance * shares) if np.isfinite(variance) else np.ones(len(shares))


def _mean(values: np.ndarray, weights: np.ndarray) -> float:
    return float((values * weights).sum() / weights.sum())


def _ratio(values: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Nought where the others are nought."""
    return np.divide(values, others, out=np.zeros(np.shape(values)), where=others > 0)
