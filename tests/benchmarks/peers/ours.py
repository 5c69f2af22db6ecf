"""splatlift's own lift: region weights view by view, then the closed form."""

from __future__ import annotations

import torch

from liftcore.evaluate.region_walk import walk_regions
from liftcore.progress import silent
from liftcore.raster.base import Weighting
from liftcore.raster.cpu.raster import CpuRaster
from liftcore.solve.closed_form import solve_closed_form
from liftcore.solve.host import Host
from liftcore.solve.view_weights import WeightStore
from tests.benchmarks.peers.work import Answer, Work


class Ours:
    """See ``tests.benchmarks.peers.peer.Peer``."""

    name = "splatlift"
    computes = "region weights `A^T S` in one walk a view, then `X = sum_v W_v E_v / D` for all channels"

    def missing(self) -> str:
        """Nothing."""
        return ""

    def lift(self, work: Work) -> Answer:
        """X as ``splatlift lift --preset row-sum --set dtype=float32`` has it."""
        raster, looking = CpuRaster(work.splats, work.threads), (work.walk, Weighting())
        with WeightStore() as store:
            totals, columns = walk_regions(raster, work.views, looking, work.splats.count, store)
            host = Host(work.threads, means=work.splats.means)
            solution = solve_closed_form(store, columns, totals, torch.float32, silent, host)
        return Answer(solution.features, torch.from_numpy(totals))
