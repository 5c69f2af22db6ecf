"""The pipeline, as the paper reads: A from the scene, B from the packs, X in closed form, and its certificate."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from liftcore import __version__
from liftcore.device import Device, choose_device, within_memory
from liftcore.errors import InvalidFeatures
from liftcore.features.pack import FeaturePacks, pair, read_features
from liftcore.io.cameras import read_cameras
from liftcore.io.input_files import input_files
from liftcore.io.lift_file import LiftMetadata, LiftResult
from liftcore.io.ply import read_splats
from liftcore.listener import NOBODY, Listener
from liftcore.plan.plan import plan_lift
from liftcore.progress import Progress, one_step
from liftcore.raster import open_raster
from liftcore.raster.base import check_antialiased
from liftcore.solve.accumulate import Geometry, accumulate, as_read
from liftcore.solve.aggregation import Aggregation, aggregate
from liftcore.solve.all_rays import AllRays
from liftcore.solve.certificate import certify
from liftcore.solve.checkpoint import Checkpoint, identity, resumed
from liftcore.solve.feature_room import room_within
from liftcore.solve.host import Host
from liftcore.solve.kept_columns import kept_columns
from liftcore.solve.least_squares import refine
from liftcore.solve.lift_warnings import lift_warnings
from liftcore.solve.reference import reference
from liftcore.solve.robust import robust_weights
from liftcore.solve.solver import closed_form
from liftcore.solve.view_weights import WeightStore
from liftcore.timings import Timings
from liftcore.warm_up import warm_up_lift

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from liftcore.io.lift_file import InputFile
    from liftcore.plan.plan import Plan
    from liftcore.raster.base import Raster
    from liftcore.scene.cameras import Cameras
    from liftcore.scene.splats import Kernel, Splats
    from liftcore.settings import LiftSettings
    from liftcore.solve.closed_form import Solution

LEAST_KEPT = 0.5  # of a splat's weight, in regions that the aggregation kept, for it to be solved for again


@dataclass(frozen=True)
class Sources:
    """What a lift is made from, opened and checked."""

    splats: Splats
    cameras: Cameras
    packs: FeaturePacks  # their views named like their cameras
    views: list[str]  # that may be lifted, in the order of the sums
    unpaired: list[str]  # views with features and no camera


@dataclass(frozen=True)
class Run:
    """How a lift is done, and whom it tells."""

    settings: LiftSettings
    threads: int | None
    listener: Listener
    timings: Timings
    device: Device  # that the settings ask for

    @property
    def progress(self) -> Progress:
        """Told of every view and slice."""
        return self.listener.progress

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block, and tell of it as one step."""
        with self.timings.stage(name), one_step(self.progress, name):
            yield


def lift(
    splats: Path | str,
    cameras: Path | str,
    features: Sequence[Path | str],
    settings: LiftSettings,
    *,
    threads: int | None = None,
    listener: Listener = NOBODY,
    checkpoint: Checkpoint | None = None,
) -> LiftResult:
    """Lift the features of the packs onto the splats.

    Args:
        splats: a PLY of any dialect. cameras: COLMAP, transforms.json or cameras.json. features: feature packs, a
            list of one or more.
        threads: None takes the cores that this process may use. The number changes no bit of the result.
        listener: told of the plan before the first view is walked, of every stage, view and slice; an exception from
            it stops the work.
        checkpoint: keeps walked views on the disk; the same lift goes on from there, identical to the bit, and so
            does one that differs in features alone (another encoder's of the same regions).

    Raises:
        InvalidInput: a file is malformed, the packs do not fit the cameras, or they are no list.
        InvalidSettings: the splats' kernel has no opacity compensation, and the settings ask for it.
        Unavailable: neither memory nor disk can hold what the lift needs, or there is no such device as asked for.
    """
    if isinstance(features, str | Path):  # a text is a sequence too, of letters
        raise InvalidFeatures("features", expected="a list of feature packs", got=f"{str(features)!r} alone")
    scene, views, *packs = (Path(path) for path in (splats, cameras, *features))
    run = Run(settings, threads, listener, Timings(), choose_device(settings.device))
    with run.stage("read"):
        sources = open_sources(scene, views, packs, settings)
    with run.stage("digest"):
        inputs = input_files(scene, views, packs)
    return lift_sources(run, sources, inputs, checkpoint)


def lift_sources(
    run: Run, sources: Sources, inputs: list[InputFile], checkpoint: Checkpoint | None = None
) -> LiftResult:
    """The lift of what is open already: ``inputs`` are the files that it came from."""
    _warm_up(run, sources.splats.kernel)
    with run.stage("plan"):
        plan = planned(sources, run.settings, run.device, run.threads)
        sources = replace(sources, views=list(plan.views))
    run.listener.plan(plan)
    if plan.device != run.device:
        run = replace(run, device=plan.device)
        _warm_up(run, sources.splats.kernel)
    with within_memory(run.device):
        return _lift_on(run, plan, sources, inputs, checkpoint)


def _warm_up(run: Run, kernel: Kernel) -> None:
    with run.stage("compile"):
        warm_up_lift(kernel, run.device, run.settings)


def _lift_on(
    run: Run, plan: Plan, sources: Sources, inputs: list[InputFile], checkpoint: Checkpoint | None
) -> LiftResult:
    """The lift as planned."""
    settings, threads, progress = run.settings, run.threads, run.progress
    kept = plan.kept_on_card
    raster, device = open_raster(sources.splats, run.device, threads, kept), run.device.facts()
    with WeightStore(card=(run.device.place, kept)) as store:
        key = identity(inputs[0].sha256, sources.splats.kernel, device) if checkpoint else ""
        with run.timings.stage("geometry"), resumed(raster, checkpoint, key) as walked:
            scene = (sources.splats.count, sources.cameras)
            geometry = accumulate(walked, scene, sources.packs, sources.views, settings, store, progress)
        if settings.robust_steps or settings.aggregation_resolve:  # which read the weights on the host
            store.bring_home()
        weights, solution = _solve(run, store, geometry, _host(run, plan, sources))
        X, notes = _refine(run, sources, raster, geometry, solution)
        aggregation = _aggregate(run, sources, raster, geometry, X) if settings.aggregation else None
        if aggregation:
            notes["aggregation"] = aggregation.facts
            if settings.aggregation_resolve:
                host = _host(run, plan, sources, X.nbytes)
                notes["aggregation"]["resolved"] = _resolve(run, weights, geometry, aggregation, X, host)
        facts: dict[str, Any] = {
            "device": device,
            "weights_entries": sum(len(part.columns) for part in store),
            "views_without_camera": sources.unpaired,
            "plan": plan.facts(),
            "views_without_splats": _blind(sources.views, store),
        }
    lifted = [sources.cameras[name] for name in sources.views]
    told = lift_warnings(sources.splats, lifted, geometry.denominators, settings.dtype, X.dtype, facts)
    facts["warnings"] = [*told, *plan.told]
    with run.stage("certify"):
        certificate = certify(geometry, X, settings, threads) | notes | facts
    return LiftResult(
        features=X,
        evidence=torch.from_numpy(geometry.evidence).to(torch.float32),
        agreement=solution.agreement,
        seen=torch.from_numpy(geometry.denominators > 0),
        metadata=_metadata(run, sources, inputs, certificate),
        cluster=aggregation.clusters if aggregation else None,
        cluster_features=aggregation.cluster_features if aggregation else None,
    )


def open_sources(splats: Path, cameras: Path, features: Sequence[Path], settings: LiftSettings) -> Sources:
    """Open what a lift is made from; views are paired by name, and every ``view_stride``-th is taken."""
    scene, views = read_splats(splats, settings.kernel, colour=False), read_cameras(cameras)
    check_antialiased(scene.kernel, settings.antialiased)
    packs, unpaired = pair(read_features(*features), views)
    return Sources(scene, views, packs, list(packs.views[:: settings.view_stride]), unpaired)


def planned(sources: Sources, settings: LiftSettings, device: Device, threads: int | None = None) -> Plan:
    """The plan of a lift from these sources on the device that the settings ask for."""
    return plan_lift(sources.splats, sources.cameras, sources.packs, sources.views, settings, device, threads)


def _blind(views: Sequence[str], store: WeightStore) -> list[str]:
    """The views whose rays met no splat."""
    return [name for name, part in zip(views, store, strict=True) if not part.evidence_splats.numel()]


def _solve(run: Run, store: WeightStore, geometry: Geometry, host: Host) -> tuple[WeightStore, Solution]:
    """The weights, which the robust steps may have changed, and the closed form of them."""
    settings, sums = run.settings, geometry.denominators
    with run.timings.stage("robust"):
        weights = robust_weights(store, geometry.codebooks, sums, settings.robust_steps, run.progress, host)
    with run.timings.stage("solve"):
        dtype = getattr(torch, settings.dtype)
        return weights, closed_form(weights, geometry.columns, sums, dtype, run.progress, run.device, host)


def _refine(
    run: Run, sources: Sources, raster: Raster, geometry: Geometry, solution: Solution
) -> tuple[torch.Tensor, dict[str, Any]]:
    """X after the conjugate gradient steps that the settings ask for, and what is known of the optimum."""
    settings, progress, X = run.settings, run.progress, solution.features
    notes: dict[str, Any] = {}
    if not settings.cg_steps and not settings.reference_channels:
        return X, notes
    seen, names = geometry.denominators > 0, sources.views
    with run.timings.stage("rays"):
        rays = AllRays(
            raster,
            sources.splats.count,
            [sources.cameras[name] for name in names],
            lambda view: as_read(sources.packs[names[view]], settings, names[view]),
            settings.lift_params,
            progress,
        )
    if settings.cg_steps:
        with run.timings.stage("refine"):
            refinement = refine(rays, X, seen, geometry.codebooks, settings, progress)
            X, notes["refinement"] = refinement.features, refinement.stats
    if settings.reference_channels:
        with run.timings.stage("reference"):
            notes["reference"] = reference(rays, X, seen, geometry.samples, geometry.codebooks, settings, progress)
    return X, notes


def _aggregate(run: Run, sources: Sources, raster: Raster, geometry: Geometry, X: torch.Tensor) -> Aggregation:
    """Aggregate X in place."""
    with run.timings.stage("aggregate"):
        lifted = (raster, sources.cameras, sources.packs, sources.views)
        return aggregate(X, geometry.evidence, lifted, run.settings, run.progress, run.threads)


def _host(run: Run, plan: Plan, sources: Sources, taken: int = 0) -> Host:
    """What the closed form has of this machine, beside so many bytes of features that there are already."""
    limit = plan.features_room
    return Host(run.threads, room_within(None if limit is None else limit - taken), sources.splats.means)


def _resolve(
    run: Run, weights: WeightStore, geometry: Geometry, aggregation: Aggregation, X: torch.Tensor, host: Host
) -> float:
    """Solve again, from the kept regions alone, for splats that took no cluster's feature; their share of all.

    Only those most of whose weight lies in kept regions: it is their neighbours' regions that reach the others.
    """
    if all(rows is None for rows in aggregation.kept):
        return 0.0
    with run.timings.stage("resolve"):
        fewer, denominators = kept_columns(weights, aggregation.kept, X.shape[0])
        again = closed_form(fewer, geometry.columns, denominators, X.dtype, run.progress, run.device, host).features
        most = (denominators > 0) & (denominators >= LEAST_KEPT * geometry.denominators)
        chosen = aggregation.own & torch.from_numpy(most)
        X[chosen] = again[chosen].to(X.dtype)
        return float(chosen.float().mean())


def _metadata(run: Run, sources: Sources, inputs: list[InputFile], certificate: dict[str, Any]) -> LiftMetadata:
    return LiftMetadata(
        version=__version__,
        settings=run.settings,
        splats=inputs[0],
        cameras=inputs[1],
        features=tuple(inputs[2:]),
        encoder=sources.packs.encoder,
        text_space=sources.packs.text_space,
        views=tuple(sources.views),
        certificate=certificate,
        timings=run.timings.seconds,
    )
