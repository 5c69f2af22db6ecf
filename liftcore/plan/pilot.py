"""How many views a lift needs: a small lift of a thinned scene, once from some views and once from half of them.

How near the features of some views come to those of all depends on how much the views disagree, which no footprint
says: where encoders and masks agree, a quarter of the views will do, and where a feature is mostly what one view
made of it, the last view counts. So PILOT_SPLATS splats, grown to cover what all of them covered, are lifted from
coarse pixels of PILOT_VIEWS views by the raster itself, with what it says of hiding, and again from half of these.

If every view adds an error of its own, of variance v beside a feature of length one, then the features of n of N
views have the cosine ``c`` to those of all with ``1 / c^2 - 1 = r (1 / n - 1 / N)``, ``r = v / (1 + v / N)``. The
pilot measures r among its own views, and so v; n follows for the c and the N that are wanted.
Vectors are compared in PILOT_CHANNELS random projections.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
import torch

from liftcore.plan.coverage import view_order
from liftcore.plan.visibility import spread_splats, visibility
from liftcore.progress import silent
from liftcore.raster.cpu import CpuRaster
from liftcore.solve.accumulate import accumulate, lift_walk, row_totals
from liftcore.solve.channels import one_thread, random_axes
from liftcore.solve.closed_form import solve_closed_form
from liftcore.solve.view_weights import ViewWeights

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from liftcore.observe.pack import FeaturePacks
    from liftcore.scene.cameras import Cameras
    from liftcore.scene.splats import Splats
    from liftcore.solve.columns import Columns
    from liftcore.solve.settings import LiftSettings

PILOT_SPLATS = 4_096
PILOT_SIDE = 80  # pixels of an image's longer side, about
PILOT_CHANNELS = 64
PILOT_VIEWS = 24
FEW_VIEWS = 32  # and below, all are taken: a pilot would cost what it saves
LEAST_COSINE = 0.01  # of the halves, below which their views have nothing in common


@dataclass(frozen=True)
class Pilot:
    """What the small lift says of the views' disagreement."""

    variance: float  # v: of the error that one view has, as a share of the squared feature; may be infinite

    def views_for(self, cosine: float, total: int) -> int:
        """The fewest of ``total`` views whose features have at least this cosine, in the mean, to those of all."""
        among = self._among(total)
        if among <= 0.0:
            return 1
        allowed = 1.0 / max(cosine, LEAST_COSINE) ** 2 - 1.0
        return max(1, min(total, math.ceil(1.0 / (allowed / among + 1.0 / total))))

    def cosine_of(self, count: int, total: int) -> float:
        """What is expected of so many views of ``total``."""
        return 1.0 / math.sqrt(1.0 + self._among(total) * (1.0 / count - 1.0 / total))

    def _among(self, total: int) -> float:
        """r: the variance beside the features of ``total`` views, which have a part of the errors themselves."""
        return total / (1.0 + total / self.variance) if self.variance > 0.0 else 0.0


def fly_pilot(
    splats: Splats, cameras: Cameras, packs: FeaturePacks, names: Sequence[str], settings: LiftSettings
) -> Pilot:
    """Lift the thinned scene from evenly spaced views of ``names``, three at least, and from half of them."""
    chosen = [names[int(k)] for k in np.linspace(0, len(names) - 1, min(PILOT_VIEWS, len(names)))]
    views = [cameras.get(name) for name in chosen]
    thin = spread_splats(splats, min(PILOT_SPLATS, splats.count))
    thin.log_scales.add_(0.5 * math.log(splats.count / thin.count))
    coarse = max(1, max(max(view.width, view.height) for view in views) // PILOT_SIDE)
    own = settings.model_copy(update={"stride": coarse, "certificate_rays": 0})
    axes = random_axes(packs.channels, min(PILOT_CHANNELS, packs.channels), settings.seed)
    with ViewWeights() as store:
        raster = CpuRaster(thin, threads=1)
        geometry = accumulate(raster, (thin.count, cameras), packs, chosen, own, store, silent)
        with one_thread():
            columns = [replace(own, codebook=own.codebook.float() @ axes) for own in geometry.columns]
        whole = _features(store, columns, range(len(chosen)), thin.count)
        order = view_order(visibility(thin, views, lift_walk(own)))
        half = sorted(islice(order, (len(chosen) + 1) // 2))
        part = _features(store, columns, half, thin.count)
    cosine = _mean_cosine(part, whole, torch.from_numpy(geometry.evidence))
    among = (1.0 / cosine**2 - 1.0) / (1.0 / len(half) - 1.0 / len(chosen))
    return Pilot(among / (1.0 - among / len(chosen)) if among < len(chosen) else math.inf)


def _features(store: ViewWeights, columns: Sequence[Columns], views: Sequence[int], count: int) -> Tensor:
    """[count, C] f32, the closed form from some views alone."""
    weights, denominators = [store[view] for view in views], np.zeros(count)
    for part in weights:
        denominators[part.splats.numpy()] += row_totals(part)
    own = [columns[view] for view in views]
    return solve_closed_form(weights, own.__getitem__, denominators, torch.float32, silent, threads=1).features


def _mean_cosine(some: Tensor, others: Tensor, weights: Tensor) -> float:
    """The weighted mean cosine of vectors [n, C] where the others are not zero, LEAST_COSINE at least."""
    weights = weights * (others != 0).any(dim=1)  # no labelled ray met the rest
    total = float(weights.sum())
    if not total > 0:
        return LEAST_COSINE  # nothing was learnt, so nothing is left out
    with one_thread():
        cosines = torch.nn.functional.cosine_similarity(some, others, dim=1).double()
        return min(1.0, max(LEAST_COSINE, float((cosines * weights).sum()) / total))
