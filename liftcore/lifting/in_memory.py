"""The steps of a lift in the memory of one process: W is a sparse matrix with a row a splat, and X a tensor."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.lifting.base import LiftSteps, SplatSupport, WeightStatistics
from liftcore.lifting.checkpoint import Checkpoint
from liftcore.lifting.geometry import Geometry, strided, weigh_views
from liftcore.lifting.planning.contradictions import contradictions, probe_views
from liftcore.lifting.planning.plan import TIMED_VIEWS, Plan, plan_lift
from liftcore.query.result import LiftResult
from liftcore.raster import open_raster
from liftcore.raster.base import Raster
from liftcore.runtime.device import Device
from liftcore.runtime.progress import Timings
from liftcore.scene.cameras import Camera
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.neighbours import SplatGraph
from liftcore.scene.splats import Splats
from liftcore.solve.aggregate import Aggregation, aggregate
from liftcore.solve.closed_form import solve
from liftcore.solve.consensus import mask_consensus
from liftcore.solve.diagnostics import ViewMeasures, measure_samples
from liftcore.solve.directions import region_totals
from liftcore.solve.membership import Memberships, RegionGroups, memberships
from liftcore.solve.objects import NodeVectors, RegionObjects, region_objects
from liftcore.solve.optimum import compare_with_optimum
from liftcore.solve.reweight import Reweighting, mask_regions, reweighting_factors, scale_weights
from liftcore.solve.smooth import smooth
from liftcore.solve.sums import sum_pieces
from liftcore.values.levels import at_levels
from liftcore.values.lift_views import LiftViews
from liftcore.values.region_weights import RegionWeights
from liftcore.values.settings import LiftSettings
from liftcore.values.views import ViewFeatures


@dataclass(frozen=True)
class SceneWeights:
    """W of all views, with its inputs and the results of reweighting."""

    raster: Raster
    device: Device
    memory: int | None  # bytes of X, beyond which it is a mapped file; None for no limit
    views: LiftViews
    geometry: Geometry  # its W is that of the solve
    sums: np.ndarray | None = None  # [P] f64, of the rows of W before reweighting; None: W is not reweighted
    threads: int | None = None  # None: the cores that this process may use
    consensus: Tensor | None = None  # [nnz] f32, until W is reweighted
    reweighting: Reweighting | None = None

    @property
    def weights(self) -> RegionWeights:
        """W, a row for every splat."""
        return self.geometry.weights

    @cached_property
    def members(self) -> Memberships:
        """The memberships of W, which objects and consensus share."""
        groups = RegionGroups.of(self.weights.offsets.numpy(), self.geometry.levels)
        return memberships(self.weights, groups, self.threads)

    def row_sums(self) -> np.ndarray:
        """Return the sums of rows [P] f64 of W before reweighting."""
        return self.weights.row_sums().numpy() if self.sums is None else self.sums

    def with_factors(self, factors: Tensor) -> SceneWeights:
        """Multiply each entry of W by its factor [nnz] f32."""
        geometry = replace(self.geometry, weights=scale_weights(self.weights, factors))
        return replace(self, geometry=geometry, sums=self.row_sums())


@dataclass(frozen=True)
class InMemory(LiftSteps[SceneWeights]):
    """The steps in one process; see the protocol."""

    splats: Splats
    settings: LiftSettings
    timings: Timings
    threads: int | None = None
    checkpoint: Checkpoint | None = None

    def plan(self, views: LiftViews, device: Device) -> Plan:
        """See the protocol. `weigh` reports contradictions, by the views that the lift begins with."""
        return plan_lift(self.splats, views, self.settings, device, self.threads)

    def weigh(
        self, views: LiftViews, plan: Plan, on_plan: Callable[[Plan], None]
    ) -> tuple[SceneWeights, WeightStatistics]:
        raster = open_raster(self.splats, plan.device, self.threads)
        first, begin = probe_views(len(views)), time.perf_counter()
        plans = [plan]

        def check_first(geometry: Geometry) -> None:
            seconds = time.perf_counter() - begin
            if views.features.paths:
                warnings = contradictions(raster, views, self.settings, plan.seen_share, geometry)
                plans.append(replace(plan, input_warnings=(*plan.input_warnings, *warnings)))
            if len(views) >= TIMED_VIEWS:
                plans.append(replace(plans[-1], seconds=seconds * len(views) / len(first)))
            on_plan(plans[-1])

        geometry = weigh_views(
            raster, self.splats.count, views, self.settings, self.timings.progress,
            by_rows=self.settings.weighs_rows, threads=self.threads,
            checkpoint=self.checkpoint.of(self.splats, plan.device.facts()) if self.checkpoint else None,
            first=first, on_first=check_first,
        )  # fmt: skip
        W = SceneWeights(raster, plan.device, plan.features_room, views, geometry, threads=self.threads)
        return W, WeightStatistics(plans[-1], geometry.levels, W.weights.region.shape[0], geometry.blind)

    def find_objects(self, W: SceneWeights) -> RegionObjects:
        total_weight = W.geometry.total_weight().numpy()
        return region_objects(W.weights, W.geometry.levels, total_weight, self.threads, members=W.members)

    def node_vectors(self, W: SceneWeights, objects: RegionObjects) -> NodeVectors:
        totals = sum_pieces(region_totals(W.weights, self.threads), (1, int(W.weights.offsets[-1])))[0]
        return NodeVectors.of(W.geometry.codebook, totals, objects)

    def compare_masks(self, W: SceneWeights) -> SceneWeights:
        consensus = mask_consensus(
            W.weights, W.geometry.levels, self.threads, means=self.splats.means, members=W.members
        )
        return replace(W, consensus=torch.from_numpy(consensus))

    def reweight(self, W: SceneWeights, levels_apart: bool) -> tuple[SceneWeights, float | None]:
        reweighting = reweighting_factors(
            W.weights, W.geometry.codebook, self.timings.progress,
            principal=self.settings.robust_directions, means=self.splats.means, threads=self.threads,
            masks=mask_regions(W.geometry.levels), consensus=W.consensus,
            levels=W.geometry.levels if levels_apart else None,
        )  # fmt: skip
        result = replace(W.with_factors(reweighting.factors), consensus=None, reweighting=reweighting)
        return result, reweighting.reliability

    def solve(self, W: SceneWeights) -> tuple[Tensor, SplatSupport]:
        X = solve(
            W.weights, W.geometry.codebook, getattr(torch, self.settings.dtype), self.timings.progress,
            means=self.splats.means, threads=self.threads, memory=W.memory,
        )  # fmt: skip
        confidence = W.reweighting.confidence if W.reweighting else None
        return X, SplatSupport(W.row_sums(), W.geometry.total_weight(), confidence)

    def compare_with_optimum(self, W: SceneWeights, X: Tensor, visible: np.ndarray) -> dict[str, Any]:
        settings, geometry = self.settings, W.geometry

        def read(number: int) -> tuple[Camera, ViewFeatures, CompositingParams]:
            camera, features = W.views[number]
            params = strided(settings.compositing, settings, camera, number)
            return camera, at_levels(features, settings.levels, camera.name), params

        views = map(read, range(len(W.views)))
        return compare_with_optimum(
            W.raster, views, X, visible, geometry.samples, geometry.books, settings, self.timings.progress
        )

    def smooth(self, W: SceneWeights, X: Tensor, support: SplatSupport) -> tuple[Tensor, dict[str, Any]]:
        graph, visible = SplatGraph.of(self.splats, self.threads), torch.from_numpy(support.sums > 0)
        return smooth(
            X, graph, support.total_weight, support.confidence, visible, self.settings.smoothness,
            self.timings.progress, self.threads,
        )  # fmt: skip

    def aggregate(self, W: SceneWeights, X: Tensor) -> tuple[Tensor, Aggregation]:
        total_weight, progress = W.geometry.total_weight().numpy(), self.timings.progress
        return aggregate(X, total_weight, W.raster, W.views, self.settings, progress, self.threads)

    def measure(self, W: SceneWeights, X: Tensor) -> ViewMeasures:
        return measure_samples(W.geometry.samples, X, W.geometry.books, self.threads)

    def deliver(self, W: SceneWeights, lift: LiftResult) -> LiftResult:
        """See the protocol: the device of the lift; an X in a mapped file stays there."""
        return lift if W.memory is not None and lift.features.nbytes > W.memory else lift.to(W.device.place)
