"""The pipeline, as the paper reads: A from the scene, B from the views, X in closed form, and what is known of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from liftcore import __version__
from liftcore.device import Device, choose_device, within_memory
from liftcore.planning.plan import Plan, plan_lift
from liftcore.progress import Progress, Timings
from liftcore.raster import open_raster
from liftcore.raster.base import Raster, check_antialiased
from liftcore.result import LiftMetadata, LiftResult
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.settings import LiftSettings, Preset
from liftcore.solve.accumulate import Geometry, accumulate, as_read
from liftcore.solve.aggregation import Aggregation, aggregate, kept_columns
from liftcore.solve.all_rays import AllRays
from liftcore.solve.certificate import certify
from liftcore.solve.checkpoint import Checkpoint, identity, resumed
from liftcore.solve.closed_form import Solution
from liftcore.solve.feature_room import room_within
from liftcore.solve.host import Host
from liftcore.solve.least_squares import refine
from liftcore.solve.lift_warnings import lift_warnings
from liftcore.solve.reference import reference
from liftcore.solve.robust import robust_weights
from liftcore.solve.solver import closed_form
from liftcore.solve.view_weights import WeightStore
from liftcore.solve.views import Given, LiftViews
from liftcore.warm_up import warm_up_lift

LEAST_KEPT = 0.5  # of a splat's weight, in regions that the aggregation kept, for it to be solved for again
log = logging.getLogger(__name__)


def lift(
    splats: Splats,
    cameras: Cameras | Mapping[str, Camera],
    views: Given,
    preset: Preset | str | LiftSettings = Preset.TIKHONOV,
    *,
    progress: Progress | None = None,
    on_plan: Callable[[Plan], None] | None = None,
    threads: int | None = None,
    checkpoint: Checkpoint | Path | None = None,
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
        on_plan: called with the plan before the first view; None logs its warnings of this machine.
        threads: None takes the cores that this process may use. The number changes no bit of the result.
        checkpoint: a folder that keeps the weights of finished views. The same lift goes on from there, identical to
            the bit, and so does one that differs in features alone (another encoder's of the same regions).
        settings: fields of `LiftSettings` that differ from the preset's.

    Returns:
        Features [P, F] f16 (or f32) with evidence, agreement and diagnostics, on the device that the splats are on.

    Raises:
        InvalidFeatures: views are malformed, or none has a camera.
        InvalidSettings: a setting is unknown or out of range, or does not suit the splats' kernel or the views.
        Unavailable: neither memory nor disk can hold what the lift needs, or there is no such device as asked for.

    Source: Splat Feature Solver, Eq. 3 and 6.
    """
    chosen = preset if isinstance(preset, LiftSettings) else LiftSettings.of(preset=preset)
    if settings:
        own = chosen.model_dump(exclude_unset=True) if isinstance(preset, LiftSettings) else {"preset": preset}
        chosen = LiftSettings.of(**own | settings)
    work = _Lift(splats, chosen, threads, Timings(progress), choose_device(chosen.device))
    check_antialiased(splats.kernel, chosen.antialiased)
    found = LiftViews.of(views, cameras, chosen)
    plan = work.planned(found, on_plan or log_warnings)
    kept = Checkpoint(checkpoint) if isinstance(checkpoint, Path) else checkpoint
    with within_memory(work.device), WeightStore(card=(work.device.place, plan.kept_on_card)) as store:
        geometry = work.weigh(found, plan, store, kept)
        weights, solution = work.solve(store, geometry, plan)
        X, notes = work.refine(found, geometry, solution.features)
        clusters = work.aggregate(found, geometry, weights, X, plan, notes)
        certificate = work.diagnose(found, geometry, store, X, plan, notes)
    return LiftResult(
        features=X,
        evidence=torch.from_numpy(geometry.evidence).to(torch.float32),
        agreement=solution.agreement,
        seen=torch.from_numpy(geometry.denominators > 0),
        metadata=LiftMetadata(
            version=__version__,
            settings=chosen,
            encoder=found.features.encoder,
            text_space=found.features.text_space,
            views=tuple(found.names),
            certificate=certificate,
            timings=work.timings.seconds,
        ),
        cluster=clusters.clusters if clusters else None,
        cluster_features=clusters.cluster_features if clusters else None,
    )


def plan(
    splats: Splats,
    cameras: Cameras | Mapping[str, Camera],
    views: Given,
    preset: Preset | str | LiftSettings = Preset.TIKHONOV,
    *,
    threads: int | None = None,
    **settings: Any,
) -> Plan:
    """What `lift` with the same arguments would do, and what it would take: views, memory, warnings.

    Raises:
        InvalidFeatures, InvalidSettings, Unavailable: as `lift` has it.
    """
    chosen = preset if isinstance(preset, LiftSettings) else LiftSettings.of(preset=preset, **settings)
    check_antialiased(splats.kernel, chosen.antialiased)
    found = LiftViews.of(views, cameras, chosen)
    return plan_lift(splats, found, chosen, choose_device(chosen.device), threads)


def log_warnings(plan: Plan) -> None:
    """Log what the plan has to say of this machine, which no certificate keeps: equal inputs give equal lifts."""
    for warning in plan.warnings:
        log.warning(warning)


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

    def planned(self, views: LiftViews, on_plan: Callable[[Plan], None]) -> Plan:
        """The plan, which may leave views out and take another device."""
        self.compile()
        with self.timings.step("plan"):
            plan = plan_lift(self.splats, views, self.settings, self.device, self.threads)
            views.names = list(plan.views)
        on_plan(plan)
        if plan.device != self.device:
            self.device = plan.device
            self.compile()
        return plan

    def weigh(self, views: LiftViews, plan: Plan, store: WeightStore, checkpoint: Checkpoint | None) -> Geometry:
        """W of every view into the store, with the sums of its rows."""
        self.raster = open_raster(self.splats, self.device, self.threads, plan.kept_on_card)
        key = identity(self.splats, self.device.facts()) if checkpoint else ""
        with self.timings.stage("geometry"), resumed(self.raster, checkpoint, key) as raster:
            return accumulate(raster, self.splats.count, views, self.settings, store, self.progress)

    def solve(self, store: WeightStore, geometry: Geometry, plan: Plan) -> tuple[WeightStore, Solution]:
        """The weights, which reweighting may have changed, and the closed form of them."""
        settings, sums, weights = self.settings, geometry.denominators, store
        host = self._host(plan)
        if settings.robust_steps or settings.aggregation_resolve:  # which read the weights on the host
            store.bring_home()
        with self.timings.stage("robust"):
            weights = robust_weights(store, geometry.codebooks, sums, settings.robust_steps, self.progress, host)
        with self.timings.stage("solve"):
            dtype = getattr(torch, settings.dtype)
            return weights, closed_form(weights, geometry.columns, sums, dtype, self.progress, self.device, host)

    def refine(self, views: LiftViews, geometry: Geometry, X: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """X after the conjugate gradient steps that the settings ask for, and what is known of the optimum."""
        settings, progress, notes = self.settings, self.progress, dict[str, Any]()
        if not settings.cg_steps and not settings.reference_channels:
            return X, notes
        seen, numbers = geometry.denominators > 0, range(len(views.names))
        with self.timings.stage("rays"):
            rays = AllRays(
                self._raster(),
                self.splats.count,
                [views.camera(number) for number in numbers],
                lambda number: as_read(views[number][1], settings, views.names[number]),
                settings.lift_params,
                progress,
            )
        if settings.cg_steps:
            with self.timings.stage("refine"):
                refinement = refine(rays, X, seen, geometry.codebooks, settings, progress)
            X, notes["refinement"] = refinement.features, refinement.stats
        if settings.reference_channels:
            with self.timings.stage("reference"):
                books = geometry.codebooks
                notes["reference"] = reference(rays, X, seen, geometry.samples, books, settings, progress)
        return X, notes

    def aggregate(
        self, views: LiftViews, geometry: Geometry, weights: WeightStore, X: Tensor, plan: Plan, notes: dict[str, Any]
    ) -> Aggregation | None:
        """Aggregate X in place, if the settings ask for it."""
        settings = self.settings
        if not settings.aggregation:
            return None
        with self.timings.stage("aggregate"):
            lifted: Any = (self._raster(), views.cameras, views.features, views.names)
            found = aggregate(X, geometry.evidence, lifted, settings, self.progress, self.threads)
        notes["aggregation"] = found.facts
        if settings.aggregation_resolve:
            notes["aggregation"]["resolved"] = self._resolve(weights, geometry, found, X, self._host(plan, X.nbytes))
        return found

    def _resolve(
        self, weights: WeightStore, geometry: Geometry, aggregation: Aggregation, X: Tensor, host: Host
    ) -> float:
        """Solve again, from the kept regions alone, for splats that took no cluster's feature; their share of all.

        Only those most of whose weight lies in kept regions: it is their neighbours' regions that reach the others.
        """
        if all(rows is None for rows in aggregation.kept):
            return 0.0
        with self.timings.stage("resolve"):
            fewer, sums = kept_columns(weights, aggregation.kept, X.shape[0])
            again = closed_form(fewer, geometry.columns, sums, X.dtype, self.progress, self.device, host).features
            most = (sums > 0) & (sums >= LEAST_KEPT * geometry.denominators)
            chosen = aggregation.own & torch.from_numpy(most)
            X[chosen] = again[chosen].to(X.dtype)
            return float(chosen.float().mean())

    def diagnose(
        self, views: LiftViews, geometry: Geometry, store: WeightStore, X: Tensor, plan: Plan, notes: dict[str, Any]
    ) -> dict[str, Any]:
        """What the lift measured of itself."""
        blind = [name for name, own in zip(views.names, store, strict=True) if not own.evidence_splats.numel()]
        facts: dict[str, Any] = {
            "device": self.device.facts(),
            "weights_entries": sum(len(part.columns) for part in store),
            "views_without_camera": views.unpaired,
            "plan": plan.facts(),
            "views_without_splats": blind,
        }
        lifted, sums = [views.camera(number) for number in range(len(views.names))], geometry.denominators
        told = lift_warnings(self.splats, lifted, sums, self.settings.dtype, X.dtype, facts)
        facts["warnings"] = [*told, *plan.told]
        with self.timings.step("certify"):
            return certify(geometry, X, self.settings, self.threads) | notes | facts

    def _raster(self) -> Raster:
        if self.raster is None:
            raise RuntimeError("there is no raster before the views are weighed")
        return self.raster

    def _host(self, plan: Plan, taken: int = 0) -> Host:
        """What the closed form has of this machine, beside so many bytes of features that there are already."""
        limit = plan.features_room
        return Host(self.threads, room_within(None if limit is None else limit - taken), self.splats.means)
