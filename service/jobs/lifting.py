"""What a job of kind ``lift`` does."""

from __future__ import annotations

import json
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
from liftcore.runtime.progress import one_step
from liftcore.values.lift import InputFile, LiftMetadata
from liftcore.values.lift_file import save_lift, sha256_of
from liftcore.values.settings import LiftSettings
from service.child import renamed
from service.jobs.child import Reporter


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
