"""The lift from start to end: weights A of the scene, features B of the views, X in closed form, diagnostics."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from liftcore.errors import InvalidSettings
from liftcore.lifting.algebra import Algebra, SplatSupport, WeightStatistics
from liftcore.lifting.checkpoint import Checkpoint
from liftcore.lifting.engines import Engine, LocalEngine
from liftcore.lifting.engines.folder import engine_folder, weigh_in_files
from liftcore.lifting.geometry import strided
from liftcore.lifting.in_memory import weigh_in_memory
from liftcore.lifting.inputs import LiftInputs
from liftcore.lifting.pieces import Pieces
from liftcore.lifting.planning.plan import Plan, plan_lift
from liftcore.query.result import LiftResult
from liftcore.raster import open_raster
from liftcore.raster.cpu.warm_up import warm_up
from liftcore.runtime.arguments import as_path
from liftcore.runtime.device import CPU, choose_device, give_back_memory, within_memory
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, Timings, shown_progress
from liftcore.runtime.torch_modes import default_modes
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.compositing import CompositingParams
from liftcore.scene.neighbours import SplatGraph
from liftcore.scene.splats import Splats
from liftcore.solve.aggregate import aggregate
from liftcore.solve.diagnostics import ViewMeasures, compute_diagnostics, lift_warnings
from liftcore.solve.objects import NodeVectors, RegionObjects, object_facts
from liftcore.solve.optimum import compare_with_optimum
from liftcore.solve.reweight import reweighting_facts
from liftcore.solve.smooth import smooth
from liftcore.values.levels import at_levels
from liftcore.values.lift_views import ViewValues
from liftcore.values.settings import LiftSettings, Preset
from liftcore.values.views import ViewFeatures

log = logging.getLogger(__name__)

# Least views to reweight levels separately: a small scene lost a word with 4 views, gained with 8; 5 to 7 untested.
MIN_LEVEL_VIEWS = 6


@default_modes()
def lift(
    splats: Splats,
    cameras: Cameras | Mapping[str, Camera],
    views: ViewValues,
    preset: Preset | str | LiftSettings = Preset.DEFAULT,
    *,
    progress: Progress | bool | None = None,
    on_plan: Callable[[Plan], None] | None = None,
    threads: int | None = None,
    checkpoint: Path | str | None = None,
    engine: Engine | None = None,
    **settings: Any,
) -> LiftResult:
    """Lift the features of views onto splats: ``X = D^-1 A^T B``, with A the weights of splats on rays.

    Args:
        splats: P trained splats.
        cameras: by name. views: the features of each view, by the same names: ``Regions`` or a ``FeatureGrid``, in a
            dict, a feature pack (`read_features`), or an iterator of (name, view) pairs. An iterator is read once and
            stored on disk, so that no more than a few maps are in memory.
        preset: a published choice of weights (`Preset`), or `LiftSettings` in place of preset and settings.
        progress: called ``progress(stage, completed, total, unit)``; an exception from it stops the lift. None: bars
            where stderr is a terminal. True: bars there and lines elsewhere. False: nothing.
        on_plan: called with the plan before the first view, in memory after the first eight, which show if the inputs
            contradict each other; it is to show the plan's warnings. None: the warnings of the plan are logged, and
            at the end those of the diagnostics.
        threads: None uses the cores that this process may use. The result is bitwise identical for any value.
        checkpoint: a folder that stores the weights of finished views. The same lift resumes from it with a bitwise
            identical result; so does a lift that differs in features alone (another encoder, the same regions).
        engine: runs the lift in blocks of views and of splats, for scenes whose W or X does not fit one machine:
            `LocalEngine` or `RayEngine`, with threads of its own; the result is bitwise identical. The checkpoint is
            then the folder of the blocks, which all workers share and from which the same lift of feature packs
            resumes. None: the whole lift in the memory of this process.
        settings: fields of `LiftSettings` that differ from the preset's.

    Returns:
        Features [P, F] f16 (or f32) with total weight and diagnostics, on the device that computed
        them, or on the CPU where that device has too little memory.

    Raises:
        InvalidSplats, InvalidCameras: splats or cameras are of another type, such as a path.
        InvalidFeatures: views are malformed, or none has a camera.
        InvalidSettings: a setting is unknown or out of range, or does not suit the splats' kernel or the views.
        Unavailable: neither memory nor disk can hold what the lift needs, or the device does not exist.

    Source: Splat Feature Solver, Eq. 3 and 6.
    """
    inputs = LiftInputs.of(splats, cameras, views, preset, settings, threads)
    if on_plan is not None and not callable(on_plan):
        raise InvalidSettings("on_plan", expected="a function of the plan, or None", got=repr(on_plan)[:80])
    stored = None if checkpoint is None else Checkpoint(as_path(checkpoint, "checkpoint"))
    reported_warnings = set[str]()

    def log_once(warnings: Iterable[str]) -> None:
        for warning in warnings:
            if warning not in reported_warnings:
                log.warning(warning)
                reported_warnings.add(warning)

    show_plan = on_plan or (lambda plan: log_once(plan.warnings))
    with shown_progress(progress) as reporter, one_thread():
        timings = Timings(reporter)
        with nullcontext() if engine is None else engine_folder(engine, stored) as folder:
            result = _run(inputs, timings, show_plan, threads, stored, engine, folder)
    log_once(result.diagnostics["warnings"] if on_plan is None else ())
    return result


def _run(
    inputs: LiftInputs,
    timings: Timings,
    on_plan: Callable[[Plan], None],
    threads: int | None,
    checkpoint: Checkpoint | None,
    engine: Engine | None,
    folder: Path | None,
) -> LiftResult:
    """Run all steps of a lift in memory, or by an engine in blocks in a folder."""
    splats, settings, device = inputs.splats, inputs.settings, choose_device(inputs.settings.device)
    if settings.device == "auto" and engine is not None and not isinstance(engine, LocalEngine):
        device = CPU  # workers may have other GPUs than this machine, or none
    with timings.step("plan"):  # in memory the weighing reports contradictions, by the views that it begins with
        probe = folder is not None and bool(inputs.views.features.paths)
        arguments = splats, inputs.views, settings, device, threads
        plan = plan_lift(*arguments, in_blocks=folder is not None, folder=folder, probe=probe)
    with timings.step("compile"):  # a minute on a new machine
        warm_up(splats.kernel, plan.device, settings.compositing, settings.weighting)
    inputs = replace(inputs, views=inputs.views.only(plan.views))
    with within_memory(plan.device):
        with timings.stage("geometry"):
            if engine is None or folder is None:
                pieces, statistics = weigh_in_memory(inputs, plan, on_plan, timings, threads, checkpoint)
            else:
                on_plan(plan)
                pieces, statistics = weigh_in_files(engine, folder, inputs, plan, timings)
        lift = _run_steps(pieces, engine or LocalEngine(threads), inputs, statistics, timings, threads)
        limit = plan.features_room
        is_mapped = folder is not None or (limit is not None and lift.features.nbytes > limit)
        return lift if is_mapped else lift.to(plan.device.place)


def _run_steps(
    pieces: Pieces,
    engine: Engine,
    inputs: LiftInputs,
    statistics: WeightStatistics,
    timings: Timings,
    threads: int | None,
) -> LiftResult:
    """Run the steps after W is known."""
    settings, views, splats, aggregation = inputs.settings, inputs.views, inputs.splats, None
    algebra = Algebra(pieces, engine, timings.progress, threads)
    objects = node_vectors = reliability = None
    if settings.finds_objects(statistics.masks):
        with timings.stage("objects"):
            objects, node_vectors = algebra.find_objects()
    levels_apart = node_vectors is not None and node_vectors.must_separate and len(views) >= MIN_LEVEL_VIEWS
    if settings.robust:
        if statistics.masks:
            with timings.stage("consensus"):
                algebra.compare_masks()
        with timings.stage("reweight"):
            reliability = algebra.reweight(levels_apart)
    with timings.stage("solve"):
        X, support = algebra.solve()
    give_back_memory()
    facts = dict[str, Any]()
    if settings.reference_channels:
        with timings.stage("reference"):
            facts["reference"] = _optimum_facts(inputs, statistics.plan, X, support, algebra, threads)
    if settings.smoothness:
        with timings.stage("smooth"):
            graph, visible = SplatGraph.of(splats, threads), torch.from_numpy(support.sums > 0)
            X, facts["smoothing"] = smooth(
                X, graph, support.total_weight, support.confidence, visible, settings.smoothness, timings.progress,
                threads,
            )  # fmt: skip
    if settings.aggregation:
        with timings.stage("aggregate"):
            raster, total_weight = open_raster(splats, statistics.plan.device, threads), support.total_weight.numpy()
            X, aggregation = aggregate(X, total_weight, raster, views, settings, timings.progress, threads)
        facts["aggregation"] = aggregation.facts
    if settings.robust:
        facts["reweighting"] = reweighting_facts(statistics.levels, reliability, support.confidence, levels_apart)
    if objects and node_vectors:
        facts["objects"] = object_facts(objects, node_vectors)
    with timings.step("diagnose"):
        diagnostics = diagnose(inputs, statistics, X.dtype, support, algebra.measure(X), facts)
    table = views.features.table
    return LiftResult(
        rows=X,
        total_weight=support.total_weight,
        confidence=support.confidence,
        has_feature=torch.from_numpy(support.sums > 0),
        metadata=views.metadata(settings, splats, diagnostics, timings.seconds),
        cluster=aggregation.clusters if aggregation else None,
        cluster_features=aggregation.cluster_features if aggregation else None,
        embeddings=torch.from_numpy(table.embeddings) if table else None,
        **(object_tensors(objects, node_vectors) if objects and node_vectors else {}),
    )


def _optimum_facts(
    inputs: LiftInputs, plan: Plan, X: Tensor, support: SplatSupport, algebra: Algebra, threads: int | None
) -> dict[str, Any]:
    """Compare X with the least-squares optimum of the splats that have weights."""
    settings, views, pieces = inputs.settings, inputs.views, algebra.pieces

    def read(number: int) -> tuple[Camera, ViewFeatures, CompositingParams]:
        camera, features = views[number]
        params = strided(settings.compositing, settings, camera, number)
        return camera, at_levels(features, settings.levels, camera.name), params

    raster, books = open_raster(inputs.splats, plan.device, threads), [view.rows for view in pieces.codebook.views]
    arguments = map(read, range(len(views))), X, support.sums > 0, pieces.samples(), books
    return compare_with_optimum(raster, *arguments, settings, algebra.progress)


def object_tensors(objects: RegionObjects, node_vectors: NodeVectors) -> dict[str, torch.Tensor]:
    """Return the tensors of objects and their parts as a lift stores them, by name."""
    columns = {"object": objects.labels, "object_views": objects.views, "node": objects.node}
    columns |= {"node_parents": objects.tree.parents, "node_views": objects.node_views}
    columns |= {"node_confidence": objects.tree.confidence, "node_features": node_vectors.vectors.astype(np.float16)}
    return {name: torch.from_numpy(column) for name, column in columns.items()}


def diagnose(
    inputs: LiftInputs,
    statistics: WeightStatistics,
    dtype: torch.dtype,
    support: SplatSupport,
    measures: ViewMeasures,
    step_facts: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the diagnostics of the lift, ready for JSON.

    Args:
        dtype: of X. step_facts: the facts of optional steps, by their names.
    """
    plan, settings = statistics.plan, inputs.settings
    facts: dict[str, Any] = {
        "device": plan.device.facts(),
        "weights_entries": statistics.entries,
        "masks": any(map(inputs.views.features.is_regions, inputs.views.names)),
        "views_without_camera": inputs.views.unpaired,
        "plan": plan.facts(),
        "views_without_splats": list(statistics.blind),
    }
    warnings = lift_warnings(inputs.splats, inputs.views.lifted, support.sums, settings.dtype, dtype, facts)
    warnings += [part["warning"] for part in step_facts.values() if "warning" in part]
    facts["warnings"] = [*warnings, *plan.input_warnings]
    return compute_diagnostics(measures, support.sums, support.total_weight, settings) | dict(step_facts) | facts


@default_modes()
def plan(
    splats: Splats,
    cameras: Cameras | Mapping[str, Camera],
    views: ViewValues,
    preset: Preset | str | LiftSettings = Preset.DEFAULT,
    *,
    threads: int | None = None,
    in_blocks: bool = False,
    **settings: Any,
) -> Plan:
    """Plan the lift of the same arguments: the views that it takes, its memory, its warnings.

    The weights of a few views show whether splats, cameras and features contradict each other. `lift` checks this
    too where views lie in files.

    Args:
        splats, cameras, views, preset, threads, settings: as in `lift`.
        in_blocks: plan the lift of an engine, whose memory is that of one worker.

    Raises:
        InvalidFeatures, InvalidSettings, Unavailable: as in `lift`.
    """
    inputs = LiftInputs.of(splats, cameras, views, preset, settings, threads)
    device = choose_device(inputs.settings.device)
    return plan_lift(inputs.splats, inputs.views, inputs.settings, device, threads, in_blocks=in_blocks, probe=True)
