"""What a job of kind ``lift`` does."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from liftcore.artifact import InputFile, LiftMetadata, save_lift
from liftcore.input_files import sha256_of
from liftcore.lift import lift
from liftcore.progress import Progress
from liftcore.solve.checkpoint import Checkpoint
from liftcore.solve.settings import LiftSettings


def lift_as_ordered(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Lift, and save the lift at ``output``.

    Returns:
        What the job's last message tells of it.

    Raises:
        SplatliftError: as `liftcore.lift.lift` has it.
    """
    made = lift(
        Path(order["splats"]),
        Path(order["cameras"]),
        [Path(path) for path in order["features"]],
        LiftSettings.of(**order["settings"]),
        threads=order["threads"],
        progress=progress,
        checkpoint=Checkpoint(Path(order["work"]), order["checkpoint_seconds"]),
    )
    made = replace(made, metadata=_as_clients_know(made.metadata, order["file_names"]))
    output = Path(order["output"])
    save_lift(made, output)
    return {
        "sha256": sha256_of(output),
        "count": made.features.shape[0],
        "channels": made.features.shape[1],
        # Through JSON and not model_dump: what is not finite must become null before it reaches a client.
        "metadata": json.loads(made.metadata.model_dump_json()),
    }


def _as_clients_know(metadata: LiftMetadata, names: Mapping[str, str]) -> LiftMetadata:
    """The inputs by the names under which clients download them: whoever has the lift may have them beside it, and
    paths of this machine are nobody's business.
    """

    def named(file: InputFile) -> InputFile:
        return file.model_copy(update={"path": resolved[file.path]})

    resolved = {str(Path(path).resolve()): name for path, name in names.items()}  # as lifts remember paths
    inputs = {"splats": named(metadata.splats), "cameras": named(metadata.cameras)}
    return metadata.model_copy(update={**inputs, "features": tuple(map(named, metadata.features))})
