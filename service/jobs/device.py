"""Whether this machine has the device that a lift asks for, told at once rather than by a failed job.

torch knows, and the HTTP process never loads it: ``python -m service.jobs.device NAME`` looks, and says
``{"event": "there"}``, or ``{"event": "fault", ...}`` with what is missing, in one JSON line on stdout.
"""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import threading
from collections.abc import Mapping
from typing import Any

from liftcore.errors import SplatliftError
from service.child import error_of, fault_of, own_stdout

SECONDS = 60.0  # to load torch on a busy machine and ask the driver

log = logging.getLogger(__name__)


class Devices:
    """What a process of its own found, once a device: a server starts anew when its machine or its torch changes."""

    def __init__(self) -> None:
        self._found: dict[str, Mapping[str, Any]] = {}
        self._turn = threading.Lock()

    def require(self, asked: str) -> None:
        """Refuse a device that is not there. ``auto`` and ``cpu`` always are.

        When nothing can be found out the job is let through: it looks again, and fails in the same words.

        Raises:
            Unavailable: what is missing, as the lift would say it.
        """
        if asked != "cuda":
            return
        with self._turn:  # those who ask together wait for one look
            if asked not in self._found:
                told = ask(asked)
                if told is None:
                    return
                self._found[asked] = told
        if "fault" in self._found[asked]:
            raise error_of(self._found[asked]["fault"])


def ask(name: str) -> Mapping[str, Any] | None:
    """What the process says of a device, None when it says nothing."""
    command = [sys.executable, "-m", "service.jobs.device", name]
    try:
        heard = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=SECONDS, check=True)
        return json.loads(heard.stdout)
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        log.error("could not look for %s: %s", name, error)
        return None


def look(name: str) -> dict[str, object]:
    """Whether ``auto``, ``cpu`` or ``cuda`` can be had here."""
    from liftcore.runtime.device import choose_device  # loads torch

    try:
        choose_device(name)
    except SplatliftError as error:
        return {"event": "fault", "fault": fault_of(error)}
    return {"event": "there"}


def main() -> None:
    """Look for the device that the command line names."""
    out = own_stdout()
    out.write(json.dumps(look(sys.argv[1])).encode() + b"\n")
    out.flush()


if __name__ == "__main__":
    main()
