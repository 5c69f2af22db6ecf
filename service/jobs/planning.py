"""The process that plans a lift which nobody has ordered yet.

Run as ``python -m service.jobs.planning ORDER MEMORY_BYTES``, with the JSON file of a job's order. It says ``ready``
once it can read, then ``valid`` with the plan, or ``invalid`` with the error: JSON lines on stdout.
"""

from __future__ import annotations

import json
import resource
import sys
from pathlib import Path
from typing import Any

from liftcore.errors import SplatliftError
from liftcore.io.scene_files import open_files
from liftcore.lifting import plan
from liftcore.settings import LiftSettings
from service.child import die_with_parent, end_with_parent, fault_of, own_stdout
from service.jobs.lifting import plan_document


def run(order: dict[str, Any]) -> dict[str, Any]:
    """The last message."""
    try:
        settings = LiftSettings.of(**order["settings"])
        packs = [Path(path) for path in order["features"]]
        sources = open_files(Path(order["splats"]), Path(order["cameras"]), packs, settings)
        return {"event": "valid", "plan": plan_document(plan(*sources, settings), order["names"])}
    except SplatliftError as error:
        return {"event": "invalid", "fault": fault_of(error, order["names"])}


def main() -> None:
    """Plan what the command line names."""
    out = own_stdout()
    die_with_parent()
    end_with_parent()  # it may have died before
    memory = int(sys.argv[2])
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    for message in ({"event": "ready"}, run(json.loads(Path(sys.argv[1]).read_bytes()))):
        out.write(json.dumps(message).encode() + b"\n")
        out.flush()


if __name__ == "__main__":
    main()
