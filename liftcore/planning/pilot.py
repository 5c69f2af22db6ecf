"""How many views a lift needs: a few views are walked by coarse pixels, and compared splat by splat.

How near the features of some views come to those of all depends on how much the views disagree, which no footprint
says: where encoders and masks agree, a part of the views will do, and where a feature is mostly what one view made of
it, the last view counts. Say that every view adds an error of its own, of variance v beside a feature of length one,
and that the share q_i of a splat's weight lies in view i. Then the squared length of its feature is ``1 + v B`` with
``B = sum_i q_i^2`` (one over the number of views, where they weigh alike), of which ``d = v B / (1 + v B)`` is error,
and views that hold the share s of its weight give a feature whose cosine c to that of all views is expected at

    c^2 = s / (s + d (1 - s)).

A splat that none of them shows has s = 0 and counts zero, so that coverage is no matter of its own.

Before a lift, s and B are known by footprints alone: their areas stand for weights. v is not, nor what is hidden.
Both come from PILOT_VIEWS views, spread evenly, of the whole scene at coarse pixels, by three means over the sampled
splats, weighted by evidence: S of the squared length of what one view says of a splat, M of the squared length of
what the pilot's views say together, and b, the B of the pilot's views alone. As ``S = m + e`` and ``M = m + e b`` for
features of squared length m and errors of variance e, ``e = (S - M) / (1 - b)`` and ``v = e / (S - e)``. And b, the
chance that two looks at a splat are from one view, goes up as views are left out: of K of V views it is
``B / (B + (1 - B) (K - 1) / (V - 1))``. Solved for B, this says how many fewer views there are in truth than by their
areas. Vectors are compared in PILOT_CHANNELS random projections.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.one_thread import one_thread
from liftcore.planning.visibility import spread
from liftcore.progress import silent
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.solve.closed_form import bag_sums
from liftcore.solve.geometry import LiftViews, weigh_views
from liftcore.solve.least_squares import random_axes
from liftcore.solve.weights import RegionWeights, segment_sums

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from torch import Tensor

    from liftcore.planning.visibility import Visibility
    from liftcore.scene.splats import Splats
    from liftcore.settings import LiftSettings

PILOT_SIDE = 160  # pixels of an image's longer side, about
PILOT_CHANNELS = 64
PILOT_VIEWS = 12


@dataclass(frozen=True)
class Pilot:
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


def fly_pilot(
    splats: Splats, views: LiftViews, settings: LiftSettings, seen: Visibility, threads: int | None = None
) -> Pilot:
    """Weigh evenly spaced views of those of which ``seen`` tells, two at least."""
    total, count = len(views.names), min(PILOT_VIEWS, len(views.names))
    flown: list[int] = spread(total, count).tolist()
    chosen = replace(views, names=[views.names[view] for view in flown])
    longest = max(max(chosen.camera(k).width, chosen.camera(k).height) for k in range(count))
    coarse = {"stride": max(1, longest // PILOT_SIDE), "certificate_rays": 0, "robust_steps": 0}
    own = settings.model_copy(update=coarse)
    channels = views.features.channels
    axes = random_axes(channels, min(PILOT_CHANNELS, channels), settings.seed)
    raster = CpuRaster(splats, threads)
    rows = spread(splats.count, seen.areas.shape[1])
    with one_thread():
        geometry = weigh_views(raster, splats.count, chosen, own, silent, by_rows=False, threads=threads)
        read = [view.means(view.rows.float() @ axes) for view in geometry.codebook.views]
        said = _Said(geometry.weights, torch.cat(read), torch.from_numpy(rows))
    evidence = _evidence(geometry.evidence().numpy()[rows], seen.areas, seen.areas[flown])
    if not evidence.any():  # no ray met a splat, so nothing is known of any view
        return Pilot(seen.areas, np.ones(len(evidence)), np.ones(len(evidence)))
    variance, together = said.disagreement(evidence)
    share = together / (together + (1.0 - together) * (total - 1) / (count - 1))  # B, in the mean
    by_area = _ratio((seen.areas.astype(np.float64) ** 2).sum(axis=0), seen.areas.sum(axis=0, dtype=np.float64) ** 2)
    return Pilot(seen.areas, _errors(variance, by_area * share / _mean(by_area, evidence)), evidence)


class _Said:
    """What the pilot's views say of the sampled splats, in sums over the views."""

    def __init__(self, W: RegionWeights, read: Tensor, rows: Tensor) -> None:
        """Args: read: [M, C] f32, what all regions read. rows: [n] i64, the splats."""
        starts, entries = W.take(rows)
        region, weight = W.region[entries], W.weight[entries]
        runs, row = W.runs(starts, region)
        said, total = bag_sums(region, read, runs, weight).double(), segment_sums(weight, runs)
        of_rows = torch.searchsorted(row, torch.arange(len(rows) + 1))
        squares = torch.where(total > 0, said.square().sum(dim=1) / total, 0.0)
        self._weights, self._squared_weights, self._squares = (
            segment_sums(part, of_rows).numpy() for part in (total, total.square(), squares)
        )
        self._vectors = bag_sums(torch.arange(len(row)), said.float(), of_rows).double().numpy()

    def disagreement(self, evidence: np.ndarray) -> tuple[float, float]:
        """v, infinite where the views have nothing in common, and b, over the splats that a labelled ray met."""
        met = self._weights > 0
        if not (evidence[met] > 0).any():
            return np.inf, 1.0
        means = (
            _ratio(self._squares, self._weights),
            _ratio((self._vectors**2).sum(axis=1), self._weights**2),
            _ratio(self._squared_weights, self._weights**2),
        )
        alone, mean, together = (_mean(values[met], evidence[met]) for values in means)
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
