"""The process that looks whether lifts can run on a device: it loads torch, which the HTTP process never does.

Run as ``python -m service.jobs.device NAME``. It says ``{"event": "there"}``, or ``{"event": "fault", ...}`` with
what is missing, in one JSON line on stdout.
"""

from __future__ import annotations

import json
import sys

from liftcore.device import choose_device
from liftcore.errors import SplatliftError
from service.child import fault_of, own_stdout


def look(asked: str) -> dict[str, object]:
    """Whether ``auto``, ``cpu`` or ``cuda`` can be had here."""
    try:
        choose_device(asked)
    except SplatliftError as error:
        return {"event": "fault", "fault": fault_of(error)}
    return {"event": "there"}


def main() -> None:
    """ViewMask for the device that the command line names."""
    out = own_stdout()
    out.write(json.dumps(look(sys.argv[1])).encode() + b"\n")
    out.flush()


if __name__ == "__main__":
    main()
