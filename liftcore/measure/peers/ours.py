"""splatlift's own lift: region weights view by view, then the closed form."""

from __future__ import annotations

import numpy as np
import torch

from liftcore.measure.peers.work import Answer, Work
from liftcore.progress import silent
from liftcore.raster.cpu import CpuRaster
from liftcore.raster.protocol import Look, Weighting
from liftcore.solve.accumulate import row_totals
from liftcore.solve.closed_form import solve_closed_form
from liftcore.solve.view_weights import ViewWeights


class Ours:
    """See ``liftcore.measure.peers.peer.Peer``."""

    name = "splatlift"
    computes = "region weights `A^T S` in one walk a view, then `X = sum_v W_v E_v / D` for all channels"

    def missing(self) -> str:
        """Nothing."""
        return ""

    def lift(self, work: Work) -> Answer:
        """X as ``splatlift lift --preset row-sum --set dtype=float32`` has it."""
        raster, totals = CpuRaster(work.splats, work.threads), np.zeros(work.splats.count)
        with ViewWeights() as store:
            nowhere = torch.empty(0, 2, dtype=torch.int32)
            looks = (Look(camera, regions, work.walk, Weighting(), nowhere) for camera, regions in work.views)
            for walked in raster.walk_views(looks):
                totals[walked.weights.splats.numpy()] += row_totals(walked.weights)
                store.append(walked.weights)
            books = [regions.codebook for _, regions in work.views]
            solution = solve_closed_form(store, books.__getitem__, totals, torch.float32, silent, work.threads)
        return Answer(solution.features, torch.from_numpy(totals))
