"""What a job of kind ``lift`` does."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from liftcore.artifact import save_lift
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
    output = Path(order["output"])
    save_lift(made, output)
    return {
        "sha256": _sha256(output),
        "count": made.features.shape[0],
        "channels": made.features.shape[1],
        # Through JSON and not model_dump: what is not finite must become null before it reaches a client.
        "metadata": json.loads(made.metadata.model_dump_json()),
    }


def _sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
