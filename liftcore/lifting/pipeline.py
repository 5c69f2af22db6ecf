"""The pipeline, as the paper reads: A from the scene, B from the views, X in closed form, and what is known of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import torch

from liftcore.errors import InvalidSettings
from liftcore.lifting.base import LiftSteps, SplatSupport, Weights, WeightStatistics
from liftcore.lifting.checkpoint import Checkpoint
from liftcore.lifting.engines.base import Engine
from liftcore.lifting.engines.lift import plan_of_a_worker, steps_in_blocks
from liftcore.lifting.in_memory import InMemory
from liftcore.lifting.inputs import LiftInputs
from liftcore.lifting.planning.plan import Plan, plan_lift
from liftcore.lifting.warm_up import warm_up_lift
from liftcore.query.result import LiftResult
from liftcore.runtime.device import choose_device, within_memory
from liftcore.runtime.one_thread import one_thread
from liftcore.runtime.progress import Progress, Timings, shown_progress
from liftcore.runtime.torch_modes import usual_modes
from liftcore.scene.cameras import Camera, Cameras
from liftcore.scene.splats import Splats
from liftcore.solve.diagnostics import ViewMeasures, certify, lift_warnings
from liftcore.solve.objects import NodeVectors, RegionObjects, object_facts
from liftcore.solve.reweight import agreement_facts
from liftcore.values.lift_options import LiftOptions
from liftcore.values.lift_views import Given
from liftcore.values.settings import LiftSettings, Preset

log = logging.getLogger(__name__)

LEAST_WITNESSES = 6  # views: with 4, levels apart lost a word of a small scene; with 8 they gain; between: not tried


@usual_modes()
def lift(
    splats: Splats,
    cameras: Cameras | Mapping[str, Camera],
    views: Given,
    preset: Preset | str | LiftSettings = Preset.DEFAULT,
    *,
    progress: Progress | bool | None = None,
    on_plan: Callable[[Plan], None] | None = None,
    threads: int | None = None,
    checkpoint: Checkpoint | Path | str | None = None,
    engine: Engine | None = None,
    **settings: Unpack[LiftOptions],
) -> LiftResult:
    """Lift the features of views onto splats: ``X = D^-1 A^T B`` A the weights of splats on rays.

    Args:
        splats: P trained splats.
        cameras: by name. views: what each sees, by the same names: ``Regions`` or a ``FeatureGrid``, in a dict, a
            feature pack (`read_features`), or an iterator of (name, view) pairs, which is gone through once and kept
            on the disk, so that no more than a few maps are in memory.
        preset: a published choice of weights (`Preset`), or `LiftSettings` in place of preset and settings.
        progress: called ``progress(stage, done, total, unit)``; an exception from it stops the work. None: bars where
            stderr is a terminal. True: bars there and lines elsewhere. False: nothing.
        on_plan: called with the plan before the first view, and shows its warnings. None: they are logged, and at
            the end those of the diagnostics.
        threads: None takes the cores that this process may use. The number changes no bit of the result.
        checkpoint: a folder that keeps the weights of finished views. The same lift goes on from there, identical to
            the bit, and so does one that differs in features alone (another encoder's of the same regions).
        engine: who works on the lift in blocks of views and of splats, for scenes whose W or X is more than a machine
            should hold: `LocalEngine` or `RayEngine`, with the same bits and threads of its own; the checkpoint is
            then the folder of the blocks, which all workers share, and from which the same lift of feature packs goes
            on. None: the whole lift in this process's memory.
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
    inputs = LiftInputs.of(splats, cameras, views, preset, settings, threads)
    if on_plan is not None and not callable(on_plan):
        raise InvalidSettings("on_plan", expected="a function of the plan, or None", got=repr(on_plan)[:80])
    checkpoint, warn = _checkpoint(checkpoint), _WarnOnce()
    tell_plan = on_plan or (lambda plan: warn((*plan.warnings, *plan.told)))
    with shown_progress(progress) as reporter:
        timings = Timings(reporter)
        if engine is None:
            steps = InMemory(inputs.splats, inputs.settings, timings, threads, checkpoint)
            with one_thread():
                result = run(steps, inputs, timings, tell_plan)
        else:
            folder = checkpoint.folder if checkpoint else None
            with steps_in_blocks(engine, inputs, timings, folder, threads=threads) as steps:
                result = run(steps, inputs, timings, tell_plan)
    warn(result.diagnostics["warnings"] if on_plan is None else ())
    return result


def run(
    steps: LiftSteps[Weights], inputs: LiftInputs, timings: Timings, on_plan: Callable[[Plan], None]
) -> LiftResult:
    """Take the steps of a lift, whoever holds W and X."""
    splats, views, settings = inputs.splats, inputs.views, inputs.settings
    device = choose_device(settings.device)
    with timings.step("compile"):
        warm_up_lift(splats.kernel, device, settings)
    with timings.step("plan"):
        plan = steps.plan(views, device)
    if plan.device != device:
        with timings.step("compile"):
            warm_up_lift(splats.kernel, plan.device, settings)
    with within_memory(plan.device):
        return _run(steps, replace(inputs, views=views.only(plan.views)), plan, timings, on_plan)


def _run(
    steps: LiftSteps[Weights], inputs: LiftInputs, plan: Plan, timings: Timings, on_plan: Callable[[Plan], None]
) -> LiftResult:
    """Take the steps after the plan."""
    settings, views = inputs.settings, inputs.views
    with timings.stage("geometry"):
        W, weighed = steps.weigh(views, plan, on_plan)
    aggregation = None
    objects, node_vectors = find_objects(steps, W, weighed.masks, settings, timings)
    levels_apart = judges_apart(node_vectors, len(plan.views))
    W, reliability = reweigh(steps, W, weighed.masks, levels_apart, settings, timings)
    clusters = objects if settings.clusters_by_masks else None
    with timings.stage("solve"):
        X, support = steps.solve(W, clusters)
    facts = dict[str, Any]()
    if settings.cg_steps or settings.reference_channels:
        with timings.stage("rays"):
            X, least_squares = steps.refine(W, X, support.sums > 0)
        facts |= least_squares
    if settings.smoothness:
        with timings.stage("smooth"):
            X, facts["smoothing"] = steps.smooth(W, X, support)
    if settings.aggregation:
        with timings.stage("aggregate"):
            X, aggregation = steps.aggregate(W, X, clusters)
        facts["aggregation"] = aggregation.facts
    if settings.robust_steps:
        facts["reweighting"] = agreement_facts(weighed.levels, reliability, support.confidence, levels_apart)
    if objects and node_vectors and settings.objects:
        facts["objects"] = object_facts(objects, node_vectors)
    with timings.step("certify"):
        measures = steps.measure(W, X)
        diagnostics = diagnose(inputs, weighed, X.dtype, support, measures, facts)
    table = views.features.table
    lift = LiftResult(
        features=X,
        evidence=support.evidence,
        agreement=support.agreement,
        confidence=support.confidence,
        seen=torch.from_numpy(support.sums > 0),
        metadata=views.metadata(settings, inputs.splats, diagnostics, timings.seconds),
        cluster=aggregation.clusters if aggregation else None,
        cluster_features=aggregation.cluster_features if aggregation else None,
        embeddings=torch.from_numpy(table.embeddings) if table else None,
        **(object_tensors(objects, node_vectors) if objects and node_vectors and settings.objects else {}),
    )
    return steps.deliver(W, lift)


def object_tensors(objects: RegionObjects, said: NodeVectors) -> dict[str, torch.Tensor]:
    """What a lift holds of objects and their parts."""
    columns = {"object": objects.labels, "object_views": objects.views, "node": objects.node}
    columns |= {"node_parents": objects.tree.parents, "node_views": objects.node_views}
    columns |= {"node_confidence": objects.tree.confidence, "node_features": said.vectors.astype(np.float16)}
    return {name: torch.from_numpy(column) for name, column in columns.items()}


def find_objects(
    steps: LiftSteps[Weights], W: Weights, masks: bool, settings: LiftSettings, timings: Timings
) -> tuple[RegionObjects | None, NodeVectors | None]:
    """Objects and what the masks of their nodes say, where the settings ask for objects; else None.

    Args:
        masks: whether any view has masks.
    """
    if not settings.finds_objects(masks):
        return None, None
    with timings.stage("objects"):
        objects = steps.find_objects(W)
        return objects, steps.node_vectors(W, objects)


def judges_apart(node_vectors: NodeVectors | None, views: int) -> bool:
    """True where each level of masks is judged by itself: levels disagree, and enough views can witness each."""
    return node_vectors is not None and node_vectors.levels_disagree and views >= LEAST_WITNESSES


def reweigh(
    steps: LiftSteps[Weights], W: Weights, masks: bool, levels_apart: bool, settings: LiftSettings, timings: Timings
) -> tuple[Weights, float | None]:
    """W as it is solved, and the median reliability of regions, where that is asked for.

    Steps give factors of W's entries, and so does a loss that is not of squares.

    Args:
        masks: whether any view has masks.
        levels_apart: whether regions are compared with those of their own level alone.

    Raises:
        InvalidSettings: consensus is asked for, and no view has masks.
    """
    reliability = None
    if settings.asks_consensus(masks):
        with timings.stage("consensus"):
            W = steps.compare_masks(W)
    if settings.robust_steps:
        with timings.stage("robust"):
            W, reliability = steps.reweight(W, levels_apart)
    if settings.loss == "huber":
        with timings.stage("loss"):
            W = steps.discount_distance(W)
    return W, reliability


def diagnose(
    inputs: LiftInputs,
    weighed: WeightStatistics,
    stored: torch.dtype,
    support: SplatSupport,
    measures: ViewMeasures,
    steps: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """What the lift measured of itself.

    Args:
        stored: the type of X. steps: what steps that the settings ask for tell of themselves, by their names.
    """
    plan, settings = weighed.plan, inputs.settings
    facts: dict[str, Any] = {
        "device": plan.device.facts(),
        "weights_entries": weighed.entries,
        "views_without_camera": inputs.views.unpaired,
        "plan": plan.facts(),
        "views_without_splats": list(weighed.blind),
    }
    warnings = lift_warnings(inputs.splats, inputs.views.lifted, support.sums, settings.dtype, stored, facts)
    warnings += [part["warning"] for part in steps.values() if "warning" in part]
    facts["warnings"] = [*warnings, *plan.told]
    return certify(measures, support.sums, support.evidence, settings) | dict(steps) | facts


@usual_modes()
def plan(
    splats: Splats,
    cameras: Cameras | Mapping[str, Camera],
    views: Given,
    preset: Preset | str | LiftSettings = Preset.DEFAULT,
    *,
    threads: int | None = None,
    in_blocks: bool = False,
    **settings: Unpack[LiftOptions],
) -> Plan:
    """What `lift` with the same arguments would do, and what it would take: views, memory, warnings.

    A few views are weighed to see whether splats, cameras and features contradict each other, as `lift` itself does
    with views that lie in files.

    Args:
        splats, cameras, views, preset, threads, settings: as `lift` has them.
        in_blocks: plan the lift of an engine, whose memory is that of one worker.

    Raises:
        InvalidFeatures, InvalidSettings, Unavailable: as `lift` has it.
    """
    inputs = LiftInputs.of(splats, cameras, views, preset, settings, threads)
    device = choose_device(inputs.settings.device)
    found = plan_lift(inputs.splats, inputs.views, inputs.settings, device, threads, apart=in_blocks, look=True)
    return plan_of_a_worker(found) if in_blocks else found


def log_warnings(plan: Plan) -> None:
    """Log what the plan has to say of this machine, which no certificate keeps: equal inputs give equal lifts."""
    for warning in plan.warnings:
        log.warning(warning)


class _WarnOnce:
    """Logs what a lift warns of, once, where nobody shows its plan: a program would not look into diagnostics."""

    def __init__(self) -> None:
        self._said = set[str]()

    def __call__(self, warnings: Iterable[str]) -> None:
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
