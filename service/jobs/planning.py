"""The errand that plans a lift which nobody has ordered yet (`service.errand`)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from liftcore.errors import SplatliftError
from liftcore.lifting.files import open_files
from liftcore.lifting.pipeline import plan
from liftcore.values.settings import LiftSettings
from service.child import fault_of
from service.jobs.lifting import plan_document


def run(file: str) -> dict[str, Any]:
    """Plan by the JSON file of a job's order: ``valid`` with the plan, or ``invalid`` with the error."""
    order = json.loads(Path(file).read_bytes())
    try:
        settings = LiftSettings.of(**order["settings"])
        packs = [Path(path) for path in order["features"]]
        sources = open_files(Path(order["splats"]), Path(order["cameras"]), packs, settings)
        found = plan(*sources, settings, in_blocks=order["engine"] is not None)
        return {"event": "valid", "plan": plan_document(found, order["names"])}
    except SplatliftError as error:
        return {"event": "invalid", "fault": fault_of(error, order["names"])}
