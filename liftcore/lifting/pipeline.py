"""The pipeline, as the paper reads: A from the scene, B from the views, X in closed form, and what is known of it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidSettings
from liftcore.lifting.checkpoint import Checkpoint
from liftcore.lifting.engines.base import Engine
from liftcore.lifting.engines.lift import lift_in_blocks
from liftcore.lifting.geometry import Geometry, as_read, weigh_views
from liftcore.lifting.planning.contradictions import contradictions, probe_views
from liftcore.lifting.planning.plan import TIMED_VIEWS, Plan, plan_lift
from liftcore.lifting.warm_up import warm_up_lift
from liftcore.query.result import LiftResult
from liftcore.raster import check_given, open_raster
from liftcore.raster.base import Raster
from liftcore.runtime.device import Device, choose_device, within_memory
from liftcore.runtime.progress import Progress, Timings
from liftcore.runtime.torch_modes import usual_modes
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.solve.aggregate import Aggregation, aggregate
from liftcore.solve.closed_form import Solution, solve, solve_rows
from liftcore.solve.consensus import mask_consensus
from liftcore.solve.diagnostics import certify, lift_warnings, measure_samples
from liftcore.solve.least_squares import AllRays, reference, refine
from liftcore.solve.loss import huber_factors
from liftcore.solve.objects import RegionObjects, object_facts, region_objects
from liftcore.solve.reweight import Agreement, agreement_factors, agreement_facts, reweighted, whole_regions
from liftcore.values.lift_views import Given, LiftViews
from liftcore.values.region_weights import RegionWeights
from liftcore.values.settings import LiftSettings, Preset

LEAST_KEPT = 0.5  # of a splat's weight, in regions that the aggregation kept, for it to be solved for again
log = logging.getLogger(__name__)


@usual_modes()
def lift(
    splats: Splats,
    cameras: Cameras | Mapping[str, Camera],
    views: Given,
    preset: Preset | str | LiftSettings = Preset.DEFAULT,
    *,
    progress: Progress | None = None,
    on_plan: Callable[[Plan], None] | None = None,
    threads: int | None = None,
    checkpoint: Checkpoint | Path | str | None = None,
    engine: Engine | None = None,
    **settings: Any,
) -> LiftResult:
    """Lift the features of views onto splats: ``X = D^-1 A^T B`` A the weights of splats on rays.

    Args:
        splats: P trained splats.
        cameras: by name. views: what each sees, by the same names: ``Regions`` or a ``FeatureGrid``, in a dict, a
            feature pack (`read_features`), or an iterator of (name, view) pairs, which is gone through once and kept
            on the disk, so that no more than a few maps are in memory.
        preset: a published choice of weights (`Preset`), or `LiftSettings` in place of preset and settings.
        progress: called ``progress(stage, done, total, unit)``; an exception from it stops the work.
        on_plan: called with the plan before the first view, and shows its warnings. None: they are logged, and at
            the end those of the diagnostics.
        threads: None takes the cores that this process may use. The number changes no bit of the result.
        checkpoint: a folder that keeps the weights of finished views. The same lift goes on from there, identical to
            the bit, and so does one that differs in features alone (another encoder's of the same regions).
        engine: who works on the lift in blocks of views and of splats, for scenes whose W or X is more than a machine
            should hold: `LocalEngine` or `RayEngine`, with the same bits; the checkpoint is
            then the folder of the blocks, which all workers share. None: the whole lift in this process's memory.
        settings: fields of `LiftSettings` that differ from the preset's.

    Returns:
        Features [P, F] f16 (or f32) with evidence, agreement and diagnostics, on the device that did the work, or on
        the CPU where that has no room for them.

    Raises:
        InvalidSplats, InvalidCameras: splats or cameras are something else, such as a path.
        InvalidFeatures: views are malformed, or none has a camera.
        InvalidSettings: a setting is unknown or out of range, or does not suit the splats' kernel or the views.
        Unavailable: neither memory nor disk can hold what the lift needs, or there is no such device as asked for.

    Source: Splat Feature Solver, Eq. 3 and 6.
    """
    chosen = LiftSettings.chosen(preset, settings)
    splats = check_given(splats, threads)
    chosen = chosen.for_splats(splats)
    kept, warn = _checkpoint(checkpoint), _WarnOnce()
    if engine is not None:
        known = cameras if isinstance(cameras, Cameras) else Cameras(cameras)
        given = {"progress": progress, "on_plan": on_plan or warn.of_plan, "folder": kept.folder if kept else None}
        result = lift_in_blocks(engine, splats, known, views, chosen, **given)
        warn.of(result.diagnostics["warnings"] if on_plan is None else ())
        return result
    work = _Lift(splats, chosen, threads, Timings(progress), choose_device(chosen.device))
    found = LiftViews.of(views, cameras, chosen)
    plan = work.plan(found)
    with within_memory(work.device):
        geometry, plan = work.weigh(found, plan, kept, on_plan or warn.of_plan)
        things = work.find_objects(geometry)
        W, agreement = work.reweight(geometry)
        solution = work.solve(W, geometry, plan)
        sums = geometry.weights.row_sums().cpu().numpy()
        X, notes = work.refine(found, geometry, solution.features, sums > 0)
        clusters = work.aggregate(found, geometry, W, X, sums, notes, agreement, things)
        if agreement:
            facts = agreement_facts(geometry.levels, agreement.reliability, agreement.confidence)
            notes["reweighting"] = facts
        things = things if chosen.objects else None
        notes |= {"objects": object_facts(things)} if things else {}
        diagnostics = work.diagnose(found, geometry, X, sums, plan, notes)
    warn.of(diagnostics["warnings"] if on_plan is None else ())
    table = found.features.table
    made = LiftResult(
        features=X,
        evidence=geometry.evidence(),
        agreement=solution.agreement,
        confidence=agreement.confidence if agreement else None,
        seen=torch.from_numpy(sums > 0),
        metadata=found.metadata(chosen, splats.origin, diagnostics, work.timings.seconds),
        cluster=clusters.clusters if clusters else None,
        cluster_features=clusters.cluster_features if clusters else None,
        embeddings=torch.from_numpy(table.embeddings) if table else None,
        object=torch.from_numpy(things.labels) if things else None,
        object_views=torch.from_numpy(things.views) if things else None,
    )
    room = plan.features_room
    return made if room is not None and X.nbytes > room else made.to(work.device.place)  # X in a mapped file stays


@usual_modes()
def plan(
    splats: Splats,
    cameras: Cameras | Mapping[str, Camera],
    views: Given,
    preset: Preset | str | LiftSettings = Preset.DEFAULT,
    *,
    threads: int | None = None,
    **settings: Any,
) -> Plan:
    """What `lift` with the same arguments would do, and what it would take: views, memory, warnings.

    A few views are weighed to see whether splats, cameras and features contradict each other, as `lift` itself does
    with views that lie in files.

    Raises:
        InvalidFeatures, InvalidSettings, Unavailable: as `lift` has it.
    """
    chosen = LiftSettings.chosen(preset, settings)
    splats = check_given(splats, threads)
    chosen = chosen.for_splats(splats)
    found = LiftViews.of(views, cameras, chosen)
    return plan_lift(splats, found, chosen, choose_device(chosen.device), threads, look=True)


def solved_weights(
    geometry: Geometry, splats: Splats, settings: LiftSettings, timings: Timings, threads: int | None
) -> tuple[RegionWeights, Agreement | None]:
    """W as it is solved: steps give factors of W's entries, and so does a loss that is not of squares.

    Raises:
        InvalidSettings: consensus is asked for, and no view has masks.
    """
    W, consensus = geometry.weights, None
    if settings.asks_consensus(bool((geometry.levels >= 0).any())):
        with timings.stage("consensus"):
            W = W.cpu()
            found = mask_consensus(W, geometry.levels, threads, means=splats.means)
            consensus = torch.from_numpy(found)
    agreement = None
    with timings.stage("robust"):
        if settings.robust_steps:
            W = W.cpu()
            agreement = agreement_factors(
                W,
                geometry.codebook,
                settings.robust_steps,
                timings.progress,
                means=splats.means,
                threads=threads,
                reliability=whole_regions(settings.reliability, geometry.levels),
                consensus=consensus,
            )
            W = reweighted(W, agreement.factors)
    if settings.loss == "huber":
        with timings.stage("loss"):
            W = W.cpu()
            factors = huber_factors(W, geometry.codebook, timings.progress, means=splats.means, threads=threads)
            W = reweighted(W, factors)
    return W, agreement


def log_warnings(plan: Plan) -> None:
    """Log what the plan has to say of this machine, which no certificate keeps: equal inputs give equal lifts."""
    for warning in plan.warnings:
        log.warning(warning)


class _WarnOnce:
    """Logs what a lift warns of, once, where nobody shows its plan: a program would not look into diagnostics."""

    def __init__(self) -> None:
        self._said = set[str]()

    def of_plan(self, plan: Plan) -> None:
        """What the plan warns of, before the first view."""
        self.of((*plan.warnings, *plan.told))

    def of(self, warnings: Iterable[str]) -> None:
        """Those that were not logged yet."""
        for warning in dict.fromkeys(warnings):
            if warning not in self._said:
                log.warning(warning)
        self._said |= set(warnings)


def _checkpoint(given: object) -> Checkpoint | None:
    """The checkpoint, or that of a folder.

    Raises:
        InvalidSettings: it is something else.
    """
    if given is None or isinstance(given, Checkpoint):
        return given
    if isinstance(given, Path | str) and str(given):
        return Checkpoint(Path(given))
    raise InvalidSettings("checkpoint", expected="the path of a folder, or None", got=repr(given)[:80])


@dataclass
class _Lift:
    """One lift on its way: the steps, and what all of them need."""

    splats: Splats
    settings: LiftSettings
    threads: int | None
    timings: Timings
    device: Device

    def __post_init__(self) -> None:
        self.raster: Raster | None = None

    @property
    def progress(self) -> Progress:
        return self.timings.progress

    def compile(self) -> None:
        with self.timings.step("compile"):
            warm_up_lift(self.splats.kernel, self.device, self.settings)

    def plan(self, views: LiftViews) -> Plan:
        """The plan, which may leave views out and take another device."""
        self.compile()
        with self.timings.step("plan"):
            plan = plan_lift(self.splats, views, self.settings, self.device, self.threads)
            views.names = list(plan.views)
        if plan.device != self.device:
            self.device = plan.device
            self.compile()
        return plan

    def weigh(
        self, views: LiftViews, plan: Plan, checkpoint: Checkpoint | None, on_plan: Callable[[Plan], None]
    ) -> tuple[Geometry, Plan]:
        """W of all views, and sampled rows of A; and the plan with what the first views tell of the others."""
        self.raster = open_raster(self.splats, self.device, self.threads, plan.kept_on_card)
        first, begin = probe_views(len(views)), time.perf_counter()
        plans = [plan]

        def look(geometry: Geometry) -> None:
            took = time.perf_counter() - begin
            assert self.raster is not None
            if views.features.paths:
                wrong = contradictions(self.raster, views, self.settings, plan.seen_share, geometry)
                plans.append(replace(plan, told=(*plan.told, *wrong)))
            if len(views) >= TIMED_VIEWS:
                plans.append(replace(plans[-1], seconds=took * len(views) / len(first)))
            on_plan(plans[-1])

        with self.timings.stage("geometry"):
            geometry = weigh_views(
                self.raster,
                self.splats.count,
                views,
                self.settings,
                self.progress,
                by_rows=self.settings.weighs_rows,
                checkpoint=checkpoint.of(self.splats, self.device.facts()) if checkpoint else None,
                device_bytes=plan.kept_on_card,
                threads=self.threads,
                first=first,
                on_first=look,
            )
        return geometry, plans[-1]

    def find_objects(self, geometry: Geometry) -> RegionObjects | None:
        """What masks of many views keep together, or None where they are not looked for.

        Raises:
            InvalidSettings: objects are asked for, or clusters that masks make, and no view has masks.
        """
        if not self.settings.finds_objects(bool((geometry.levels >= 0).any())):
            return None
        with self.timings.stage("objects"):
            return region_objects(geometry.weights.cpu(), geometry.levels, geometry.evidence().numpy(), self.threads)

    def reweight(self, geometry: Geometry) -> tuple[RegionWeights, Agreement | None]:
        """W as it is solved (`solved_weights`)."""
        return solved_weights(geometry, self.splats, self.settings, self.timings, self.threads)

    def solve(self, W: RegionWeights, geometry: Geometry, plan: Plan) -> Solution:
        """The closed form."""
        with self.timings.stage("solve"):
            return solve(
                W,
                geometry.codebook,
                getattr(torch, self.settings.dtype),
                self.progress,
                means=self.splats.means,
                threads=self.threads,
                device=self.device,
                memory=plan.features_room,
            )

    def refine(
        self, views: LiftViews, geometry: Geometry, X: Tensor, seen: np.ndarray
    ) -> tuple[Tensor, dict[str, Any]]:
        """X after the conjugate gradient steps that the settings ask for, and what is known of the optimum."""
        settings, progress, notes = self.settings, self.progress, dict[str, Any]()
        if not settings.cg_steps and not settings.reference_channels:
            return X, notes
        with self.timings.stage("rays"):
            rays = AllRays(
                self._raster(),
                self.splats.count,
                [views.camera(number) for number in range(len(views))],
                lambda number: as_read(views[number][1], settings, views.names[number]),
                settings.lift_params,
                progress,
            )
        if settings.cg_steps:
            with self.timings.stage("refine"):
                refinement = refine(rays, X, seen, geometry.books, settings, progress)
            X, notes["refinement"] = refinement.features, refinement.stats
        if settings.reference_channels:
            with self.timings.stage("reference"):
                notes["reference"] = reference(rays, X, seen, geometry.samples, geometry.books, settings, progress)
        return X, notes

    def aggregate(
        self,
        views: LiftViews,
        geometry: Geometry,
        W: RegionWeights,
        X: Tensor,
        sums: np.ndarray,
        notes: dict[str, Any],
        agreement: Agreement | None,
        things: RegionObjects | None,
    ) -> Aggregation | None:
        """Aggregate X in place, if the settings ask for it."""
        settings = self.settings
        if not settings.aggregation:
            return None
        with self.timings.stage("aggregate"):
            evidence, judged = geometry.evidence().numpy(), None
            if settings.aggregation_guard and agreement and agreement.explained is not None:
                judged = W.cpu(), agreement.directions, agreement.explained
            found = aggregate(
                X,
                evidence,
                self.splats,
                self._raster(),
                views,
                settings,
                self.progress,
                self.threads,
                things=things if self.settings.clusters_by_masks else None,
                judged=judged,
            )
        notes["aggregation"] = found.facts
        if settings.aggregation_resolve:
            notes["aggregation"]["resolved"] = self._resolve(W.cpu(), geometry, found, X, sums)
        return found

    def _resolve(
        self, W: RegionWeights, geometry: Geometry, aggregation: Aggregation, X: Tensor, sums: np.ndarray
    ) -> float:
        """Solve again, from the kept regions alone, for splats that took no cluster's feature; their share of all.

        Only those most of whose weight lies in kept regions: it is their neighbours' regions that reach the others.
        """
        if all(rows is None for rows in aggregation.kept):
            return 0.0
        with self.timings.stage("resolve"):
            counted = [
                torch.ones(book.shape[0]) if rows is None else torch.from_numpy(rows).float()
                for book, rows in zip(geometry.books, aggregation.kept, strict=True)
            ]
            fewer = reweighted(W, torch.cat(counted).index_select(0, W.region))
            most = fewer.row_sums().numpy()
            chosen = aggregation.own & torch.from_numpy((most > 0) & (most >= LEAST_KEPT * sums))
            rows = torch.nonzero(chosen)[:, 0]
            solve_rows(
                X, rows, fewer, geometry.codebook, self.progress, means=self.splats.means, threads=self.threads
            )
            return float(chosen.float().mean())

    def diagnose(
        self, views: LiftViews, geometry: Geometry, X: Tensor, sums: np.ndarray, plan: Plan, notes: dict[str, Any]
    ) -> dict[str, Any]:
        """What the lift measured of itself."""
        facts: dict[str, Any] = {
            "device": self.device.facts(),
            "weights_entries": geometry.weights.region.shape[0],
            "views_without_camera": views.unpaired,
            "plan": plan.facts(),
            "views_without_splats": list(geometry.blind),
        }
        lifted = [views.camera(number) for number in range(len(views))]
        told = lift_warnings(self.splats, lifted, sums, self.settings.dtype, X.dtype, facts)
        told += [part["warning"] for part in notes.values() if "warning" in part]
        facts["warnings"] = [*told, *plan.told]
        with self.timings.step("certify"):
            measures = measure_samples(geometry.samples, X, geometry.books, self.threads)
            return certify(measures, sums, geometry.evidence(), self.settings) | notes | facts

    def _raster(self) -> Raster:
        if self.raster is None:
            raise RuntimeError("there is no raster before the views are weighed")
        return self.raster
