"""What jobs do: a lift, or a trade-off."""

from __future__ import annotations

import hashlib
import json
import logging
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from liftcore import Checkpoint, Kernel, LiftResult, LiftSettings, Plan, lift_files, open_engine
from liftcore.files import finite
from service.child import renamed
from service.jobs.child import Reporter

log = logging.getLogger(__name__)
SHOWN_DIGITS = 12  # of the splats' digest, by which the chart names the scene


def lift_as_ordered(order: dict[str, Any], report: Reporter) -> dict[str, Any]:
    """Lift, and save the lift at ``output``.

    Returns:
        What the job's last message tells of it.

    Raises:
        SplatliftError: as `liftcore.lift` has it.
    """

    def planned(plan: Plan) -> None:
        for warning in plan.warnings:  # the operator's log has them too
            log.warning(warning)
        report.plan(plan_document(plan, order["names"]))

    settings = LiftSettings.of(**order["settings"])
    address = order["ray_address"] if order["engine"] == "ray" else None
    engine = open_engine(order["engine"], address, order["threads"])
    made = lift_files(
        Path(order["splats"]),
        Path(order["cameras"]),
        [Path(path) for path in order["features"]],
        settings,
        threads=order["threads"],
        progress=report,
        on_plan=planned,
        checkpoint=Checkpoint(Path(order["work"]), order["checkpoint_seconds"]),
        engine=engine,
    )
    made = _as_clients_know(made, order["file_names"])
    output = Path(order["output"])
    made.save(output, progress=report)
    with output.open("rb") as handle:
        digest = hashlib.file_digest(handle, "sha256").hexdigest()
    return {
        "sha256": digest,
        "count": made.features.shape[0],
        "channels": made.features.shape[1],
        # Through JSON and not model_dump: what is not finite must become null before it reaches a client.
        "metadata": json.loads(made.metadata.model_dump_json()),
    }


def plan_document(plan: Plan, names: Mapping[str, str]) -> dict[str, Any]:
    """A plan as `service.models.Plan` has it, with the names that clients know in place of paths."""
    warnings = [renamed(warning, names) for warning in (*plan.warnings, *plan.told)]
    return finite({"summary": list(plan.summary()), "warnings": warnings, **plan.facts()})


def _as_clients_know(made: LiftResult, names: Mapping[str, str]) -> LiftResult:
    """The inputs by the names under which clients download them: whoever has the lift may have them beside it, and
    paths of this machine are nobody's business.
    """
    metadata = made.metadata
    resolved = {str(Path(path).resolve()): name for path, name in names.items()}  # data may lie behind a link
    inputs = metadata.splats, metadata.cameras, *metadata.features
    splats, cameras, *features = (
        file.model_copy(update={"path": resolved[str(Path(file.path).resolve())]}) for file in inputs
    )
    update = {"splats": splats, "cameras": cameras, "features": tuple(features)}
    return replace(made, metadata=metadata.model_copy(update=update))


def compare_as_ordered(order: dict[str, Any], progress: Reporter) -> dict[str, Any]:
    """Compare, and draw the chart at ``output``. Each run is a process of our group, with our environment.

    Returns:
        What the job's last message tells of it: ``document`` and ``page``.

    Raises:
        SplatliftError: as `liftcore.evaluate.compare_speeds` has it.
    """
    from liftcore.evaluate import SceneFiles, compare_speeds  # with matplotlib, which no lift needs

    settings, parameters, labels = order["settings"], order["parameters"], order["labels"]
    files = Path(order["splats"]), Path(order["cameras"]), tuple(Path(path) for path in order["features"])
    scene = SceneFiles(*files)
    if labels:
        classes = tuple(parameters["labels"]["classes"])
        scene = SceneFiles(*files, Path(labels["masks"]), Path(labels["table"]), classes)
    found = compare_speeds(
        scene,
        budget=parameters["budget_s"],
        settings=settings,
        kernel=Kernel(order["kernel"]),
        threads=order["threads"],
        progress=progress,
        scene=f"splats {scene.splats.stem[:SHOWN_DIGITS]}",  # a blob is named by its digest
        command=f"POST /tradeoff {json.dumps(parameters | {'settings': settings})}",
    )
    with tempfile.TemporaryDirectory(prefix="splatlift-chart-") as folder:
        chart = next(file for file in found.save(Path(folder)) if file.suffix == ".png")
        Path(order["output"]).write_bytes(chart.read_bytes())
    return {"document": found.document, "page": "\n".join(found.lines()) + "\n"}
