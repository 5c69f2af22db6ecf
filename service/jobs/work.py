"""What jobs do: a lift, or a trade-off."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from liftcore.io.json_file import finite
from liftcore.lifting.checkpoint import Checkpoint
from liftcore.lifting.engines import open_engine
from liftcore.lifting.files import lift_files
from liftcore.lifting.pipeline import log_warnings
from liftcore.lifting.planning.plan import Plan
from liftcore.runtime.device import choose_device
from liftcore.runtime.progress import Progress, one_step
from liftcore.scene.kernel import Kernel
from liftcore.values.lift import InputFile, LiftMetadata
from liftcore.values.lift_file import save_lift, sha256_of
from liftcore.values.settings import LiftSettings
from service.child import renamed
from service.jobs.child import Reporter

SHOWN_DIGITS = 12  # of the splats' digest, by which the chart names the scene


def lift_as_ordered(order: dict[str, Any], report: Reporter) -> dict[str, Any]:
    """Lift, and save the lift at ``output``.

    Returns:
        What the job's last message tells of it.

    Raises:
        SplatliftError: as `liftcore.lift` has it.
    """

    def planned(plan: Plan) -> None:
        log_warnings(plan)  # the operator's log has them too
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
    made = replace(made, metadata=_as_clients_know(made.metadata, order["file_names"]))
    output = Path(order["output"])
    with one_step(report, "save"):
        save_lift(made, output)
        digest = sha256_of(output)
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


def _as_clients_know(metadata: LiftMetadata, names: Mapping[str, str]) -> LiftMetadata:
    """The inputs by the names under which clients download them: whoever has the lift may have them beside it, and
    paths of this machine are nobody's business.
    """

    def named(file: InputFile) -> InputFile:
        return file.model_copy(update={"path": resolved[str(Path(file.path).resolve())]})

    resolved = {
        str(Path(path).resolve()): name for path, name in names.items()
    }  # a data directory may be behind a link
    inputs = {"splats": named(metadata.splats), "cameras": named(metadata.cameras)}
    return metadata.model_copy(update={**inputs, "features": tuple(map(named, metadata.features))})


def compare_as_ordered(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Compare, and draw the chart at ``output``. Each run is a process of our group, with our environment.

    Returns:
        What the job's last message tells of it: ``document`` and ``page``.

    Raises:
        SplatliftError: as `liftcore.evaluate.tradeoff.compare` has it.
    """
    from liftcore.evaluate.tradeoff import SceneFiles, candidates_of, compare
    from liftcore.evaluate.tradeoff_report import page_of, save  # with matplotlib, which no lift needs
    from liftcore.lifting.warm_up import warm_up_lift

    settings, parameters, labels = order["settings"], order["parameters"], order["labels"]
    files = Path(order["splats"]), Path(order["cameras"]), tuple(Path(path) for path in order["features"])
    scene = SceneFiles(*files)
    if labels:
        classes = tuple(parameters["labels"]["classes"])
        scene = SceneFiles(*files, Path(labels["masks"]), Path(labels["table"]), classes)
    device = choose_device(settings.get("device", "auto"))
    with one_step(progress, "compile"):  # what the runs load: else the first of a kind eats up the budget
        for candidate in candidates_of(settings):
            warm_up_lift(Kernel(order["kernel"]), device, LiftSettings.of(**settings | candidate.settings))
    progress("tradeoff", 0, len(candidates_of(settings)), "runs")
    found = compare(scene, parameters["budget_s"], settings, order["threads"], progress)
    named = {
        "title": "Speed against accuracy",
        "scene": f"splats {scene.splats.stem[:SHOWN_DIGITS]}",  # a blob is named by its digest
        "command": f"POST /tradeoff {json.dumps(parameters | {'settings': settings})}",
    }
    document = finite(named | found)
    with tempfile.TemporaryDirectory(prefix="splatlift-chart-") as folder:
        chart = next(file for file in save(document, Path(folder)) if file.suffix == ".png")
        Path(order["output"]).write_bytes(chart.read_bytes())
    return {"document": document, "page": "\n".join(page_of(document)) + "\n"}
